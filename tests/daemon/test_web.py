"""The monitor over real HTTP: pages, metrics, documents, and what every answer carries."""

import asyncio
import json
import socket

from monitor_bench import monitor


async def test_metrics_carry_the_stages_and_the_published_figures(tmp_path):
    async with monitor(tmp_path) as bench:
        browser = bench.browser()
        assert (await browser.get("/healthz")).status == 200
        answer = await browser.get("/metrics")
        text = answer.body.decode()
        assert answer.status == 200 and answer.headers["content-type"].startswith("text/plain")
        assert "# TYPE toolpoint_stage_seconds histogram" in text
        assert 'toolpoint_published_delay_seconds{part="feedback"} 1.2' in text
        assert 'toolpoint_published_delay_seconds{part="total"} 24.7' in text
        assert "there is nothing at /nothing" in (await browser.get("/nothing")).detail
    with socket.create_server(("127.0.0.1", bench.port)):
        pass  # the port is free again


async def test_a_live_viewer_sees_the_state_change(tmp_path):
    async with monitor(tmp_path) as bench:
        await bench.rig.turn()
        reader, writer = await asyncio.open_connection("127.0.0.1", bench.port)
        writer.write(b"GET /api/v1/events HTTP/1.1\r\nHost: localhost\r\n\r\n")
        head = await reader.readuntil(b"\r\n\r\n")
        assert b"text/event-stream" in head
        bench.rig.set_reference()
        await bench.rig.switch_on()
        await bench.rig.follow(0.0, 0.0, 2)
        async with asyncio.timeout(60):
            while True:
                line = await reader.readline()
                if line.startswith(b"data: ") and json.loads(line[6:])["state"] == "ACTIVE":
                    break
        writer.close()


async def test_every_answer_forbids_what_a_page_of_ours_does_not_need(tmp_path):
    async with monitor(tmp_path) as bench:
        for path in ("/", "/metrics", "/api/v1/status", "/nothing"):
            headers = (await bench.browser().get(path)).headers
            assert "script-src 'self'" in headers["content-security-policy"]
            assert "unsafe" not in headers["content-security-policy"]
            assert headers["x-content-type-options"] == "nosniff" and headers["x-frame-options"] == "DENY"
