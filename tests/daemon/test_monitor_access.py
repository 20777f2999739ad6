"""Who may look and who may act: accounts, sessions, roles, origin, host, wrong passwords, and what the audit names."""

import asyncio
import base64
from ipaddress import ip_address

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from monitor_bench import PASSWORD, accounts_file, monitor
from starlette.requests import Request

from daemon.history.reader import HistoryReader
from daemon.monitor.accounts import Accounts
from daemon.monitor.opcua.users import AccountUsers
from daemon.monitor.web import access
from daemon.monitor.web.access import Access
from daemon.monitor.web.problems import ProblemError
from drivers.opcua.server.settings import LoginRefusedError

ACTIONS = [("reference", None), ("enable", {}), ("disable", {}), ("acknowledge", {"fault": 1})]


async def test_without_accounts_anybody_looks_and_nobody_acts(tmp_path):
    async with monitor(tmp_path) as bench:
        browser = bench.browser()
        assert (await browser.get("/api/v1/status")).status == 200
        for path, body in ACTIONS:
            answer = await browser.ask("POST", f"/api/v1/{path}", body)
            assert answer.status == 403 and "toolpoint users add" in answer.detail
        answer = await browser.login("anna")
        assert answer.status == 403 and "has no accounts" in answer.detail
        assert not any(bench.rig.snapshots.control.wanted)


async def test_with_accounts_nothing_is_shown_before_the_login(tmp_path):
    async with monitor(tmp_path, users=accounts_file(tmp_path, anna="viewer")) as bench:
        browser = bench.browser()
        for path in ("status", "events", "sensors", "names", "series?name=temperature.1", "writes", "health", "models"):
            answer = await browser.get(f"/api/v1/{path}")
            assert answer.status == 401 and "log in first" in answer.detail, path
        who = (await browser.get("/api/v1/session")).json
        assert who == {"name": None, "role": None, "csrf": None, "expires": None, "accounts": True}
        assert (await browser.login("anna")).status == 200
        assert (await browser.get("/api/v1/status")).json["user"]["name"] == "anna"
        assert (await browser.ask("DELETE", "/api/v1/session")).json["role"] is None
        assert (await browser.get("/api/v1/status")).status == 401


async def test_a_cookie_is_for_this_site_and_no_script(tmp_path):
    async with monitor(tmp_path, users=accounts_file(tmp_path, anna="viewer")) as bench:
        cookie = (await bench.browser().login("anna")).headers["set-cookie"].lower()
        assert "httponly" in cookie and "samesite=strict" in cookie and "path=/" in cookie


async def test_a_viewer_may_not_act_and_an_operator_is_named_in_the_audit(tmp_path):
    async with monitor(tmp_path, users=accounts_file(tmp_path, anna="operator", otto="viewer")) as bench:
        rig = bench.rig
        await rig.turn()
        rig.set_reference()
        await rig.turn()
        viewer, operator = bench.browser(), bench.browser()
        await viewer.login("otto")
        for path, body in ACTIONS:
            answer = await viewer.ask("POST", f"/api/v1/{path}", body)
            assert answer.status == 403 and "takes the role operator" in answer.detail
        assert not any(rig.snapshots.control.wanted)
        await operator.login("anna")
        asked = asyncio.create_task(operator.ask("POST", "/api/v1/enable", {"axes": ["y", "z"]}))
        while not any(rig.control.memory.wanted):
            await rig.turn()
            await asyncio.sleep(0.01)
        for _ in range(3):
            await rig.turn()
        answer = await asked
        assert answer.status == 200 and answer.json["decided"] is True, answer.body
        answer = await operator.ask("POST", "/api/v1/enable", {"spindle_speed": True})
        assert answer.status == 403 and "takes an engineer" in answer.detail
        answer = await operator.ask("POST", "/api/v1/enable", {"axes": ["w"]})
        assert answer.status == 409 and "no axis w" in answer.detail
        await rig.history.flushed()
        assert ("logged in to the monitor", "anna (operator, monitor, 127.0.0.1)") in bench.events()
        assert any(text.startswith("refused: /api/v1/enable") for text, _ in bench.events())
        with HistoryReader(bench.configuration.history.path) as reader:
            people = {each.person for each in reader.events(0.0, 1e11) if each.kind != "access"}
        assert "anna (operator, monitor, 127.0.0.1)" in people


async def test_an_action_needs_the_sessions_token_and_our_own_page(tmp_path):
    async with monitor(tmp_path, users=accounts_file(tmp_path, anna="engineer")) as bench:
        browser = bench.browser()
        await browser.login("anna")
        token, browser.csrf = browser.csrf, ""
        assert "x-csrf-token" in (await browser.ask("POST", "/api/v1/disable", {})).detail
        browser.csrf = token[:-1] + ("a" if token[-1] != "a" else "b")
        assert (await browser.ask("POST", "/api/v1/disable", {})).status == 403
        browser.csrf = token
        for headers in (
            {"origin": "https://elsewhere.example"},
            {"origin": "null"},
            {"origin": f"http://127.0.0.1:{bench.port + 1}"},
            {"sec-fetch-site": "cross-site"},
            {"sec-fetch-site": "same-site"},
        ):
            answer = await browser.ask("POST", "/api/v1/disable", {}, headers)
            assert answer.status == 403, headers
        answer = await browser.get("/api/v1/status", **{"sec-fetch-site": "cross-site", "sec-fetch-mode": "cors"})
        assert answer.status == 403


@pytest.mark.parametrize(
    "host", ["evil.example", "evil.example:9464", "127.0.0.1.evil.example", "", "localhost.", "[::2]", "[", "[::1"]
)
async def test_a_foreign_host_name_is_refused_so_that_no_page_reads_by_rebinding(tmp_path, host):
    async with monitor(tmp_path) as bench:
        for path in ("/", "/api/v1/status", "/metrics"):
            assert (await bench.browser().get(path, host=host)).status == 403
        assert (await bench.browser().get("/api/v1/status", host="localhost:1")).status == 200


async def test_wrong_passwords_are_counted_and_then_refused_without_a_check(tmp_path):
    async with monitor(tmp_path, users=accounts_file(tmp_path, anna="viewer")) as bench:
        browser = bench.browser()
        for name in ("anna", "anna", "nobody", "anna", "anna"):
            answer = await browser.login(name, "not the password")
            assert answer.status == 401 and "name or password is wrong" in answer.detail
        answer = await browser.login("anna")
        assert answer.status == 429 and int(answer.headers["retry-after"]) > 0
        await bench.rig.history.flushed()
        assert ("wrong name or password for the monitor ('anna')", "127.0.0.1") in bench.events()


async def test_who_guesses_from_many_addresses_does_not_fill_the_audit(tmp_path):
    """Each check takes 16 ms: five million entries a day, which are kept for ten years."""
    said = []
    accounts = Accounts(accounts_file(tmp_path, anna="viewer"))
    web = Access(accounts=accounts, session_s=1.0, secure=False, report=lambda *words: said.append(words))
    users = AccountUsers(accounts, lambda *words: said.append(words))
    for number in range(30):
        with pytest.raises(ProblemError):
            await web.login(f"n{number}", "not the password", f"fd00::{number}")
        with pytest.raises(LoginRefusedError):
            await users.login(f"n{number}", "not the password", f"fd00::{number}")
    assert len(said) == 20 and said[19] == ("access", "wrong name or password over OPC UA ('n9')", "fd00::9")
    web._wrong.flush()
    users._wrong.flush()
    last = "wrong name or password for the monitor ('n29'), and 19 times more since the one before"
    assert said[20] == ("access", last, "fd00::29") and len(said) == 22


class Asked:
    """What the access looks at of a request."""

    def __init__(self, token):
        self.cookies, self.client, self.headers = {"toolpoint": token}, None, {}


async def test_a_session_ends_by_time_idleness_password_and_removal(tmp_path):
    path, now = accounts_file(tmp_path, anna="viewer", otto="operator"), [0.0]
    found = Access(
        accounts=Accounts(path), session_s=7200.0, secure=False, report=lambda *_: None, now_s=lambda: now[0]
    )

    async def again():
        token, _ = await found.login("anna", PASSWORD, "here")
        return Asked(token)

    asked = await again()
    for _ in range(3):
        now[0] += access.IDLE_S - 1.0
        assert found.by_session(asked).name == "anna"
    now[0] += access.IDLE_S
    assert found.by_session(asked) is None, "idle"
    asked = await again()
    for _ in range(4):
        now[0] += access.IDLE_S - 1.0
        assert found.by_session(asked) is not None
    now[0] += 4.0
    assert found.by_session(asked) is None, "too old"
    asked = await again()
    accounts_file(tmp_path, anna="viewer")
    assert found.by_session(asked) is None, "another password, or the same one set anew"
    asked = await again()
    accounts_file(tmp_path, otto="operator")
    assert found.by_session(asked) is None, "the account is gone"
    for _ in range(access.MOST_SESSIONS + 5):
        found._sessions[str(_)] = access.Session(
            name="x", password_hash="", csrf="", ends_s=0.0, ends_utc_s=0.0, used_s=now[0]
        )
    await found.login("otto", PASSWORD, "here")
    assert len(found._sessions) == access.MOST_SESSIONS


async def test_basic_authorisation_reads_and_never_acts(tmp_path):
    async with monitor(tmp_path, users=accounts_file(tmp_path, anna="engineer")) as bench:
        browser = bench.browser()
        words = {"authorization": "Basic " + base64.b64encode(f"anna:{PASSWORD}".encode()).decode()}
        assert (await browser.get("/api/v1/status", **words)).json["state"] == "OFF"
        assert (await browser.ask("POST", "/api/v1/disable", {}, words)).status == 401
        for given in ("Basic !!!", "Basic \xe9\xe9", "Basic 6Q=="):
            assert (await browser.get("/api/v1/status", authorization=given)).status == 401
        assert (await browser.get("/api/v1/status", authorization="Bearer x")).status == 401
        long = "Basic " + base64.b64encode(b"a" * 9000 + b":x").decode()
        assert (await browser.get("/api/v1/status", authorization=long)).status == 401
        await bench.rig.history.flushed()
        assert max(len(text) for text, _ in bench.events()) < 200, "the audit is not for others to fill"


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(token=st.text(st.characters(codec="latin-1", exclude_characters="\r\n\0;"), max_size=200))
def test_no_token_that_was_not_handed_out_is_a_session(tmp_path, token):
    found = Access(accounts=Accounts(tmp_path / "users"), session_s=1.0, secure=False, report=lambda *_: None)
    scope = {"type": "http", "headers": [(b"cookie", f"toolpoint={token}".encode("latin-1"))]}
    assert found.by_session(Request(scope)) is None


async def test_who_guesses_elsewhere_keeps_nobody_out_where_he_has_logged_in_before(tmp_path):
    path, now = accounts_file(tmp_path, anna="viewer"), [0.0]
    found = Access(
        accounts=Accounts(path), session_s=7200.0, secure=False, report=lambda *_: None, now_s=lambda: now[0]
    )

    async def tried(password, address):
        try:
            await found.login("anna", password, address)
        except ProblemError as refused:
            return refused.status
        return 200

    assert await tried(PASSWORD, "her own") == 200
    assert [await tried("wrong", f"10.0.0.{k}") for k in range(6)] == [401] * 5 + [429], "from wherever it comes"
    assert await tried(PASSWORD, "her own") == 200
    assert await tried(PASSWORD, "a new one") == 429
    assert [await tried("wrong", "her own") for _ in range(6)] == [401] * 5 + [429], "from there it is counted too"
    now[0] += 61.0
    assert await tried(PASSWORD, "her own") == 200 and await tried(PASSWORD, "a new one") == 200


async def test_a_client_with_an_old_password_keeps_nobody_else_of_its_address_out(tmp_path):
    """Behind a gateway or a proxy all have one address, and a program asks again every few seconds."""
    path, now = accounts_file(tmp_path, anna="viewer", otto="viewer"), [0.0]
    found = Access(
        accounts=Accounts(path), session_s=7200.0, secure=False, report=lambda *_: None, now_s=lambda: now[0]
    )
    await found.login("anna", PASSWORD, "the gateway")
    for _ in range(5):
        with pytest.raises(ProblemError):
            await found.login("otto", "wrong", "the gateway")
    await found.login("anna", PASSWORD, "the gateway")
    with pytest.raises(ProblemError, match="too many"):
        await found.login("otto", PASSWORD, "the gateway")


async def test_a_live_stream_of_http_basic_ends_with_its_account(tmp_path):
    path = accounts_file(tmp_path, anna="viewer")
    async with monitor(tmp_path, users=path) as bench:
        reader, writer = await asyncio.open_connection("127.0.0.1", bench.port)
        given = base64.b64encode(f"anna:{PASSWORD}".encode()).decode()
        writer.write(f"GET /api/v1/events HTTP/1.1\r\nHost: localhost\r\nAuthorization: Basic {given}\r\n\r\n".encode())
        await asyncio.wait_for(reader.readuntil(b"event: status"), 20.0)
        accounts_file(tmp_path, otto="viewer")
        await asyncio.wait_for(reader.read(-1), 20.0)
        writer.close()


async def test_a_forwarded_address_counts_from_a_trusted_proxy_alone(tmp_path):
    async def tried(browser, k):
        given = {"name": f"nobody{k}", "password": "wrong"}
        return (await browser.ask("POST", "/api/v1/session", given, {"x-forwarded-for": f"10.9.8.{k}"})).status

    async with monitor(tmp_path, users=accounts_file(tmp_path, anna="viewer")) as bench:
        assert [await tried(bench.browser(), k) for k in range(6)] == [401] * 5 + [429]
        await bench.rig.history.flushed()
        assert {person for _, person in bench.events()} == {"127.0.0.1"}
    (tmp_path / "behind").mkdir()
    proxies = {"users": accounts_file(tmp_path, anna="viewer"), "trusted_proxies": [ip_address("127.0.0.1")]}
    async with monitor(tmp_path / "behind", **proxies) as bench:
        assert [await tried(bench.browser(), k) for k in range(6)] == [401] * 6
        assert [await tried(bench.browser(), 1) for _ in range(5)] == [401] * 4 + [429]
        await bench.rig.history.flushed()
        assert ("wrong name or password for the monitor ('nobody3')", "10.9.8.3") in bench.events()
