"""The speed at which the spindle turns: an override or another S word makes of the taken speed one that was not cut."""

import itertools
import math
from pathlib import Path

import pytest
from history_records import cnc_sample
from speed_machine import speed_machine
from speed_rig import CUT, SAFE, SpeedRig, turned

from daemon.history.reader import HistoryReader
from daemon.spindle_speed.turning import TurningSpeed
from models.records import Phase

bench = turned

WARM, HOT = 36.0, 46.0


async def events(bench: SpeedRig) -> list[str]:
    await bench.rig.history.flushed()
    with HistoryReader(bench.rig.configuration.history.path) as reader:
        return [event.text for event in reader.events(0.0, 1e12) if "the spindle turns at" in event.text]


async def test_an_override_is_told_once_and_when_it_has_gone(bench: SpeedRig) -> None:
    taken_rpm = (await bench.operation())[0]
    bench.nc.spindle_speed_rpm = 0.9 * taken_rpm
    await bench.pass_by(8.0, CUT)
    assert bench.picture()["alarm"] == "", "a spindle may take its time"
    await bench.pass_by(30.0, CUT)
    told = f"the spindle turns at {0.9 * taken_rpm:.0f} 1/min and the NC has taken {taken_rpm:.0f}"
    assert told in bench.picture()["alarm"]
    await bench.pass_by(5.0, SAFE)
    await bench.pass_by(30.0, CUT)
    assert told in bench.picture()["alarm"]
    bench.nc.spindle_speed_rpm = taken_rpm
    await bench.pass_by(5.0, CUT)
    assert bench.picture()["alarm"] == ""
    assert len(await events(bench)) == 1, "it may come back with the next pass"
    await bench.pass_by(180.0, CUT)
    said = await events(bench)
    assert len(said) == 2 and told in said[0] and said[1].startswith("over for 3 min: ") and told in said[1]


@pytest.mark.parametrize("actual", [1.015, -0.99, math.nan, 0.0])
async def test_what_is_within_the_tolerance_or_turned_the_other_way_or_not_told_is_none(
    bench: SpeedRig, actual: float
) -> None:
    taken_rpm = (await bench.operation())[0]
    bench.nc.spindle_speed_rpm = actual * taken_rpm
    await bench.pass_by(60.0, CUT)
    assert bench.picture()["alarm"] == "" and await events(bench) == []


@pytest.mark.parametrize(("share", "steps"), [(0.9, False), (0.0, False), (1.0, True)])
async def test_no_second_step_before_a_cut_at_the_speed_of_the_first(
    bench: SpeedRig, share: float, steps: bool
) -> None:
    """A cut at another speed says nothing of the one that was taken."""
    first_rpm = (await bench.operation())[0]
    bench.nc.spindle_speed_rpm = share * first_rpm
    bench.degc = WARM
    await bench.pass_by(90.0, CUT)
    await bench.pass_by(30.0, SAFE)
    assert (bench.call()[0] != first_rpm) is steps


async def test_a_cut_at_a_speed_that_the_warming_spindle_has_outgrown_is_told(bench: SpeedRig) -> None:
    """One call before each pass: it takes what was decided before the pass before, and nothing changes within a cut."""
    taken_rpm = (await bench.operation())[0]
    await bench.pass_by(10.0, CUT)
    assert bench.picture()["alarm"] == ""
    bench.degc = HOT
    await bench.pass_by(90.0, CUT)
    assert bench.call()[0] == taken_rpm
    await bench.pass_by(15.0, CUT)
    assert f"the spindle cuts at {taken_rpm:.0f} 1/min" in bench.picture()["alarm"]
    for _ in range(5):
        await bench.pass_by(25.0, SAFE)
        bench.call()
        await bench.pass_by(3.0, CUT)
    assert bench.picture()["alarm"] == ""


def test_an_outgrown_speed_is_told_where_that_lasts_and_once_however_the_pocket_trembles(tmp_path: Path) -> None:
    tuning = speed_machine(tmp_path).spindle_speed
    assert tuning is not None
    turning, told = TurningSpeed(tuning), []
    off_rpm = tuning.tolerance_rpm(9000.0) + 1.0
    lows = [9000.0 + off_rpm] * 3 + [8000.0] * 10 + [9000.0 + off_rpm] * 15
    lows += [9000.0 + off_rpm - 2.0 * (each % 2) for each in range(40)] + [9000.0] * 2
    for second, low_rpm in enumerate(lows):
        sample = cnc_sample(1.7e9 + second, spindle_speed_rpm=9000.0)
        turning.update(9000.0, sample, Phase.CUTTING, (low_rpm, 10_000.0))
        told.append(bool(turning.alarm))
    assert not any(told[:13]), "a choice of a moment"
    assert told[-1] is False and sum(a != b for a, b in itertools.pairwise(told)) == 2
    for second in range(100, 120):
        turning.update(9000.0, cnc_sample(1.7e9 + second, spindle_speed_rpm=9000.0), Phase.CUTTING, (9200.0, 1e4))
    assert "the spindle cuts at 9000" in turning.alarm
    for second in range(120, 140):
        turning.update(9000.0, cnc_sample(1.7e9 + second, spindle_speed_rpm=8000.0), Phase.CUTTING, (9200.0, 1e4))
    assert "the spindle turns at 8000" in turning.alarm
