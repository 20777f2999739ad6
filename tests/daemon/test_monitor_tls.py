"""The monitor opened beyond the computer: a real certificate, accounts, and what a browser may try."""

import asyncio
import base64
import contextlib
import fcntl
import os
import pty
import ssl
import subprocess
import sys
import termios
from ipaddress import ip_address
from types import MappingProxyType

import pytest
from certificates import HOST, make_certificate
from cryptography.hazmat.primitives import serialization
from monitor_bench import PASSWORD, accounts_file, monitor

from daemon.monitor.web import access


@contextlib.asynccontextmanager
async def opened(folder, service=MappingProxyType({}), **roles):
    """Serve with TLS and accounts."""
    trusted = make_certificate(folder)
    files = {"tls_certificate": folder / "monitor.crt", "tls_key": folder / "monitor.key"}
    async with monitor(folder, trusted, users=accounts_file(folder, **roles), **files, **service) as bench:
        yield bench


async def test_a_person_logs_in_and_acts_through_tls(tmp_path):
    async with opened(tmp_path, anna="operator", otto="viewer") as bench:
        rig = bench.rig
        await rig.turn()
        rig.set_reference()
        await rig.turn()
        browser, viewer = bench.browser(), bench.browser()
        assert (await browser.get("/api/v1/status")).status == 401
        cookie = (await browser.login("anna")).headers["set-cookie"]
        assert cookie.startswith("__Host-toolpoint=")
        assert {"secure", "httponly", "samesite=strict", "path=/"} <= set(cookie.lower().split("; "))
        ours = {"origin": f"https://localhost:{bench.port}", "host": f"localhost:{bench.port}"}
        asked = asyncio.create_task(browser.ask("POST", "/api/v1/enable", {"axes": ["z"]}, ours))
        while not asked.done():
            await rig.turn()
            await asyncio.sleep(0.01)
        assert (await asked).json["decided"] is True
        for origin in (f"http://localhost:{bench.port}", "https://localhost:1", f"https://{HOST}.evil.example"):
            answer = await browser.ask("POST", "/api/v1/disable", {}, ours | {"origin": origin})
            assert answer.status == 403 and "only the monitor's own pages may act" in answer.detail, origin
        token, browser.csrf = browser.csrf, "none"
        answer = await browser.ask("POST", "/api/v1/disable", {}, ours)
        assert answer.status == 403 and "does not hold this session's token" in answer.detail
        await viewer.login("otto")
        answer = await viewer.ask("POST", "/api/v1/disable", {})
        assert answer.status == 403 and "otto is viewer; this takes the role operator" in answer.detail
        viewer.csrf = token
        answer = await viewer.ask("POST", "/api/v1/disable", {})
        assert answer.status == 403 and "token" in answer.detail, "that of another session"
        assert any(rig.snapshots.control.wanted), "nothing of that has acted"


async def test_behind_a_proxy_of_this_computer_the_metrics_take_an_account_too(tmp_path):
    proxies = {"trusted_proxies": [ip_address("127.0.0.1")]}
    async with opened(tmp_path, proxies, anna="viewer") as bench:
        browser = bench.browser()
        assert (await browser.get("/metrics")).status == 200, "Prometheus of this computer"
        for as_a_proxy in ({"host": HOST}, {"x-forwarded-for": "10.9.8.7"}):
            assert (await browser.get("/metrics", **as_a_proxy)).status == 401, as_a_proxy
        basic = {"authorization": f"Basic {base64.b64encode(f'anna:{PASSWORD}'.encode()).decode()}"}
        assert (await browser.get("/metrics", host=HOST, **basic)).status == 200


async def test_a_session_that_ends_closes_its_live_events_too(tmp_path, monkeypatch):
    async with opened(tmp_path, anna="viewer") as bench, asyncio.timeout(60):
        browser = bench.browser()
        await browser.login("anna")
        cookie = "; ".join(f"{name}={value}" for name, value in browser.cookies.items())
        reader, writer = await asyncio.open_connection("localhost", bench.port, ssl=bench.tls)
        writer.write(f"GET /api/v1/events HTTP/1.1\r\nHost: localhost\r\nCookie: {cookie}\r\n\r\n".encode())
        assert await reader.readuntil(b"event: status")
        monkeypatch.setattr(access, "IDLE_S", -1.0)
        while bench.live.viewers:
            await reader.read(4096)
        writer.close()
        answer = await browser.get("/api/v1/status")
        assert answer.status == 401 and "log in first" in answer.detail


async def test_plain_http_and_old_tls_get_nothing_and_the_others_go_on(tmp_path):
    async with opened(tmp_path, anna="viewer") as bench, asyncio.timeout(60):
        reader, writer = await asyncio.open_connection("127.0.0.1", bench.port)
        writer.write(b"GET /api/v1/session HTTP/1.1\r\nHost: localhost\r\n\r\n")
        with contextlib.suppress(ConnectionError):
            assert b"HTTP/1.1" not in await reader.read()
        writer.close()
        old = ssl.create_default_context(cafile=str(tmp_path / "monitor.crt"))
        with pytest.warns(DeprecationWarning):
            old.minimum_version, old.maximum_version = ssl.TLSVersion.TLSv1, ssl.TLSVersion.TLSv1_1
        with pytest.raises((ssl.SSLError, ConnectionError)):
            await asyncio.open_connection("localhost", bench.port, ssl=old)
        assert (await bench.browser().get("/api/v1/session")).status == 200


async def test_a_certificate_that_was_replaced_counts_from_the_next_connection(tmp_path):
    async with opened(tmp_path, anna="viewer") as bench:
        before = bench.browser()
        assert (await before.get("/api/v1/session")).status == 200
        bench.tls = make_certificate(tmp_path)
        assert (await bench.browser().get("/api/v1/session")).status == 200
        with pytest.raises(ssl.SSLError):
            await before.get("/api/v1/session")


@pytest.mark.parametrize("host", ["lathe-3.hall", "*.hall"])
async def test_the_names_are_those_of_the_certificate_that_is_in_use(tmp_path, host):
    async with opened(tmp_path, anna="viewer") as bench:
        asked = {"host": "lathe-3.hall"}
        assert (await bench.browser().get("/api/v1/session", **asked)).status == 403
        bench.tls = make_certificate(tmp_path, host=host)
        assert (await bench.browser().get("/api/v1/session", **asked)).status == 200
        for other in ("lathe-3.shop", "a.lathe-3.hall", "hall"):
            assert (await bench.browser().get("/api/v1/session", host=other)).status == 403


def test_an_encrypted_key_is_refused_and_nobody_is_asked_for_its_password(tmp_path):
    """A terminal is there: what asks would hold the daemon's loop."""
    make_certificate(tmp_path)
    key = serialization.load_pem_private_key((tmp_path / "monitor.key").read_bytes(), None)
    encrypted = key.private_bytes(
        serialization.Encoding.PEM,
        serialization.PrivateFormat.PKCS8,
        serialization.BestAvailableEncryption(b"a password"),
    )
    (tmp_path / "monitor.key").write_bytes(encrypted)
    code = (
        "import sys; from pathlib import Path; from daemon.monitor.web.server import Certificate; "
        "Certificate(Path(sys.argv[1]), Path(sys.argv[2]))"
    )
    person, terminal = pty.openpty()
    try:
        ended = subprocess.run(
            [sys.executable, "-P", "-c", code, tmp_path / "monitor.crt", tmp_path / "monitor.key"],
            check=False,
            stdin=terminal,
            stdout=terminal,
            stderr=subprocess.PIPE,
            start_new_session=True,
            preexec_fn=lambda: fcntl.ioctl(0, termios.TIOCSCTTY, 0),
            timeout=60,
        )
    finally:
        os.close(person)
        os.close(terminal)
    assert ended.stderr.decode().rpartition("\n")[0].endswith("openssl pkey` takes it off")
