"""What the pages cost in a real browser: bytes, time until a person can act, time to draw a chart.

    python tests/benchmarks/bench_pages.py [--rounds 10]

The monitor of a daemon's parts in this process, Debian's Chromium beside it, both on this computer. A cold load
begins with an empty cache. A chart is timed from the press of a button to the frame that shows it; its series are made
up and answered by the browser itself, so that what is timed is the page: bench_history.py times the store.
"""

import argparse
import asyncio
import gzip
import json
import runpy
import shutil
import statistics
import sys
import tempfile
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, urlsplit

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "support"))

from monitor_bench import monitor
from playwright.async_api import Page, Route, async_playwright

ROOT = Path(__file__).parents[2]
SENSORS = [
    {
        "name": f"temperature.{i}",
        "id": i,
        "component": "Saddle",
        "part": "Left side",
        "label": None,
        "degc": 20.0 + i / 100,
    }
    | {"measured_degc": 20.0, "quality": "good", "reason": "", "age_s": 0.0}
    for i in range(1, 303)
]
ARGUMENTS = ["--no-sandbox", "--disable-gpu", "--disable-background-networking", "--no-first-run"]


def made_up(url: str) -> dict[str, Any]:
    """Return as many values as the page asks for, of each series."""
    query = parse_qs(urlsplit(url).query)
    begin, end, points = float(query["from"][0]), float(query["to"][0]), int(query["points"][0])
    times = [begin + (place + 0.5) * (end - begin) / points for place in range(points)]
    series = {}
    for offset, name in enumerate(query["name"]):
        mean = [20.0 + offset + (place % 97) / 50.0 for place in range(points)]
        series[name] = {"t": times, "mean": mean, "min": [v - 0.2 for v in mean], "max": [v + 0.2 for v in mean]}
    return series


async def cold_load(page: Page, base: str) -> tuple[int, float]:
    """Return the compressed bytes of all answers, and when a person could act [ms]."""
    answers: list[Any] = []
    page.on("response", lambda answer: None if "/events" in answer.url else answers.append(answer))
    await page.goto(f"{base}#/overview")
    await page.wait_for_selector("#state")
    await page.wait_for_function("() => performance.getEntriesByName('interactive').length > 0")
    await page.wait_for_timeout(1000)  # the library of the charts comes after
    size = sum([len(gzip.compress(await answer.body())) for answer in answers])
    return size, await page.evaluate("performance.getEntriesByName('interactive')[0].startTime")


async def drawn_ms(page: Page, base: str, sensors: int, button: str) -> float:
    """Return the time from the press of a range's button until the chart of so many sensors is on the screen [ms]."""

    async def answer(route: Route) -> None:
        await route.fulfill(json=made_up(route.request.url))

    await page.route("**/api/v1/series*", answer)
    await page.route("**/api/v1/sensors", lambda route: route.fulfill(json={"time": 0, "sensors": SENSORS}))
    await page.route("**/api/v1/names", lambda route: route.fulfill(json={"series": [], "first": None, "last": None}))
    await page.goto(f"{base}#/temperatures")
    await page.wait_for_selector("canvas")
    chosen = page.locator("table.sensors input[type=checkbox]")
    for place in range(8):
        if await chosen.nth(place).is_checked() != (place < sensors):
            await chosen.nth(place).click()
    await page.wait_for_timeout(500)  # the charts of these clicks are over
    await page.evaluate("performance.clearMeasures()")
    await page.get_by_role("button", name=button, exact=True).click()
    await page.wait_for_function("() => performance.getEntriesByType('measure').length > 0")
    measure = "performance.getEntriesByType('measure').at(-1)"
    assert (await page.evaluate(f"{measure}.name")).startswith(f"temperatures {sensors} "), "as many as were asked for"
    return float(await page.evaluate(f"{measure}.duration"))


async def measure(rounds: int) -> None:
    loads, eight, one, size = [], [], [], 0
    with tempfile.TemporaryDirectory() as name:
        async with monitor(Path(name)) as bench, async_playwright() as playwright:
            await bench.rig.active()
            base = f"http://127.0.0.1:{bench.port}/"
            browser = await playwright.chromium.launch(executable_path=shutil.which("chromium"), args=ARGUMENTS)
            for _ in range(rounds):
                context = await browser.new_context(viewport={"width": 1280, "height": 900})
                size, ready_ms = await cold_load(await context.new_page(), base)
                loads.append(ready_ms)
                eight.append(await drawn_ms(await context.new_page(), base, 8, "24 h"))
                one.append(await drawn_ms(await context.new_page(), base, 1, "1 year"))
                await context.close()
            await browser.close()
    print(json.dumps({"overview_compressed_bytes": size, "rounds": rounds}))
    for words, values in (("interactive, cold", loads), ("24 h, drawn", eight), ("a year of one sensor, drawn", one)):
        print(f"{words}: median {statistics.median(values):.0f} ms, slowest {max(values):.0f} ms")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=10)
    options = parser.parse_args()
    runpy.run_path(str(ROOT / "hatch_build.py"))["put_files"](ROOT)
    asyncio.run(measure(options.rounds))


if __name__ == "__main__":
    main()
