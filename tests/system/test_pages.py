"""The pages of the monitor in a real browser: against the demonstration, and against the parts of a daemon."""

import asyncio
import contextlib
import gzip
import os
import re
import runpy
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import AsyncIterator, Iterator
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit
from zoneinfo import ZoneInfo

import history_records as make
import numpy as np
import pytest
import pytest_asyncio
from control_rig import HandClock, Rig, record_for, running
from memory_cnc import MemoryNc
from monitor_bench import PASSWORD, MonitorBench, accounts_file, monitor, parts_of
from playwright.async_api import Browser, Page, Route, async_playwright, expect
from sloped_machine import TRAVEL_MM, configured, content, proved
from speed_rig import SAFE, SpeedRig

from daemon.monitor.accounts import write_accounts
from daemon.monitor.web.serving import serve_monitor
from daemon.simulation.processes import free_port
from daemon.snapshots import LinkSnapshot
from models.control.state import OperatorRequest

ROOT = Path(__file__).parents[2]
pytestmark = pytest.mark.asyncio(loop_scope="module")
BUILD = runpy.run_path(str(ROOT / "hatch_build.py"))
CHROMIUM = shutil.which("chromium")
PATIENCE_MS = 120_000
"""For a computer that is busy with something else: the tests wait for what they name, never for a time."""
PAGES = ("overview", "temperatures", "thermal-error", "dynamics", "latency", "history", "models", "messages")
MOST_COMPRESSED = 100_000
"""All of the overview, compressed [byte]."""

if CHROMIUM is None and not os.environ.get("CI"):
    pytest.skip("no chromium on this computer: apt install chromium", allow_module_level=True)


@pytest.fixture(scope="module", autouse=True)
def charts() -> None:
    """A tree of sources that was never installed lacks what the build puts beside the pages."""
    BUILD["put_files"](ROOT)


@pytest.fixture(scope="module")
def axe(tmp_path_factory: pytest.TempPathFactory) -> str:
    """Return the check of accessibility, a script."""
    folder = tmp_path_factory.mktemp("axe")
    for name in ("package.json", "package-lock.json", ".npmrc"):
        shutil.copy(ROOT / name, folder)
    BUILD["install_packages"](folder)
    return (folder / "node_modules/axe-core/axe.min.js").read_text("utf-8")


STARTED: list[Browser] = []


@pytest_asyncio.fixture(scope="module", loop_scope="module", autouse=True)
async def started() -> AsyncIterator[None]:
    """Start a browser for all of these tests: that takes longer than most of them."""
    async with async_playwright() as playwright:
        arguments = ["--no-sandbox", "--disable-gpu", "--disable-background-networking", "--no-first-run"]
        STARTED.append(await playwright.chromium.launch(executable_path=CHROMIUM, args=arguments))
        yield
        await STARTED.pop().close()


@contextlib.asynccontextmanager
async def chromium() -> AsyncIterator[Browser]:
    """Yield the browser; what a test has opened in it is closed with the test, cookies and all."""
    (browser,) = STARTED
    try:
        yield browser
    finally:
        for context in browser.contexts:
            await context.close()


class Watched:
    """A page, and what it should not do."""

    def __init__(self, page: Page, base: str) -> None:
        self.page, self.base = page, base
        self.said: list[str] = []
        self.elsewhere: list[str] = []
        page.set_default_timeout(PATIENCE_MS)
        page.on("console", lambda message: self.said.append(message.text) if message.type == "error" else None)
        page.on("pageerror", lambda error: self.said.append(str(error)))
        page.on("request", lambda request: self._asked(request.url))

    def _asked(self, url: str) -> None:
        if urlsplit(url).netloc != urlsplit(self.base).netloc and not url.startswith("data:"):
            self.elsewhere.append(url)

    async def open(self, name: str) -> None:
        await self.page.goto(f"{self.base}#/{name}")
        await expect(self.page.locator(f"main[data-page={name}] .card").first).to_be_visible(timeout=PATIENCE_MS)

    async def text(self, selector: str) -> str:
        return await self.page.locator(selector).first.inner_text()


async def watched(browser: Browser, base: str, **context: Any) -> Watched:
    return Watched(await (await browser.new_context(**context)).new_page(), base)


@contextlib.asynccontextmanager
async def overview(base: str) -> AsyncIterator[Watched]:
    """Open the overview, with nothing of another test."""
    async with chromium() as browser:
        seen = await watched(browser, base)
        await seen.open("overview")
        yield seen


async def broken_rules(page: Page, axe: str) -> list[str]:
    """Return the rules of accessibility that the page breaks, each with the first element."""
    await page.evaluate(axe)  # as the debugger does: the policy of the page forbids scripts in it
    found = await page.evaluate("axe.run(document, {resultTypes: ['violations']})")
    return [
        f"{rule['id']}: {rule['nodes'][0]['html'][:160]} {rule['nodes'][0]['failureSummary'][:200]}"
        for rule in found["violations"]
    ]


# --- the demonstration as a person starts it ---------------------------------------------


@pytest.fixture(scope="module")
def demo() -> Iterator[tuple[str, "subprocess.Popen[str]"]]:
    """Start `toolpoint demo` and yield the address that it prints first."""
    command = [sys.executable, "-P", "-m", "daemon.cli", "demo", "--headless", "--web-port", "18080"]
    command += ["--minutes", "10000", "--speed", "20"]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True, start_new_session=True)
    assert process.stderr is not None
    first = process.stderr.readline()
    threading.Thread(target=process.stderr.read, daemon=True).start()
    address = re.search(r"http://127\.0\.0\.1:\d+/", first)
    try:
        assert address is not None, first
        wait_until_served(address[0], process)
        yield address[0], process
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGTERM)
        process.wait()


def wait_until_served(base: str, process: "subprocess.Popen[str]") -> None:
    port = urlsplit(base).port
    assert port is not None
    while process.poll() is None:
        with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", port)):
            return
        time.sleep(0.2)
    raise AssertionError(f"the demonstration ended with status {process.returncode}")


@pytest.mark.wires
async def test_every_page_against_the_running_demonstration(demo, axe):
    base, _ = demo
    broken: dict[str, list[str]] = {}
    async with chromium() as browser:
        for scheme, width in (("light", 1280), ("dark", 360)):
            seen = await watched(browser, base, color_scheme=scheme, viewport={"width": width, "height": 900})
            for name in PAGES:
                await seen.open(name)
                if rules := await broken_rules(seen.page, axe):
                    broken[f"{name}, {scheme}"] = rules
                wide = await seen.page.evaluate("document.documentElement.scrollWidth - innerWidth")
                assert wide <= 0, f"{name} is {wide} pixels wider than {width}"
                cut = await seen.page.evaluate(CUT)
                assert cut == (["Sketch of the machine"] if (name, width) == ("temperatures", 360) else []), (
                    name,
                    width,
                )
            expected = [text for text in seen.said if "404" not in text]  # dynamics are not configured
            assert (expected, seen.elsewhere) == ([], [])
        await seen.page.set_viewport_size({"width": 800, "height": 900})
        heights = [await seen.page.locator(each).first.evaluate("e => e.offsetHeight") for each in ("nav", "nav a")]
        assert heights[0] < 2 * heights[1], "the names of the pages stand in more than one line"
    assert broken == {}


CUT = """[...document.querySelectorAll('main .scroll')].filter(one => one.scrollWidth > one.clientWidth + 1
  && !one.querySelector('.writes')).map(one => one.ariaLabel)"""
"""Parts of a page that must be moved sideways to be seen, but for the writes, which are wide on any screen."""


@pytest.mark.wires
async def test_how_much_and_how_fast(demo, capsys):
    base, _ = demo
    async with chromium() as browser:
        seen = await watched(browser, base)
        sizes: list[int] = []
        bodies = []
        seen.page.on("response", lambda response: bodies.append(response) if "/events" not in response.url else None)
        await seen.open("overview")
        await expect(seen.page.locator("figure canvas").first).to_be_visible(timeout=PATIENCE_MS)
        for response in bodies:
            sizes.append(len(gzip.compress(await response.body())))
        marks = "performance.getEntriesByName('interactive')[0].startTime"
        interactive_ms = await seen.page.evaluate(marks)
        await seen.open("temperatures")
        await expect(seen.page.locator("figure canvas").first).to_be_visible(timeout=PATIENCE_MS)
        drawn = await seen.page.evaluate(
            "performance.getEntriesByType('measure').map(one => `${one.name}: ${one.duration.toFixed(0)} ms`)"
        )
    with capsys.disabled():
        print(f"\noverview: {sum(sizes)} byte compressed in {len(sizes)} answers, interactive {interactive_ms:.0f} ms")
        print(f"drawn, from the question on: {drawn}")
    assert sum(sizes) <= MOST_COMPRESSED


@pytest.mark.wires
async def test_a_sheet_of_paper_names_the_machine_and_cuts_nothing_off(demo):
    """The newest values lay beyond the edge, in the colours of the dark, and tables ended after four rows."""
    base, _ = demo
    async with chromium() as browser:
        seen = await watched(browser, base, color_scheme="dark", viewport={"width": 1280, "height": 900})
        for name in ("overview", "history"):
            await seen.open(name)
            await expect(seen.page.locator("canvas, .writes tbody tr").first).to_be_visible(timeout=PATIENCE_MS)
            await seen.page.evaluate("dispatchEvent(new Event('beforeprint'))")
            await seen.page.emulate_media(media="print")
            await seen.page.set_viewport_size({"width": 718, "height": 900})
            assert await seen.page.evaluate(BEYOND) == [], name
            await expect(seen.page.locator("#machine")).to_have_text("simulated CFRP machine tool")
            await expect(seen.page.locator("h1")).to_be_visible()
            assert await seen.page.evaluate("getComputedStyle(document.body).colorScheme") == "light"
            await seen.page.set_viewport_size({"width": 1280, "height": 900})
            await seen.page.emulate_media(media="screen")
            await seen.page.evaluate("dispatchEvent(new Event('afterprint'))")
            assert await seen.page.evaluate("document.documentElement.dataset.theme") is None


BEYOND = """[...document.querySelectorAll('main canvas, main table')].filter(one => {
  const { right, bottom } = one.getBoundingClientRect();
  const frame = (one.closest('.scroll') ?? one.closest('.card')).getBoundingClientRect();
  return right > one.closest('.card').getBoundingClientRect().right || bottom > frame.bottom + 1;
}).map(one => one.className || one.tagName)"""


@pytest.mark.wires
async def test_when_the_daemon_stops_the_page_goes_stale_with_a_sentence(demo):
    base, process = demo
    async with overview(base) as seen:
        await expect(seen.page.locator("#age")).to_contain_text("live", timeout=PATIENCE_MS)
        process.terminate()  # the demo ends its daemon, which it would otherwise leave behind
        await expect(seen.page.locator("#stale")).to_contain_text("has not answered", timeout=PATIENCE_MS)
        assert "stale" in (await seen.page.locator("body").get_attribute("class") or "")
        assert "(old)" in await seen.page.title()


# --- a daemon's parts, where a test can do what a person at the machine would not ----------------


async def test_a_fault_appears_with_its_reason_and_what_to_do(tmp_path):
    async with monitor(tmp_path) as bench, chromium() as browser:
        await bench.rig.active()
        seen = await watched(browser, f"http://127.0.0.1:{bench.port}/")
        await seen.open("overview")
        await expect(seen.page.locator("#state")).to_contain_text("ACTIVE")
        bench.rig.nc.macros.set(502, 0.5)  # somebody at the control
        while bench.rig.state != "FAULT":
            await bench.rig.turn()
        await expect(seen.page.locator("#state")).to_contain_text("FAULT", timeout=PATIENCE_MS)
        assert "FAULT" in await seen.page.title()
        await expect(seen.page.locator("ul.checks").first).to_contain_text("What is switched on waits")
        await expect(seen.page.locator(".state .todo")).to_contain_text("What to do: ", timeout=PATIENCE_MS)
        asked = await seen.page.evaluate("performance.getEntriesByType('resource').map(one => one.name)")
        tables = [address.rsplit("/", 1)[1] for address in asked if address.endswith(".md")]
        assert tables == ["remedies.md"], "the whole manual is three times as large"
        await seen.page.get_by_role("link", name="All messages").click()
        await seen.page.locator("#search").fill("another program writes")
        await expect(seen.page.locator("table.messages tbody tr").first).to_be_visible(timeout=PATIENCE_MS)
        assert (seen.said, seen.elsewhere) == ([], [])


async def test_an_axis_with_a_slope_says_where_its_numbers_hold_and_what_is_not_judged(tmp_path):
    given, port = content(tmp_path), free_port()
    given["cnc"]["axis_positions"] = {"Z_mm": {"axis": "Z", "travel_mm": TRAVEL_MM, "rapid_mm_per_min": 30000.0}}
    given["displacements"] = {
        "file": {"path": "/srv/d.csv", "header": "t"},
        "channels": [{"name": "Z1", "column": "Z"}],
    }
    given["service"]["http_port"] = port
    configuration, clock = configured(given), HandClock()
    rig = Rig(configuration, MemoryNc(configuration, clock), clock, record=record_for(configuration, axes=proved()))
    said = {"channels": ("Z1", "Z1_per_m"), "thermal_error_um": np.array([-20.0, 80.0]), "band_um": np.full(2, 2.0)}

    async def measured(mm: float) -> None:
        rig.nc.positions_mm["Z_mm"] = mm
        for _ in range(150):
            await rig.turn(rig.estimate(0.0, 0.0, **said))
            row = make.displacement(clock.now().utc_s, np.array([3.0]))
            rig.history.displacement(row)
        rig.snapshots.thermal = replace(rig.snapshots.thermal, estimate=rig.estimate(0.0, 0.0, **said))
        await rig.history.flushed()

    async with running(rig), chromium() as browser:
        rig.nc.positions_mm["Z_mm"] = 480.0
        await rig.turn()
        rig.set_reference()
        await measured(480.0)
        serving = asyncio.Event()
        task = asyncio.create_task(serve_monitor(parts_of(rig, configuration), serving.set))
        await serving.wait()
        seen = await watched(browser, f"http://127.0.0.1:{port}/")
        await seen.open("overview")
        await expect(seen.page.locator("#axis-z")).to_contain_text("at 250 mm", timeout=PATIENCE_MS)
        await expect(seen.page.locator("#axis-z_slope")).to_contain_text("µm/m")
        await expect(seen.page.locator("main")).to_contain_text("At 250 mm, the pivot of the axis' slope")
        await seen.open("thermal-error")
        page = seen.page.locator("main")
        await expect(page).to_contain_text(
            "estimated at 250 mm, the slope's pivot; measured at 480 mm", timeout=PATIENCE_MS
        )
        await expect(page).to_contain_text("What was measured, where the axis stood, is not drawn")
        await measured(20.0)
        await seen.page.reload()
        await expect(page).to_contain_text(
            "not judged: axis z stood at 480 mm at the reference and stands at 20 mm now"
        )
        assert (seen.said, seen.elsewhere) == ([], [])
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)


async def test_a_keyboard_alone_reaches_a_sensor_of_another_page(tmp_path):
    async with monitor(tmp_path) as bench, chromium() as browser:
        await bench.rig.active()
        seen = await watched(browser, f"http://127.0.0.1:{bench.port}/")
        await seen.open("overview")
        await press_until(seen.page, "document.activeElement.hash === '#/temperatures'", "Enter")
        await expect(seen.page.locator("main[data-page=temperatures] .card").first).to_be_visible(timeout=PATIENCE_MS)
        sensor = "document.activeElement.type === 'checkbox' && !document.activeElement.checked"
        await press_until(seen.page, sensor, "Space")
        await expect(seen.page.locator("table.sensors input:checked").first).to_be_visible(timeout=PATIENCE_MS)


async def press_until(page: Page, there: str, key: str) -> None:
    """Press Tab until the focus is there, then the key."""
    for _ in range(200):
        await page.keyboard.press("Tab")
        if await page.evaluate(there):
            await page.keyboard.press(key)
            return
    raise AssertionError(f"the keyboard does not reach what {there}")


async def test_what_happened_stands_on_the_history_in_the_time_of_the_browser_and_by_kind(tmp_path):
    async with monitor(tmp_path) as bench, chromium() as browser:
        await bench.rig.active()
        bench.rig.history.event("fault", "macro #802 holds 3, we wrote 2", "daemon")
        bench.rig.history.event("refused", "enable z: <b>not</b> commissioned", "anna")
        await bench.rig.history.flushed()
        at = datetime.fromtimestamp(bench.rig.clock.now().utc_s, ZoneInfo("Asia/Kathmandu"))
        bench.rig.clock.monotonic_s += 60.0
        seen = await watched(browser, f"http://127.0.0.1:{bench.port}/", timezone_id="Asia/Kathmandu")
        await seen.open("overview")
        await seen.page.get_by_role("link", name="What happened before").click()
        rows = seen.page.locator("table.events tbody tr")
        await expect(rows.first).to_contain_text("enable z: <b>not</b> commissioned", timeout=PATIENCE_MS)
        await expect(rows.first).to_contain_text("anna")
        await expect(rows.first).to_contain_text(f"{at:%Y-%m-%d %H:%M}")
        await expect(seen.page.locator("main")).to_contain_text("UTC+5:45")
        await seen.page.get_by_label("kind").select_option(label="fault (1)")
        await expect(rows).to_have_count(1)
        await expect(rows).to_contain_text("macro #802 holds 3")
        await seen.page.get_by_label("find").fill("zzz")
        await seen.page.keyboard.press("Enter")
        await expect(seen.page.locator("main")).to_contain_text("0 events")
        assert seen.said == []


LOST: tuple[tuple[str, list[str]], ...] = (
    (
        "line spindle: port /dev/ttyUSB0 has been silent for 30 s: check the cable and the power of the nodes (a pass "
        "is expected every 10 s)",
        [],
    ),
    ("line saddle: not received: sensor 148 (ID 018h)", ["check the nodes and the cable between them"]),
    ("source logger: file /srv/temperatures/*.csv: no file matches", []),
)


async def test_what_has_held_too_long_is_to_be_switched_on_and_a_band_is_drawn_between_samples_too(tmp_path):
    sentence = (
        "held too long, so a person must switch it on again; the reason then: no valid reference: the NC program has "
        "not passed its positioning"
    )
    asked = f"import('/messages.js').then(async (all) => {{ await all.load(); return all.remedies('{sentence}'); }})"
    async with monitor(tmp_path) as bench, overview(f"http://127.0.0.1:{bench.port}/") as seen:
        first, then = await seen.page.evaluate(asked)
        for sentence, remedy in LOST:  # the links' sentences, within frames that need nothing done
            asked = f"import('/messages.js').then((all) => all.remedies('{sentence}'))"
            assert await seen.page.evaluate(asked) == remedy, sentence
        edges = "import('/series.js').then((all) => all.beside([0, undefined, 2, null, 1], [1, undefined, 1, 1, 1]))"
        assert await seen.page.evaluate(edges) == [[1, 2, 3, None, 2], [-1, 0, 1, None, 0]]
    assert "switch on again" in first and "position" in then


async def test_a_write_that_a_lost_connection_took_is_to_be_looked_up_and_is_no_failure_for_ever(tmp_path):
    async with monitor(tmp_path) as bench, chromium() as browser:
        await bench.rig.active()
        bench.rig.control.writer.counts["sent"] += 1
        await bench.rig.turn()
        seen = await watched(browser, f"http://127.0.0.1:{bench.port}/")
        await seen.open("overview")
        line = seen.page.locator("ul.checks li", has_text="writes read back equal")
        await expect(line).to_have_class("wait")
        await expect(line).to_contain_text("what became of the others: History, by outcome")


async def test_a_link_that_is_back_says_when_it_was_lost_and_a_long_name_widens_no_page(tmp_path):
    lost = {"attempts": 2, "failures": 1, "losses": 1, "last_problem": "no answer", "last_problem_utc_s": 1.75e9}
    async with monitor(tmp_path) as bench, chromium() as browser:
        bench.rig.snapshots.links = (LinkSnapshot(name="cnc", up=True, problem="", **lost),)
        bench.rig.snapshots.links += (LinkSnapshot(name="modbus " + "Betriebswerk" * 12, up=True, problem="", **lost),)
        seen = await watched(browser, f"http://127.0.0.1:{bench.port}/", timezone_id="Europe/Berlin")
        await seen.open("overview")
        await expect(seen.page.locator("main")).to_contain_text("lost once, 2025-06-15 17:06:40: no answer")
        assert await seen.page.evaluate("document.documentElement.scrollWidth <= innerWidth")
        assert seen.said == []


async def test_what_is_switched_off_and_back_at_the_offset_of_its_reference_is_not_said_to_move(tmp_path):
    """Until the reference ended the page said that it was being taken back, and `on`."""
    async with monitor(tmp_path) as bench, chromium() as browser:
        await bench.rig.active()
        await bench.rig.follow(0.0, 3.0)
        bench.rig.set_reference("r2")
        await bench.rig.follow(0.0, 0.0)
        await bench.rig.follow(0.0, 3.0)
        bench.rig.control.request(OperatorRequest(disable=frozenset(("y", "z"))), "a person")
        await bench.rig.follow(0.0, 3.0, 1)
        seen = await watched(browser, f"http://127.0.0.1:{bench.port}/")
        await seen.open("overview")
        await expect(seen.page.locator("#state")).to_contain_text("is being taken back slowly")
        await expect(seen.page.locator("#axis-z .tag")).to_have_text("off")
        await bench.rig.follow(0.0, 3.0)
        assert bench.rig.state == "RETREAT" and bench.rig.applied["z"] == pytest.approx(-3.0)
        await expect(seen.page.locator("#state")).to_contain_text("back where it was when the reference was set")


async def test_switching_on_takes_the_right_and_a_confirmation(tmp_path):
    users = accounts_file(tmp_path, anna="operator", ben="viewer")
    async with monitor(tmp_path, users=users) as bench, chromium() as browser:
        await bench.rig.turn()
        bench.rig.set_reference()
        base = f"http://127.0.0.1:{bench.port}/"
        viewer = await watched(browser, base)
        await log_in(viewer, "ben")
        await expect(viewer.page.locator("#state")).to_be_visible(timeout=PATIENCE_MS)
        assert await viewer.page.locator("#do-enable").count() == 0
        refused = await viewer.page.evaluate(
            "async () => { const {csrf} = await (await fetch('/api/v1/session')).json();"
            " const answer = await fetch('/api/v1/enable', {method: 'POST', body: '{}',"
            " headers: {'content-type': 'application/json', 'x-csrf-token': csrf}});"
            " return [answer.status, (await answer.json()).detail]; }"
        )
        assert refused[0] == 403 and "operator" in refused[1]
        operator = await watched(browser, base)
        await log_in(operator, "anna")
        await operator.page.locator("#do-enable").click()
        await expect(operator.page.locator("dialog")).to_contain_text("Switch compensation on?")
        assert not any(bench.rig.snapshots.control.wanted)
        turning = asyncio.create_task(keep_turning(bench))
        await operator.page.locator("dialog button[type=submit]").click()
        await expect(operator.page.locator("#do-disable")).to_be_visible(timeout=PATIENCE_MS)
        turning.cancel()
        assert any(bench.rig.snapshots.control.wanted)


async def test_a_second_click_asks_once_and_a_login_that_ended_is_asked_for_again(tmp_path):
    users = accounts_file(tmp_path, anna="operator")
    async with monitor(tmp_path, users=users) as bench, chromium() as browser:
        await bench.rig.active()
        seen = await watched(browser, f"http://127.0.0.1:{bench.port}/")
        await log_in(seen, "anna")
        await expect(seen.page.locator("#logout")).to_be_visible(timeout=PATIENCE_MS)
        asked: list[str] = []
        seen.page.on("request", lambda request: asked.append(request.url) if request.method == "POST" else None)
        await seen.page.locator("#do-disable").click()
        await seen.page.locator("dialog button[type=submit]").dblclick()
        turning = asyncio.create_task(keep_following(bench))
        await expect(seen.page.locator("#state")).to_contain_text("OFF", timeout=PATIENCE_MS)
        turning.cancel()
        assert [url.rsplit("/", 1)[1] for url in asked] == ["disable"]
        await seen.page.locator("#do-enable").click()
        write_accounts(users, {})
        await seen.page.locator("dialog button[type=submit]").click()
        await expect(seen.page.locator("dialog input[name=password]")).to_be_visible(timeout=PATIENCE_MS)


async def test_an_acknowledgement_says_that_the_axes_follow_again_and_they_do(tmp_path):
    async with monitor(tmp_path, users=accounts_file(tmp_path, anna="operator")) as bench, chromium() as browser:
        await bench.rig.active()
        bench.rig.control.journal.raise_fault("read-back differs: #501")
        await bench.rig.turn()
        assert bench.rig.state == "FAULT"
        seen = await watched(browser, f"http://127.0.0.1:{bench.port}/")
        await log_in(seen, "anna")
        await seen.page.locator("#do-acknowledge").click()
        await expect(seen.page.locator("dialog")).to_contain_text("holds what the CNC applies")
        await expect(seen.page.locator("dialog")).to_contain_text("follow again by themselves")
        turning = asyncio.create_task(keep_following(bench))
        await seen.page.locator("dialog button[type=submit]").click()
        await expect(seen.page.locator("#state")).to_contain_text("ACTIVE", timeout=PATIENCE_MS)
        turning.cancel()


async def keep_following(bench: MonitorBench) -> None:
    while True:
        await bench.rig.follow(0.0, 0.0, 1)
        await asyncio.sleep(0.05)


async def test_lobes_response_and_working_point_are_drawn_and_an_engineer_ends_the_tuning(tmp_path):
    bench, port = SpeedRig(tmp_path), free_port()
    users = accounts_file(tmp_path, eva="engineer")
    service = bench.configuration.service.model_copy(update={"http_port": port, "users": users})
    configuration = bench.configuration.model_copy(update={"service": service})
    async with running(bench.rig), chromium() as browser:
        await bench.rig.turn()
        await bench.operation()
        bench.rig.snapshots.spindle_speed = bench.speed.snapshot()
        serving = asyncio.Event()
        task = asyncio.create_task(serve_monitor(parts_of(bench.rig, configuration), serving.set))
        await serving.wait()
        seen = await watched(browser, f"http://127.0.0.1:{port}/")
        await log_in(seen, "eva")
        await expect(seen.page.locator("#do-disable-speed")).to_be_visible(timeout=PATIENCE_MS)
        seen.said.clear()  # that nobody was logged in
        await seen.open("dynamics")
        await expect(seen.page.locator("canvas")).to_have_count(3, timeout=PATIENCE_MS)
        assert "TUNED" in await seen.text("main") and "2.00 mm" in await seen.text("main")
        assert (seen.said, seen.elsewhere) == ([], [])
        if folder := os.environ.get("TOOLPOINT_PICTURES"):
            await seen.page.screenshot(path=Path(folder) / "dynamics.png", full_page=True)
        await seen.open("overview")
        await seen.page.locator("#do-disable-speed").click()
        turning = asyncio.create_task(keep_cutting(bench))
        await seen.page.locator("dialog button[type=submit]").click()
        await expect(seen.page.locator("#do-enable-speed")).to_be_visible(timeout=PATIENCE_MS)
        turning.cancel()
        assert not bench.speed.snapshot().switched_on
        bench.rig.snapshots.control = replace(bench.rig.snapshots.control, cnc=None)
        await expect(seen.page.locator("dt:has-text('commanded') + dd")).to_have_text("not known")
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)


async def test_the_page_lives_on_after_a_restart_and_takes_the_pages_of_another_version(tmp_path, monkeypatch):
    async with monitor(tmp_path) as bench, chromium() as browser:
        await bench.rig.turn()
        seen = await watched(browser, f"http://127.0.0.1:{bench.port}/")
        await seen.open("overview")
        await expect(seen.page.locator("#age")).to_contain_text("live", timeout=PATIENCE_MS)
        await seen.page.evaluate("window.before = true")
        bench.task.cancel()
        await expect(seen.page.locator("#stale")).to_be_visible(timeout=PATIENCE_MS)
        monkeypatch.setattr("daemon.monitor.web.documents.VERSION", "9.9.9")
        again = asyncio.create_task(serve_monitor(parts_of(bench.rig, bench.configuration)))
        await expect(seen.page.locator("#foot")).to_contain_text("9.9.9", timeout=PATIENCE_MS)
        assert await seen.page.evaluate("window.before") is None
        await expect(seen.page.locator("#stale")).to_be_hidden(timeout=PATIENCE_MS)
        again.cancel()
        await asyncio.gather(again, return_exceptions=True)


async def test_a_late_answer_fills_no_other_page_and_a_page_that_failed_is_asked_for_again(tmp_path):
    asked, answer = asyncio.Event(), asyncio.Event()

    async def late(route: Route) -> None:
        asked.set()
        await answer.wait()
        await route.continue_()

    async with monitor(tmp_path) as bench, overview(f"http://127.0.0.1:{bench.port}/") as seen:
        main = seen.page.locator("main")
        await seen.page.route("**/api/v1/models", late)
        await seen.page.goto(f"{seen.base}#/models")
        await asked.wait()
        assert "daemon" in await main.evaluate("main => getComputedStyle(main.firstElementChild, '::before').content")
        await seen.open("overview")
        async with seen.page.expect_response("**/api/v1/models"):
            answer.set()
        assert await main.locator("h1").all_inner_texts() == ["Overview"]
        await bench.rig.active()
        await expect(seen.page.locator("#state")).to_contain_text("ACTIVE")
        await expect(seen.page.locator("figure .legend")).to_contain_text("without compensation 0.0 µm")
        await bench.rig.follow(0.0, -9.0, 3)
        await expect(seen.page.locator("figure .legend")).to_contain_text("without compensation −9.0 µm")
        await seen.page.route("**/api/v1/sensors", lambda route: route.abort())
        await seen.page.goto(f"{seen.base}#/temperatures")
        await expect(main).to_contain_text("tried again by itself")
        await seen.page.unroute("**/api/v1/sensors")
        await expect(main).to_contain_text("Chosen temperatures")
        await expect(main).to_contain_text("No temperature has arrived yet")
        answer.clear()
        held: list[Route] = []

        async def first_late(route: Route) -> None:
            held.append(route)
            if len(held) == 1:
                await answer.wait()
            await route.continue_()

        await seen.page.route("**/api/v1/series*", first_late)
        unchosen, curves = main.locator("input[type=checkbox]:not(:checked)").first, main.locator("figure .legend .key")
        before = await curves.count()
        await unchosen.click()
        await unchosen.click()
        await expect(curves).to_have_count(before + 2)
        async with seen.page.expect_response("**/api/v1/series*"):
            answer.set()
        await seen.page.wait_for_timeout(300)
        assert await curves.count() == before + 2


async def log_in(seen: Watched, name: str) -> None:
    await seen.page.goto(seen.base)
    await seen.page.locator("dialog input[name=name]").fill(name)
    await seen.page.locator("dialog input[name=password]").fill(PASSWORD)
    await seen.page.locator("dialog button[type=submit]").click()


async def keep_cutting(bench: SpeedRig) -> None:
    while True:
        await bench.pass_by(1.0, SAFE)
        bench.rig.snapshots.spindle_speed = bench.speed.snapshot()
        await asyncio.sleep(0.05)


async def keep_turning(bench: MonitorBench) -> None:
    while True:
        await bench.rig.turn()
        await asyncio.sleep(0.05)
