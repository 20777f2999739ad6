"""What stands for a broker, a logger and a program is read by the very drivers that read the real ones."""

import asyncio
import json
import time
from contextlib import aclosing
from pathlib import Path
from typing import Any

import pytest

from config.schema.source_drivers import SourceConfig
from drivers import registry
from drivers.clock import SystemClock
from drivers.sim.wires.pushed_wires import follows
from drivers.sim.wires.source_wires import SourceWires

pytestmark = pytest.mark.wires

PLACED = {"component": "Column"}
DEGC = {7: 21.5, 8: -3.25, 9: 40.0}


def read(ids: Any) -> list[float]:
    return [DEGC[each] for each in ids]


def broker(folder: Path, port: int) -> dict[str, Any]:
    sensors = [
        {"id": 7, "topic": "a", "field": "x.y", **PLACED},
        {"id": 8, "topic": "a", "field": "z", "unit": "K", "scale": 0.02, **PLACED},
        {"id": 9, "topic": "b", **PLACED},
    ]
    return {"driver": "mqtt", "mqtt": {"host": "127.0.0.1", "port": port, "sensors": sensors}}


def logger(folder: Path, port: int) -> dict[str, Any]:
    file = {
        "unit_row": True,
        "path": str(folder / "*.csv"),
        "delimiter": ";",
        "decimal": ",",
        "header": "Zeit",
        "time_columns": ["Zeit"],
        "time_format": "%d.%m.%Y %H:%M:%S",
        "time_zone": "Europe/Berlin",
        "poll_period_s": 0.05,
    }
    sensors = [
        {"id": 7, "column": "T7", **PLACED},
        {"id": 8, "column": 3, "unit": "degF", **PLACED},
        {"id": 9, "column": "T9", **PLACED},
    ]
    return {"driver": "csv", "csv": {"file": file, "sensors": sensors}}


def program(folder: Path, port: int) -> dict[str, Any]:
    sensors = [{"id": each, "field": f"t.{each}", **PLACED} for each in DEGC]
    return {"driver": "process", "process": {"command": follows(folder / "lines"), "sensors": sensors}}


@pytest.mark.parametrize("made", [broker, logger, program], ids=lambda made: made.__name__)
async def test_every_cycle_that_is_sent_arrives_with_its_values(
    made: Any, tmp_path: Path, unused_tcp_port: int
) -> None:
    entry = {"name": "it", "cycle_period_s": 1.0, **made(tmp_path, unused_tcp_port)}
    source = SourceConfig.model_validate_json(json.dumps(entry))
    wires = SourceWires([source], read, until_s=2.5, utc_of=lambda time_s: time.time() + time_s - 1.0)
    await wires.open()
    driver = registry.SOURCES[source.driver]()(source, SystemClock())
    cycles, now_s = [], 0.0
    async with asyncio.timeout(20), aclosing(driver.cycles()) as following:
        first = asyncio.ensure_future(anext(following))
        while not first.done():  # a broker sends to nobody before it is heard; a program takes a moment to begin
            now_s = min(now_s + 0.5, 1.0) if made is not program else 1.0
            await wires.step(now_s if wires.cycles_sent["it"] == 0 else 1.5)
            await asyncio.sleep(0.05)
        cycles.append(first.result())
    sent = wires.cycles_sent["it"]
    await wires.step(3.0)
    assert wires.idle
    await wires.close()
    assert sent == 1 and cycles[0].complete and not cycles[0].faults
    assert cycles[0].degc.tolist() == pytest.approx([21.5, -3.25, 40.0], abs=0.01)
