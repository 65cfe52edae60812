"""The endpoint client retries within bounds and reports failures with their remedy."""

import asyncio
import base64
import contextlib
from dataclasses import replace

import pytest
from tests.fakes.chat_server import ChatServer

from embomatrix.llm.endpoint import MAX_REPLY_BYTES, Endpoint, EndpointLimits
from embomatrix.llm.values import ChatRequest, EndpointError, Message, Speaker, Usage

QUICK = EndpointLimits(attempts=3, timeout_s=5.0, first_wait_s=0.01, longest_wait_s=0.02)
QUESTION = ChatRequest(
    "cast", (Message(Speaker.SYSTEM, "Be brief."), Message(Speaker.USER, "Who lives here?")), seed=7
)


async def asked(server, question=QUESTION, limits=QUICK, **options):
    with server.serving() as url:
        async with Endpoint(url, "small-1", limits=limits, **options) as endpoint:
            return await endpoint.complete(question)


async def test_question_is_sent_completely_and_usage_is_returned():
    server = ChatServer("Ann and Bo.")
    reply = await asked(server, api_key="key-1")
    sent = server.requests[0]
    assert (sent["_path"], sent["_authorization"]) == ("/v1/chat/completions", "Bearer key-1")
    assert (sent["model"], sent["seed"], sent["temperature"]) == ("small-1", 7, 0.7)
    assert sent["messages"][1] == {"role": "user", "content": "Who lives here?"}
    assert "response_format" not in sent
    assert (reply.text, reply.model, reply.finish, reply.retries) == ("Ann and Bo.", "scripted-1", "stop", 0)
    assert reply.usage == Usage(11, 3)


async def test_images_are_sent_as_data_urls():
    server = ChatServer("{}")
    question = ChatRequest("view", (Message(Speaker.USER, "Look.", (b"png",)),))
    await asked(server, question)
    text, image = server.requests[0]["messages"][0]["content"]
    assert text == {"type": "text", "text": "Look."}
    assert image["image_url"]["url"] == f"data:image/png;base64,{base64.b64encode(b'png').decode()}"


@pytest.mark.parametrize(
    "trouble",
    [
        (429, {"retry-after": "0"}, "slow down", 0.0),
        (503, {}, "<html>starting</html>", 0.0),
        (200, {}, "<html>a proxy</html>", 0.0),
        (200, {}, '{"choices": []}', 0.0),
        (200, {}, "[" * 100_000, 0.0),
    ],
)
async def test_transient_failures_are_retried(trouble):
    server = ChatServer(trouble, trouble, "Ann.")
    reply = await asked(server)
    assert (reply.text, reply.retries, len(server.requests)) == ("Ann.", 2, 3)


async def test_half_of_a_surrogate_pair_in_an_answer_can_be_sent_and_stored():
    server = ChatServer("yes \ud83d", "no")
    reply = await asked(server)
    assert reply.text == "yes ?"
    history = (*QUESTION.messages, Message(Speaker.ASSISTANT, reply.text))
    assert (await asked(server, replace(QUESTION, messages=history))).text == "no"


@pytest.mark.parametrize("count", ["1e999", "-1", "9" * 400, '"3"'])
async def test_impossible_token_counts_are_none(count):
    body = '{"choices": [{"message": {"content": "a"}}], "usage": {"prompt_tokens": %s}}'
    reply = await asked(ChatServer((200, {}, body % count, 0.0)))
    assert reply.usage == Usage(0, 0)


@pytest.mark.parametrize(
    ("trouble", "sentence"),
    [
        (
            (500, {}, "out of memory", 0.0),
            r"cast: the endpoint http.*answered 500 \(out of memory\), 3 times",
        ),
        ((200, {}, "[]", 0.0), r"its answer is not a chat completion \(\[\]\), 3 times"),
    ],
)
async def test_retries_are_bounded(trouble, sentence):
    server = ChatServer(trouble)
    with pytest.raises(EndpointError, match=sentence):
        await asked(server)
    assert len(server.requests) == 3


@pytest.mark.parametrize("status", [400, 401, 404])
async def test_permanent_failures_are_not_retried(status):
    server = ChatServer((status, {}, '{"error": {"message": "no model small-1"}}', 0.0))
    with pytest.raises(EndpointError, match=rf"answered {status} .*no model small-1.*check its address"):
        await asked(server)
    assert len(server.requests) == 1


async def test_unreachable_endpoint_is_named():
    async with Endpoint("http://127.0.0.1:9/v1", "small-1", limits=QUICK) as endpoint:
        with pytest.raises(
            EndpointError, match=r"http://127.0.0.1:9/v1/chat/completions: it can't be reached"
        ):
            await endpoint.complete(QUESTION)


async def test_missing_answer_times_out():
    slow = (200, {}, "{}", 1.0)
    limits = EndpointLimits(attempts=2, timeout_s=0.1, first_wait_s=0.01)
    with pytest.raises(EndpointError, match=r"gave no answer within 0.1 s, 2 times"):
        await asked(ChatServer(slow), limits=limits)


async def test_answer_that_trickles_in_times_out():
    async def trickle(reader, writer):
        await reader.readuntil(b"\r\n\r\n")
        writer.write(b"HTTP/1.1 200 OK\r\ncontent-length: 1000\r\n\r\n")
        with contextlib.suppress(ConnectionError):
            while True:
                writer.write(b" ")
                await writer.drain()
                await asyncio.sleep(0.02)

    server = await asyncio.start_server(trickle, "127.0.0.1", 0)
    address = "http://{}:{}/v1".format(*server.sockets[0].getsockname())
    limits = EndpointLimits(attempts=1, timeout_s=0.3)
    async with server, Endpoint(address, "small-1", limits=limits) as endpoint:
        with pytest.raises(EndpointError, match=r"gave no answer within 0.3 s"):
            await asyncio.wait_for(endpoint.complete(QUESTION), 10)


async def test_damaged_compression_is_a_failure_of_the_endpoint():
    broken = (200, {"content-encoding": "gzip"}, b"no gzip", 0.0)
    with pytest.raises(EndpointError, match=r"can't be reached .*, 3 times"):
        await asked(ChatServer(broken))


async def test_oversized_answer_is_refused():
    with pytest.raises(EndpointError, match="more than 8388608 bytes"):
        await asked(ChatServer((200, {}, b"x" * (MAX_REPLY_BYTES + 1), 0.0)))


async def test_concurrency_is_bounded():
    server = ChatServer((200, {}, '{"choices": [{"message": {"content": "a"}}]}', 0.03))
    with server.serving() as url:
        async with Endpoint(url, "small-1", limits=EndpointLimits(concurrent=3)) as endpoint:
            replies = await asyncio.gather(*(endpoint.complete(QUESTION) for _ in range(12)))
    assert [reply.text for reply in replies] == ["a"] * 12
    assert server.most_at_once == 3


SHAPED = replace(QUESTION, json_schema={"type": "object", "required": ["people"]})


async def test_schema_of_the_answer_is_sent_and_not_quoted():
    server = ChatServer("{}")
    await asked(server, SHAPED)
    sent = server.requests[0]
    form = {"name": "cast", "schema": SHAPED.json_schema}
    assert sent["response_format"] == {"type": "json_schema", "json_schema": form}
    assert not any("required" in message["content"] for message in sent["messages"])


async def test_endpoint_that_refuses_schemas_reads_them_in_the_prompt_from_then_on():
    server = ChatServer((422, {}, "response_format: extra field", 0.0), "{}", "{}")
    with server.serving() as url:
        async with Endpoint(url, "small-1", limits=QUICK) as endpoint:
            await endpoint.complete(SHAPED)
            await endpoint.complete(SHAPED)
    first, *others = server.requests
    assert "response_format" in first
    assert len(others) == 2
    for sent in others:
        assert "response_format" not in sent
        assert '"required":["people"]' in sent["messages"][0]["content"]


async def test_refusal_for_another_reason_keeps_schemas_on_the_wire():
    refused = (400, {}, "the prompt is too long", 0.0)
    server = ChatServer(refused, refused, "{}")
    with server.serving() as url:
        async with Endpoint(url, "small-1", limits=QUICK) as endpoint:
            with pytest.raises(EndpointError, match="the prompt is too long"):
                await endpoint.complete(SHAPED)
            await endpoint.complete(SHAPED)
    assert "response_format" in server.requests[2]
