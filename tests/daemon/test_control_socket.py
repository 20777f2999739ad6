"""The local socket: answers, refusals, and who asked."""

import asyncio
import os
import stat

import pytest
import structlog

from daemon.monitor.control_client import ControlClient, DaemonUnreachableError
from daemon.monitor.control_socket import LONGEST_REQUEST, ControlSocket, RequestError


async def serve(path, handle, work):
    task = asyncio.create_task(ControlSocket(path, None, handle).run())
    for _ in range(500):
        if path.exists():
            break
        await asyncio.sleep(0.01)
    try:
        return await asyncio.to_thread(work)
    finally:
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)


async def test_a_request_is_answered_and_its_author_is_known(tmp_path):
    asked = []

    async def handle(request, person):
        asked.append((request, person))
        return {"answer": 42}

    def work():
        client = ControlClient(tmp_path / "s")
        mode = stat.S_IMODE((tmp_path / "s").stat().st_mode)
        answer = client.ask("enable", axes=["z"])
        client.close()
        return answer, mode

    answer, mode = await serve(tmp_path / "s", handle, work)
    assert answer == {"answer": 42}
    assert mode == 0o600
    request, person = asked[0]
    assert request == {"command": "enable", "axes": ["z"]}
    assert f"uid {os.getuid()}" in person and f"pid {os.getpid()}" in person
    assert not (tmp_path / "s").exists()


async def test_refusals_and_garbage_are_answered_in_words(tmp_path):
    async def handle(request, person):
        raise RequestError("there is no axis w")

    def work():
        client = ControlClient(tmp_path / "s")
        with pytest.raises(RequestError, match="no axis w"):
            client.ask("enable", axes=["w"])
        client._socket.sendall(b"\xff{not json\n[1]\n" + b"[" * 60_000 + b"\n" + b"9" * 5000 + b"\n")
        answers = [client._stream.readline() for _ in range(4)]
        client.close()
        return answers

    first, second, deep, number = await serve(tmp_path / "s", handle, work)
    assert b"not JSON" in first
    assert b"one JSON object" in second
    assert b"not JSON" in deep and b"not JSON" in number


async def test_a_refusal_repeats_no_more_of_a_long_request_than_a_person_reads(tmp_path):
    async def handle(request, person):
        raise RequestError(f"there is no command {request['command']!r}")

    def work():
        client = ControlClient(tmp_path / "s")
        with pytest.raises(RequestError, match="there is no command 'x") as refused:
            client.ask("x" * 60_000)
        client.close()
        return len(str(refused.value))

    with structlog.testing.capture_logs() as logs:
        assert await serve(tmp_path / "s", handle, work) <= 2000
    assert len(str(logs)) < 5000


@pytest.mark.parametrize("beyond", [1, 100_000, 1_000_000])
async def test_a_line_that_is_too_long_is_refused_in_words_and_the_conversation_goes_on(tmp_path, beyond):
    async def handle(request, person):
        return {}

    def work():
        client = ControlClient(tmp_path / "s")
        client._socket.sendall(b"x" * (LONGEST_REQUEST + beyond))
        with pytest.raises(RequestError, match="longer than 65536 byte"):
            client.ask("status")
        assert client.ask("status") == {}
        client.close()

    await serve(tmp_path / "s", handle, work)


async def test_a_line_that_is_as_long_as_it_may_be_is_answered(tmp_path):
    async def handle(request, person):
        return {"length": len(request["text"])}

    def work():
        client = ControlClient(tmp_path / "s")
        text = "x" * (LONGEST_REQUEST - len('{"command": "t", "text": ""}\n'))
        answer = client.ask("t", text=text)
        client.close()
        return answer == {"length": len(text)}

    assert await serve(tmp_path / "s", handle, work)


def test_without_a_daemon_the_client_says_what_to_do(tmp_path):
    with pytest.raises(DaemonUnreachableError, match="is it running"):
        ControlClient(tmp_path / "nobody")


async def test_a_socket_that_is_served_is_not_taken_away(tmp_path):
    async def handle(request, person):
        return {"first": True}

    path = tmp_path / "s"

    def second():
        asyncio.run(asyncio.wait_for(ControlSocket(path, None, handle).run(), 10))

    def work():
        with pytest.raises(OSError, match="another daemon serves this socket"):
            second()
        client = ControlClient(path)
        answer = client.ask("status")
        client.close()
        return answer

    assert await serve(path, handle, work) == {"first": True}
    assert not path.exists()


async def test_a_file_that_is_no_socket_is_not_taken_away(tmp_path):
    named = tmp_path / "history.sqlite"
    named.write_text("precious")
    with pytest.raises(OSError, match="no socket, and stays"):
        await ControlSocket(named, None, None).run()
    assert named.read_text() == "precious"
