"""/metrics over real HTTP."""

import asyncio
import socket
import urllib.error
import urllib.request

import pytest

from daemon.monitor.web import serve_metrics
from daemon.telemetry.metrics import Telemetry


def free_port():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def get(url):
    with urllib.request.urlopen(url, timeout=30) as answer:
        return answer.status, answer.headers["content-type"], answer.read().decode()


async def served(port, work):
    telemetry = Telemetry()
    task = asyncio.create_task(serve_metrics(telemetry.registry, "127.0.0.1", port))
    try:
        async with asyncio.timeout(30):
            while not task.done():
                try:
                    await asyncio.to_thread(get, f"http://127.0.0.1:{port}/healthz")
                    break
                except urllib.error.URLError:
                    await asyncio.sleep(0.01)
        return await asyncio.to_thread(work, telemetry)
    finally:
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)


async def test_metrics_carry_the_stages_and_the_published_figures():
    port = free_port()

    def work(telemetry):
        telemetry.delays["feedback"].add(0.002)
        assert get(f"http://127.0.0.1:{port}/healthz")[0] == 200
        status, kind, text = get(f"http://127.0.0.1:{port}/metrics")
        assert status == 200 and kind.startswith("text/plain")
        assert "# TYPE toolpoint_stage_seconds histogram" in text
        assert 'toolpoint_published_delay_seconds{part="feedback"} 1.2' in text
        assert 'toolpoint_published_delay_seconds{part="total"} 24.7' in text
        with pytest.raises(urllib.error.HTTPError, match="404"):
            get(f"http://127.0.0.1:{port}/nothing")

    await served(port, work)
    with socket.create_server(("127.0.0.1", port)):
        pass  # the port is free again


async def test_a_taken_port_is_an_oserror():
    with socket.create_server(("127.0.0.1", 0)) as other, pytest.raises(OSError, match="in use"):
        await serve_metrics(Telemetry().registry, "127.0.0.1", other.getsockname()[1])
