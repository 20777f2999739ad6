"""Axis positions as inputs of the model on line: believed or not, beyond training, lost, at a restart, and recorded."""

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from control_rig import SENSOR_IDS, machine
from thermal_rig import PERIOD_S, Task, model

from config.schema.cnc import AxisPositionConfig
from daemon.messages import SpindleSpeed
from models.records import CncMode, CncRun, CncSample
from models.thermal.training.making import FIRST_POSITION_ID

AXIS = AxisPositionConfig(axis="Z", travel_mm=(0.0, 500.0), rapid_mm_per_min=600.0)
UM_PER_MM = 0.02


def with_position(lowest: float = -400.0, highest: float = 400.0, *, of_increments: bool = True) -> Any:
    """Z1 = 2 um/K of sensor 1, 1 um/K of sensor 11, and 0.02 um/mm of the axis' position."""
    count = len(SENSOR_IDS) + 1
    coefficients = np.zeros((1, count))
    coefficients[0, [0, 3, count - 1]] = 2.0, 1.0, UM_PER_MM
    made = model(
        sensor_ids=(*SENSOR_IDS, FIRST_POSITION_ID),
        sensor_names=(*(f"t{i}" for i in SENSOR_IDS), "Z_mm"),
        axis_positions=("Z_mm",),
        coefficients_um_per_k=coefficients,
        lowest_increment_k=np.array([-20.0] * (count - 1) + [-400.0]),
        highest_increment_k=np.array([20.0] * (count - 1) + [400.0]),
        test_pairs=[(np.full(count, 21.0), np.full(count, 20.0))],
    )
    bounds = [np.array([*([value] * (count - 1)), end]) for value, end in ((-50.0, lowest), (90.0, highest))]
    domain = replace(made.domain, of_increments=of_increments, lowest=bounds[0], highest=bounds[1])
    return replace(made, domain=domain)


class Axis:
    """The thermal task of a machine whose Z position is polled with every cycle."""

    def __init__(self, directory: Path, the_model: Any = None) -> None:
        configuration = machine(directory)
        configuration.cnc.axis_positions["Z_mm"] = AXIS
        self.rig = Task(directory, the_model or with_position(), configuration=configuration)
        self.rig.history.start()
        self.z_mm = 250.0

    async def poll(self, z_mm: float | None = None, lacking: str = "") -> None:
        now = self.rig.clock.now()
        self.z_mm = self.z_mm if z_mm is None else z_mm
        positions = {"Z_mm": self.z_mm}
        self.rig.history.cnc_sample(a_sample(now, positions))
        await self.rig.task._take(
            SpindleSpeed(monotonic_s=now.monotonic_s, rpm=0.0, positions_mm=positions, no_position=lacking)
        )

    async def minutes(self, count: float, z_mm: float | None = None, lacking: str = "") -> None:
        for _ in range(round(count * 60.0 / PERIOD_S)):
            self.rig.clock.monotonic_s += PERIOD_S
            await self.poll(z_mm, lacking)
            await self.rig.cycle("spindle", 20.0)
            await self.rig.cycle("column", 20.0)

    @property
    def latest(self) -> Any:
        return self.rig.estimates[-1]

    @property
    def um(self) -> float:
        return float(self.latest.thermal_error_um[0])


def a_sample(now: Any, positions_mm: dict[str, float]) -> CncSample:
    return CncSample(
        time=now,
        mode=CncMode.MEMORY,
        run=CncRun.START,
        alarm=False,
        program=1000,
        sequence_number=20,
        spindle_speed_rpm=0.0,
        motor_temperature_degc=float("nan"),
        clock_s=now.monotonic_s,
        power_on_count=7,
        work_offset=54,
        tool_number=1,
        positions_mm=positions_mm,
    )


@asynccontextmanager
async def playing(directory: Path, the_model: Any = None) -> AsyncIterator[Axis]:
    bench = Axis(directory, the_model)
    await bench.minutes(3.0)
    await bench.rig.ask()
    yield bench
    bench.rig.history.close()


async def test_the_estimate_follows_the_mean_position_of_the_last_minute(tmp_path: Path) -> None:
    async with playing(tmp_path) as bench:
        await bench.minutes(0.5, 350.0)
        assert 0.0 < bench.um < UM_PER_MM * 100.0, "half a minute there"
        await bench.minutes(1.5)
        assert bench.um == pytest.approx(UM_PER_MM * 100.0) and bench.latest.confidence == 1.0
        assert bench.latest.inhibit == "" and bench.rig.task.inhibit() == ""


@pytest.mark.parametrize(
    ("z_mm", "lacking", "words"),
    [
        (float("nan"), "", "the control gives none now"),
        (float("nan"), "its unit is not known", "its unit is not known"),
        (9.8e3, "", "outside the travel of 0 to 500 mm"),
        (-25.4, "", "travel_mm"),
    ],
)
async def test_a_position_that_is_lost_or_in_another_unit_holds_the_output_and_moves_nothing(
    tmp_path: Path, z_mm: float, lacking: str, words: str
) -> None:
    async with playing(tmp_path) as bench:
        await bench.minutes(2.0, 300.0)
        before = bench.um
        await bench.minutes(2.0, z_mm, lacking)
        assert bench.latest.confidence == 0.0 and words in bench.latest.inhibit and "axis Z" in bench.latest.inhibit
        assert words in bench.rig.task.inhibit(), "and no axis is enabled meanwhile"
        await bench.minutes(2.0, 300.0)
        assert bench.latest.confidence == 1.0 and bench.um == pytest.approx(before), "as if it had never gone"


async def test_one_value_that_the_axis_cannot_have_reached_is_dropped_and_two_hold_until_a_new_reference(
    tmp_path: Path,
) -> None:
    async with playing(tmp_path) as bench:
        await bench.minutes(1.0, 300.0)
        before = bench.um
        await bench.poll(450.0)
        await bench.minutes(1.0, 300.0)
        assert bench.um == pytest.approx(before, abs=UM_PER_MM * 51.0) and bench.latest.confidence == 1.0
        await bench.minutes(1.0)
        before = bench.um
        await bench.poll(10.0)
        await bench.poll(10.0)
        await bench.minutes(3.0)
        assert bench.latest.confidence == 0.0 and "faster than the axis can" in bench.latest.inhibit
        assert "position the work again" in bench.rig.task.inhibit()
        await bench.rig.ask("r2")
        await bench.minutes(0.5)
        assert bench.latest.confidence == 1.0 and bench.um == pytest.approx(0.0)


async def test_a_control_that_begins_to_count_in_inches_inside_the_travel_moves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A fast axis can come from 250 to 9.84 mm between two polls; it stood, and the tool went by 5 um."""
    monkeypatch.setitem(globals(), "AXIS", AXIS.model_copy(update={"rapid_mm_per_min": 3e4}))

    async with playing(tmp_path) as bench:
        await bench.minutes(2.0, 9.8425)
        assert bench.um == pytest.approx(0.0, abs=1e-9) or bench.latest.confidence == 0.0
        await bench.minutes(2.0, 8.0)
        assert bench.latest.confidence == 0.0 and "the same in another unit" in bench.latest.inhibit
        assert "its unit is right" in bench.rig.task.inhibit()


@pytest.mark.parametrize("of_increments", [False, True])
async def test_beyond_the_positions_of_training_confidence_fades_and_then_nothing_is_followed(
    tmp_path: Path, of_increments: bool
) -> None:
    shift = 250.0 if of_increments else 0.0

    async with playing(tmp_path, with_position(100.0 - shift, 300.0 - shift, of_increments=of_increments)) as bench:
        await bench.minutes(2.0, 300.0)
        assert bench.latest.confidence == 1.0
        await bench.minutes(2.0, 310.0)
        assert bench.latest.confidence == pytest.approx(0.5)
        await bench.minutes(2.0, 321.0)
        assert bench.latest.confidence == 0.0 and "outside the positions at which" in bench.latest.inhibit
        await bench.minutes(2.0, 290.0)
        assert bench.latest.confidence == 1.0


async def test_a_reference_that_was_set_without_a_position_is_not_followed(tmp_path: Path) -> None:
    async with playing(tmp_path) as bench:
        await bench.minutes(2.0, float("nan"))
        await bench.rig.ask("r2")
        await bench.minutes(2.0, 250.0)
        assert bench.latest.confidence == 0.0 and "position the work again" in bench.latest.inhibit
        await bench.rig.ask("r3")
        await bench.minutes(0.5)
        assert bench.latest.confidence == 1.0


async def test_a_restart_goes_on_from_where_the_axis_stood_at_the_reference(tmp_path: Path) -> None:
    bench = Axis(tmp_path)
    await bench.minutes(3.0)
    await bench.rig.ask()
    await bench.minutes(2.0, 340.0)
    before = bench.um
    (reference,) = bench.rig.references
    taken_up = bench.rig.taken_up(reference)
    await bench.rig.history.flushed()
    bench.rig = bench.rig.restarted(with_position())
    await bench.rig.task._take(taken_up)
    await bench.minutes(2.0)
    assert bench.um == pytest.approx(before, abs=1e-3) and bench.latest.confidence == 1.0
    bench.rig.history.close()


@pytest.mark.parametrize("polls", [2, 3, 30])
async def test_a_reference_soon_after_a_jump_counts_from_where_the_axis_is_or_says_that_it_does_not_know(
    tmp_path: Path, polls: int
) -> None:
    async with playing(tmp_path) as bench:
        for _ in range(polls):
            bench.rig.clock.monotonic_s += 0.5
            await bench.poll(370.0)
        await bench.rig.ask("r2")
        await bench.minutes(3.0)
        if bench.latest.confidence == 0.0:
            assert "not known at the reference: position the work again" in bench.latest.inhibit
            await bench.rig.ask("r3")
            await bench.minutes(3.0)
        assert bench.um == pytest.approx(0.0, abs=1e-9) and bench.latest.confidence == 1.0


async def after_a_restart(bench: Axis, **changes: Any) -> None:
    """End the daemon; go on from the same reference, with the entry of the axis changed."""
    (*_, reference) = bench.rig.references
    taken_up = bench.rig.taken_up(reference)
    await bench.rig.history.flushed()
    bench.rig.configuration.cnc.axis_positions["Z_mm"] = AXIS.model_copy(update=changes)
    bench.rig = bench.rig.restarted(with_position())
    await bench.rig.task._take(taken_up)
    await bench.minutes(2.0)


async def test_a_restart_counts_from_no_position_that_was_not_believed(tmp_path: Path) -> None:
    """The store keeps what the control said: a slip in the minute before the reference came back with a restart."""

    async with playing(tmp_path) as bench:
        for z_mm in (9.8e3, 250.0):
            bench.rig.clock.monotonic_s += 1.0
            await bench.poll(z_mm)
        bench.rig.clock.monotonic_s += 1.0
        await bench.rig.ask("r2")
        await bench.minutes(1.0)
        await after_a_restart(bench)
        assert bench.um == pytest.approx(0.0, abs=1e-9) and bench.latest.confidence == 1.0


@pytest.mark.parametrize("at_reference", [True, False])
async def test_a_model_with_positions_takes_over_when_they_are_known_and_not_before(
    tmp_path: Path, at_reference: bool
) -> None:
    """It once took over with none, and the output went by all that the axis had moved when the position came back."""
    lost = float("nan")

    async with playing(tmp_path, model(model_id="without")) as bench:
        if not at_reference:
            await bench.minutes(1.0, lost)
            await bench.rig.ask("r2")
        await bench.minutes(1.0, lost)
        await bench.rig.task._take(with_position())
        await bench.minutes(1.0)
        assert bench.latest.model_id == "without" and bench.latest.confidence == 1.0
        await bench.minutes(2.0, 300.0)
        assert bench.latest.model_id == ("made-up" if at_reference else "without")
        await bench.rig.ask("r3")
        await bench.minutes(1.0)
        assert bench.latest.model_id == "made-up" and bench.latest.confidence == 1.0
