"""SceneService: upload and download of bundles by digest."""

from collections.abc import AsyncIterator

from grpc.aio import ServicerContext as Context

from embomatrix.manager.runtime.bundles import BundleStore
from embomatrix.proto.v1 import scene_service_pb2 as pb
from embomatrix.proto.v1 import scene_service_pb2_grpc
from embomatrix.rpc.status import InvalidRequestError, translated


@translated
class SceneServicer(scene_service_pb2_grpc.SceneServiceServicer):
    def __init__(self, bundles: BundleStore) -> None:
        self._bundles = bundles

    async def MissingBundles(
        self, request: pb.MissingBundlesRequest, context: Context
    ) -> pb.MissingBundlesResponse:
        missing = await self._bundles.missing_or_damaged(list(request.bundle_digests))
        return pb.MissingBundlesResponse(bundle_digests=missing)

    async def PutBundle(
        self, request_iterator: AsyncIterator[pb.PutBundleRequest], context: Context
    ) -> pb.PutBundleResponse:
        first = await anext(request_iterator, None)
        if first is None:
            raise InvalidRequestError("a bundle begins with its digest: the stream was empty")
        await self._bundles.put(first.bundle_digest, _chunks(first, request_iterator))
        return pb.PutBundleResponse()

    async def GetBundle(
        self, request: pb.GetBundleRequest, context: Context
    ) -> AsyncIterator[pb.GetBundleResponse]:
        async for chunk in self._bundles.get(request.bundle_digest):
            yield pb.GetBundleResponse(chunk=chunk)


async def _chunks(
    first: pb.PutBundleRequest, rest: AsyncIterator[pb.PutBundleRequest]
) -> AsyncIterator[bytes]:
    yield first.chunk
    async for request in rest:
        yield request.chunk
