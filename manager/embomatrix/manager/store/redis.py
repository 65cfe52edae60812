"""State store in Redis (6.2 command set, also Valkey), for clusters with manager fail-over.

Keys below one prefix: ``epoch``; ``leader`` (hash holder, address; it expires); ``workers`` (set); ``credentials``,
``reputes``, ``switches`` and ``windows`` (hashes key -> payload); ``runs`` (hash id -> name), ``run_terms`` (hash id
-> terms), ``run_order`` (list); per run ``batches:RUN`` (list of ids); per batch ``batch:RUN:BATCH`` (hash digest,
payload), ``done:RUN:BATCH`` (set of rollouts), ``results:RUN:BATCH`` (sorted set of "rollout id length:rollout id
payload" by cursor). Every conditional write is one Lua script that checks the epoch first.
"""

import contextlib
import logging
from collections.abc import Awaitable, Collection, Sequence
from typing import Any, Final, cast

import redis.asyncio
from redis.exceptions import OutOfMemoryError, RedisError, ResponseError

from embomatrix.manager.store.protocol import (
    BatchResults,
    BatchRow,
    Candidate,
    FencedError,
    Lead,
    Namespace,
    NamespaceRow,
    PutOutcome,
    ResultRow,
    RunRow,
    StateError,
    StateFullError,
    readable,
)
from embomatrix.rpc.logs import without_secrets

logger = logging.getLogger(__name__)

TIMEOUT_S: Final = 5.0
_FENCED: Final = "FENCED"
_NO_MEMORY: Final = "OOM command not allowed"
_GUARD: Final = f"""
if redis.call('GET', KEYS[1]) ~= ARGV[1] then return redis.error_reply('{_FENCED}') end
"""
_CLAIM: Final = """
local holder = redis.call('HGET', KEYS[2], 'holder')
if holder and holder ~= ARGV[1] then
    return {tonumber(redis.call('GET', KEYS[1])), redis.call('HGET', KEYS[2], 'address'), 0}
end
local epoch = redis.call('INCR', KEYS[1])
redis.call('HSET', KEYS[2], 'holder', ARGV[1], 'address', ARGV[2])
redis.call('PEXPIRE', KEYS[2], ARGV[3])
return {epoch, ARGV[2], 1}
"""
_RENEW: Final = """
redis.call('HSET', KEYS[2], 'holder', ARGV[2], 'address', ARGV[3])
redis.call('PEXPIRE', KEYS[2], ARGV[4])
"""
_RESIGN: Final = """
redis.call('DEL', KEYS[2])
"""
_PUT_WORKERS: Final = """
redis.call('DEL', KEYS[2])
for index = 2, #ARGV do redis.call('SADD', KEYS[2], ARGV[index]) end
"""
_OPEN_RUN: Final = """
if redis.call('HSETNX', KEYS[2], ARGV[2], ARGV[3]) == 1 then
    redis.call('RPUSH', KEYS[3], ARGV[2])
    redis.call('HSET', KEYS[4], ARGV[2], ARGV[4])
end
"""
_PUT_BATCH: Final = """
if redis.call('HEXISTS', KEYS[2], ARGV[2]) == 0 then return 'no_run' end
local known = redis.call('HGET', KEYS[3], 'digest')
if known then
    if known == ARGV[4] then return 'same' end
    return 'conflict'
end
redis.call('HSET', KEYS[3], 'digest', ARGV[4], 'payload', ARGV[5])
redis.call('RPUSH', KEYS[4], ARGV[3])
return 'created'
"""
_APPEND: Final = """
local added, index = 0, 2
for key = 2, #KEYS, 3 do
    local known = redis.call('EXISTS', KEYS[key]) == 1
    local rows = tonumber(ARGV[index])
    index = index + 1
    for _ = 1, rows do
        if known and redis.call('SADD', KEYS[key + 1], ARGV[index + 1]) == 1 then
            redis.call('ZADD', KEYS[key + 2], ARGV[index], #ARGV[index + 1] .. ':' .. ARGV[index + 1] .. ARGV[index + 2])
            added = added + 1
        end
        index = index + 3
    end
end
return added
"""
_DROP_BATCH: Final = """
redis.call('DEL', KEYS[2], KEYS[3], KEYS[4])
redis.call('LREM', KEYS[5], 0, ARGV[2])
"""
_CLOSE_RUN: Final = """
redis.call('HDEL', KEYS[2], ARGV[2])
redis.call('LREM', KEYS[3], 0, ARGV[2])
redis.call('DEL', KEYS[4])
redis.call('HDEL', KEYS[5], ARGV[2])
redis.call('HDEL', KEYS[6], ARGV[2])
"""
_PUT_ROWS: Final = """
for index = 2, #ARGV, 2 do redis.call('HSET', KEYS[2], ARGV[index], ARGV[index + 1]) end
"""


class RedisStore:
    """``url`` is ``redis://HOST:PORT/DB``. Every call is limited to ``TIMEOUT_S``; failures are StateError."""

    def __init__(self, url: str, *, prefix: str = "embomatrix") -> None:
        self._shown = without_secrets(url)
        self._prefix = prefix
        self._epoch = 0
        self._candidate: Candidate | None = None
        self._checked = False
        try:
            self._redis = redis.asyncio.Redis.from_url(
                url, socket_timeout=TIMEOUT_S, socket_connect_timeout=TIMEOUT_S
            )
        except (ValueError, RedisError) as error:
            raise StateError(
                f"--state {self._shown!r} is no Redis address ({error}): expected redis://HOST:PORT/DB"
            ) from error

    async def claim(self, candidate: Candidate) -> Lead:
        await self._check_server()
        keys = (self._key("epoch"), self._key("leader"))
        ttl_ms = int(candidate.ttl_s * 1000)
        answer = self._redis.eval(_CLAIM, 2, *keys, candidate.holder, candidate.address, ttl_ms)
        epoch, address, mine = await self._call(answer)
        lead = Lead(int(epoch), address.decode(), mine=bool(mine))
        if lead.mine:
            self._epoch, self._candidate = lead.epoch, candidate
        return lead

    async def renew(self) -> None:
        if (candidate := self._candidate) is not None:
            ttl_ms = int(candidate.ttl_s * 1000)
            await self._script(_RENEW, ("leader",), candidate.holder, candidate.address, ttl_ms)

    async def open_run(self, run: RunRow) -> None:
        await self._script(_OPEN_RUN, ("runs", "run_order", "run_terms"), run.run_id, run.name, run.terms)

    async def close_run(self, run_id: str) -> None:
        for batch_id in await self._batch_ids(run_id):
            await self.drop_batch(run_id, batch_id)
        keys = ("runs", "run_order", f"batches:{run_id}", "run_terms", Namespace.WINDOWS.value)
        await self._script(_CLOSE_RUN, keys, run_id)

    async def put_batch(self, batch: BatchRow) -> PutOutcome:
        keys = ("runs", f"batch:{batch.run_id}:{batch.batch_id}", f"batches:{batch.run_id}")
        arguments = (batch.run_id, batch.batch_id, batch.digest, batch.payload)
        answer = await self._script(_PUT_BATCH, keys, *arguments)
        return PutOutcome(answer.decode())

    async def append_results(self, parts: Sequence[BatchResults]) -> int:
        keys = [key for part in parts for key in self._batch_keys(part.run_id, part.batch_id)]
        values: list[str | bytes | int] = []
        for part in parts:
            values.append(len(part.rows))
            for row in part.rows:
                values += (row.cursor, row.rollout_id, row.payload)
        return int(await self._script(_APPEND, keys, *values))

    async def results_after(self, run_id: str, batch_id: str, cursor: int, limit: int) -> list[ResultRow]:
        key = self._key(f"results:{run_id}:{batch_id}")
        found = await self._call(
            self._redis.zrangebyscore(key, f"({cursor}", "+inf", start=0, num=limit, withscores=True)
        )
        with readable(f"a result of batch {batch_id!r}"):
            return [_row(int(score), member) for member, score in found]

    async def drop_batch(self, run_id: str, batch_id: str) -> None:
        await self._script(_DROP_BATCH, (*self._batch_keys(run_id, batch_id), f"batches:{run_id}"), batch_id)

    async def runs(self) -> list[RunRow]:
        names = await self._call(self._redis.hgetall(self._key("runs")))
        order = await self._call(cast("Awaitable[Any]", self._redis.lrange(self._key("run_order"), 0, -1)))
        terms = await self._call(self._redis.hgetall(self._key("run_terms")))
        with readable("a run"):
            return [
                RunRow(run_id.decode(), names[run_id].decode(), terms.get(run_id, b"")) for run_id in order
            ]

    async def batches(self, run_id: str) -> list[BatchRow]:
        rows: list[BatchRow] = []
        for batch_id in await self._batch_ids(run_id):
            fields = await self._call(self._redis.hgetall(self._key(f"batch:{run_id}:{batch_id}")))
            if fields:
                with readable(f"batch {batch_id!r} of run {run_id!r}"):
                    rows.append(BatchRow(run_id, batch_id, fields[b"digest"].decode(), fields[b"payload"]))
        return rows

    async def put_workers(self, worker_ids: Collection[str]) -> None:
        await self._script(_PUT_WORKERS, ("workers",), *worker_ids)

    async def workers(self) -> frozenset[str]:
        found = await self._call(cast("Awaitable[Any]", self._redis.smembers(self._key("workers"))))
        with readable("a worker's name"):
            return frozenset(worker_id.decode() for worker_id in found)

    async def put_rows(self, namespace: Namespace, rows: Sequence[NamespaceRow]) -> None:
        flat = [value for row in rows for value in (row.key, row.payload)]
        await self._script(_PUT_ROWS, (namespace.value,), *flat)

    async def rows(self, namespace: Namespace) -> list[NamespaceRow]:
        found = await self._call(self._redis.hgetall(self._key(namespace.value)))
        with readable(f"a row of {namespace.value}"):
            return [NamespaceRow(key.decode(), payload) for key, payload in found.items()]

    async def close(self) -> None:
        with contextlib.suppress(StateError):
            await self._script(_RESIGN, ("leader",))
        await self._redis.aclose()

    async def _check_server(self) -> None:
        """Raise StateError for a server that may evict keys."""
        if self._checked:
            return
        about = await self._call(self._redis.info())
        policy, limit = about.get("maxmemory_policy", "noeviction"), int(about.get("maxmemory", 0))
        if limit and policy != "noeviction":
            raise StateError(
                f"Redis at {self._shown} evicts keys when its {limit} bytes are full (maxmemory-policy {policy}), and with "
                f"them results that were delivered: set `maxmemory-policy noeviction`"
            )
        if not about.get("aof_enabled"):
            logger.warning("Redis at %s has no AOF: its data is lost when it stops", self._shown)
        self._checked = True

    async def _batch_ids(self, run_id: str) -> list[str]:
        ids = await self._call(self._redis.lrange(self._key(f"batches:{run_id}"), 0, -1))
        with readable(f"the list of batches of run {run_id!r}"):
            return [batch_id.decode() for batch_id in ids]

    def _batch_keys(self, run_id: str, batch_id: str) -> tuple[str, str, str]:
        return (f"batch:{run_id}:{batch_id}", f"done:{run_id}:{batch_id}", f"results:{run_id}:{batch_id}")

    def _key(self, name: str) -> str:
        return f"{self._prefix}:{name}"

    async def _script(self, source: str, names: Sequence[str], *values: str | bytes | int) -> Any:
        """Run a script, if this manager still leads. Its ``KEYS`` are the epoch and these names."""
        keys = [self._key("epoch"), *map(self._key, names)]
        # EVAL instead of EVALSHA: scripts need no reload after a server restart.
        return await self._call(self._redis.eval(_GUARD + source, len(keys), *keys, self._epoch, *values))

    async def _call(self, answer: Any) -> Any:
        try:
            return await answer
        except ResponseError as error:
            if _FENCED in str(error):
                raise FencedError(await self._why_fenced()) from error
            # Redis 6.2 wraps the out-of-memory error of a script in another error.
            if isinstance(error, OutOfMemoryError) or _NO_MEMORY in str(error):
                raise StateFullError(
                    f"Redis at {self._shown} has no memory left ({error}): raise its maxmemory"
                ) from error
            raise StateError(f"Redis at {self._shown} refused a call: {error}") from error
        except (RedisError, OSError) as error:
            raise StateError(
                f"Redis at {self._shown} can't be reached ({error}): start it, or pass another --state"
            ) from error

    async def _why_fenced(self) -> str:
        """Return why this manager leads no longer. A successor has a higher epoch, unless it found an empty state."""
        with contextlib.suppress(RedisError, OSError):
            found = await self._redis.get(self._key("epoch"))
            if found is None or int(found) < self._epoch:
                return (
                    f"the state in {self._shown} is gone: Redis lost its data (restarted without a file, or flushed?). "
                    "Turn on its append-only file and restart this manager; open runs are lost"
                )
        return f"another manager took over the state in {self._shown}: stop this one"


def _row(cursor: int, member: bytes) -> ResultRow:
    length, _, rest = member.partition(b":")
    size = int(length)
    return ResultRow(cursor, rest[:size].decode(), rest[size:])
