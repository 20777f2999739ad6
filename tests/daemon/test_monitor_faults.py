"""Slow, dead and many browsers: each is cut off or served, and none of them holds the loop or takes memory for ever."""

import asyncio
import contextlib
import json
import socket
import threading

import pytest
import structlog
from monitor_bench import monitor

from daemon.monitor import connections
from daemon.monitor.web import application, gate, live, recorded, server
from daemon.rate_limit import BURST

HEAD = b"GET %s HTTP/1.1\r\nHost: localhost\r\n\r\n"


async def connected(port):
    return await asyncio.open_connection("127.0.0.1", port)


async def status_now(bench):
    return (await bench.browser().get("/api/v1/status")).status


async def next_status(reader):
    while True:
        line = await reader.readline()
        if not line:
            raise EOFError
        if line.startswith(b"data: ") and b'"machine"' in line:
            return json.loads(line[6:])


async def test_it_is_served_on_ipv6_and_says_an_address_that_a_browser_takes(tmp_path, capsys):
    async with monitor(tmp_path, http_host="::1") as bench, asyncio.timeout(60):
        reader, writer = await asyncio.open_connection("::1", bench.port)
        writer.write(b"GET /api/v1/status HTTP/1.1\r\nHost: [::1]:%d\r\nConnection: close\r\n\r\n" % bench.port)
        assert (await reader.read()).startswith(b"HTTP/1.1 200")
        writer.close()
        assert f"http://[::1]:{bench.port}/" in capsys.readouterr().out


@pytest.mark.parametrize("words", [b"", b"G", b"GET /api/v1/status HTTP/1.1\r\nHost: loc", b"POST / HTTP/1.1\r\nX"])
async def test_a_head_that_does_not_arrive_in_time_ends_the_connection(tmp_path, monkeypatch, words):
    monkeypatch.setattr(server, "HEAD_S", 0.05)
    async with monitor(tmp_path) as bench, asyncio.timeout(60):
        reader, writer = await connected(bench.port)
        writer.write(words)
        with contextlib.suppress(ConnectionResetError):
            assert await reader.read() == b""
        writer.close()


@pytest.mark.parametrize("path", [b"/api/v1/session", b"/api/v1/enable", b"/api/v1/nothing", b"/metrics", b"/"])
@pytest.mark.parametrize(
    ("rest", "status", "sentence"),
    [
        (b"Content-Length: 100\r\n\r\n{", 408, "has not arrived within 0.05 s"),
        (b"Content-Length: 99999999\r\n\r\n" + b" " * 70_000, 413, "longer than 65536 byte"),
        (b"Transfer-Encoding: chunked\r\n\r\n" + (b"1000\r\n" + b" " * 4096 + b"\r\n") * 17, 413, "longer than"),
    ],
)
async def test_a_body_that_does_not_arrive_or_is_too_long_is_refused(
    tmp_path, monkeypatch, path, rest, status, sentence
):
    if status == 408:
        monkeypatch.setattr(gate, "RECEIVE_S", 0.05)
    begun = b"POST %b HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\n" % path
    async with monitor(tmp_path) as bench, asyncio.timeout(60):
        reader, writer = await connected(bench.port)
        writer.write(begun + rest)
        assert sentence in (await refusal(reader, status))["detail"]
        writer.close()
        assert await status_now(bench) == 200


async def refusal(reader, status):
    """Return the problem details of an answer after which the connection ends."""
    head, _, body = (await reader.read()).partition(b"\r\n\r\n")
    assert head.startswith(b"HTTP/1.1 %d " % status), head
    assert b"content-type: application/problem+json" in head.lower() and b"content-security-policy" in head.lower()
    found = json.loads(body)
    assert found["status"] == status and found["title"]
    return found


async def test_a_viewer_who_takes_nothing_is_cut_off_and_the_others_go_on(tmp_path, monkeypatch):
    monkeypatch.setattr(gate, "SEND_S", 0.3)
    monkeypatch.setattr(live, "LOOK_S", 0.01)
    monkeypatch.setattr(live, "LONGEST_S", 0.01)
    async with monitor(tmp_path) as bench, asyncio.timeout(120):
        narrow = socket.socket()  # on a local connection the buffers of both ends hold megabytes: hundreds of events
        narrow.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        narrow.setsockopt(socket.IPPROTO_TCP, socket.TCP_MAXSEG, 1000)
        narrow.connect(("127.0.0.1", bench.port))
        dead_reader, dead = await asyncio.open_connection(sock=narrow, limit=1024)
        dead.write(HEAD % b"/api/v1/events")
        reader, writer = await connected(bench.port)
        writer.write(HEAD % b"/api/v1/events")
        dead.transport.pause_reading()  # takes nothing more
        await next_status(reader)
        task = asyncio.create_task(drain(reader))
        while bench.live.viewers > 1:
            await asyncio.sleep(0.05)
        assert not task.done(), "the other viewer still follows"
        task.cancel()
        dead.close()
        writer.close()


async def drain(reader):
    while True:
        await next_status(reader)


async def test_a_thousand_connections_leave_room_for_one_more_and_for_the_viewers(tmp_path):
    async with monitor(tmp_path) as bench, asyncio.timeout(300):
        reader, writer = await connected(bench.port)
        writer.write(HEAD % b"/api/v1/events")
        await next_status(reader)
        crowd = []
        for _ in range(1000):
            _, other = await connected(bench.port)
            other.write(b"GET /api/v1/status HTTP/1.1\r\nX")
            crowd.append(other)
        assert await status_now(bench) == 200
        await next_status(reader)
        await bench.rig.turn()
        for other in (*crowd, writer):
            other.transport.abort()
    assert connections.most_connections(server.MOST_CONNECTIONS, server.SHARE_OF_DESCRIPTORS) <= 256


async def test_a_defect_in_a_route_is_a_500_and_the_next_request_is_answered(tmp_path, monkeypatch):
    async with monitor(tmp_path) as bench:
        with monkeypatch.context() as broken:
            broken.setattr(bench.parts.documents, "sensors", lambda: 1 / 0)
            answer = await bench.browser().get("/api/v1/sensors")
            assert answer.status == 500 and "The control goes on without it" in answer.detail
        assert (await bench.browser().get("/api/v1/sensors")).status == 200


async def test_a_defect_that_is_asked_for_again_and_again_does_not_fill_the_log(tmp_path, monkeypatch):
    async with monitor(tmp_path) as bench:
        monkeypatch.setattr(bench.parts.documents, "sensors", lambda: 1 / 0)
        with structlog.testing.capture_logs() as logs:
            for _ in range(BURST + 5):
                assert (await bench.browser().get("/api/v1/sensors")).status == 500
        told = [each for each in logs if each["event"] == "request.defect"]
        assert len(told) == BURST and isinstance(told[0]["exc_info"], ZeroDivisionError)


@pytest.mark.parametrize(
    "sent",
    [
        b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03",
        b"GET / HTTP/9.9\r\n\r\n",
        b"GET " + b"/" * 70_000 + b" HTTP/1.1\r\n\r\n",
        b"GET / HTTP/1.1\r\nHost: a\r\nHost: b\r\n\r\n",
        b"GET /%ff%00%2e%2e/ HTTP/1.1\r\nHost: localhost\r\n\r\n",
        b"GET /../../../etc/passwd HTTP/1.1\r\nHost: localhost\r\n\r\n",
        b"GET /parts/../../web/access.py HTTP/1.1\r\nHost: localhost\r\n\r\n",
        b"POST /api/v1/enable HTTP/1.1\r\nHost: localhost\r\nTransfer-Encoding: chunked\r\n\r\nzz\r\n",
    ],
)
async def test_what_is_no_http_or_none_of_ours_is_answered_with_4xx_or_ended(tmp_path, sent):
    async with monitor(tmp_path) as bench, asyncio.timeout(60):
        reader, writer = await connected(bench.port)
        writer.write(sent)
        with contextlib.suppress(ConnectionError):
            answer = await reader.read(16)
            assert not answer or answer.startswith(b"HTTP/1.1 4"), answer
        writer.close()
        assert await status_now(bench) == 200


async def test_a_request_of_two_lengths_ends_the_connection_with_what_is_hidden_behind_it(tmp_path):
    """A proxy that goes by the other length would take the second for one of its own viewer's."""
    hidden = b"GET /api/v1/health HTTP/1.1\r\nHost: localhost\r\n\r\n"
    length = f"Content-Length: {len(hidden) + 5}\r\n".encode()
    head = b"GET /api/v1/names HTTP/1.1\r\nHost: localhost\r\nTransfer-Encoding: chunked\r\n"
    async with monitor(tmp_path) as bench, asyncio.timeout(60):
        reader, writer = await connected(bench.port)
        writer.write(head + length + b"\r\n0\r\n\r\n" + hidden)
        answer = await reader.read()
        writer.close()
        assert answer.startswith(b"HTTP/1.1 400") and answer.count(b"HTTP/1.1") == 1, answer
        assert await status_now(bench) == 200


@pytest.mark.parametrize("lines", [[b"x" * 20_000], [b"x"] * 4_000])
async def test_a_head_that_is_too_long_is_refused_also_when_it_arrives_at_once(tmp_path, lines):
    async with monitor(tmp_path) as bench, asyncio.timeout(60):
        reader, writer = await connected(bench.port)
        writer.write(b"GET / HTTP/1.1\r\nHost: localhost\r\n" + b"".join(b"X: %b\r\n" % x for x in lines) + b"\r\n")
        assert "no HTTP request, or its head is longer than 16384 byte" in (await refusal(reader, 400))["detail"]
        writer.close()


async def test_a_flood_of_requests_keeps_the_control_neither_from_its_turn_nor_from_its_threads(tmp_path, monkeypatch):
    """Estimate and reference have threads to wait for, and the control a turn of the loop between two requests."""
    blocked, made, most = threading.Event(), [0], 0

    def held_up(*_):
        blocked.wait(60.0)
        return b""

    monkeypatch.setattr(application, "generate_latest", held_up)
    monkeypatch.setattr(application, "openapi_document", held_up)
    async with monitor(tmp_path) as bench, asyncio.timeout(120):
        flood = [await connected(bench.port) for _ in range(2 * recorded.MOST_WAITING)]
        for place, (_, writer) in enumerate(flood):
            writer.write(HEAD % (b"/metrics" if place % 2 else b"/openapi.json"))
        refused = await asyncio.wait_for(next(asyncio.as_completed([reader.readline() for reader, _ in flood])), 30.0)
        assert b" 503 " in refused
        assert await asyncio.to_thread(lambda: "a thread is free") == "a thread is free"
        blocked.set()
        for _, writer in flood:
            writer.close()

        sensors = bench.parts.documents.sensors

        def counted():
            made[0] += 1
            return sensors()

        monkeypatch.setattr(bench.parts.documents, "sensors", counted)
        flood = [await connected(bench.port) for _ in range(40)]
        for _, writer in flood:
            writer.write(HEAD % b"/api/v1/sensors")
        while made[0] < len(flood):
            before = made[0]
            await asyncio.sleep(0)
            most = max(most, made[0] - before)
        assert most <= 2
        for _, writer in flood:
            writer.close()


async def test_metrics_are_told_while_queries_of_the_store_take_long_and_queries_while_strangers_flood(
    tmp_path, monkeypatch
):
    """Somebody looks at months in two windows: Prometheus must not take the daemon for dead meanwhile."""
    blocked, begun = threading.Event(), []

    def held_up(*_):
        begun.append(1)
        blocked.wait(60.0)
        return {}

    series = "/api/v1/series?name=temperature.1"
    async with monitor(tmp_path) as bench, asyncio.timeout(120):
        try:
            with monkeypatch.context() as slow:
                slow.setattr(recorded, "decimated", held_up)
                windows = [asyncio.create_task(bench.browser().get(series)) for _ in range(recorded.THREADS)]
                while len(begun) < len(windows):
                    await asyncio.sleep(0.01)
                assert (await asyncio.wait_for(bench.browser().get("/metrics"), 30.0)).status == 200
                blocked.set()
                assert [(await each).status for each in windows] == [200] * len(windows)
            blocked.clear()
            monkeypatch.setattr(application, "openapi_document", held_up)
            flood = [await connected(bench.port) for _ in range(2 * recorded.MOST_WAITING)]
            for _, writer in flood:
                writer.write(HEAD % b"/openapi.json")
            assert b" 503 " in await asyncio.wait_for(
                next(asyncio.as_completed([reader.readline() for reader, _ in flood])), 30.0
            )
            assert (await asyncio.wait_for(bench.browser().get(series), 30.0)).status == 200
        finally:
            blocked.set()
        for _, writer in flood:
            writer.close()
