"""Do no harm on an axis with a slope: what is measured is judged where the axis stood, or it is said that it is not."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import history_records as make
import numpy as np
import pytest
from control_rig import HandClock, Rig, record_for, running
from memory_cnc import MemoryNc
from sloped_machine import PIVOT_MM, TRAVEL_MM, configured, content, proved

from config.schema import Configuration
from daemon.cnc.limits import axis_sources
from daemon.compensation.skill_monitor import LEAST_PAIRS, SkillWatch
from models.records import DisplacementSample, ThermalErrorEstimate

NOWHERE = float("nan")
BASE: Any = make.estimate(make.EPOCH_S, np.zeros(2), channels=("Z1", "Z1_per_m"), band_um=np.full(2, 2.0), model_id="m")


def sloped(directory: Path, *, read: bool = True, fanuc: bool = False) -> Configuration:
    given = content(directory)
    given["displacements"] = {
        "file": {"path": "/srv/d.csv", "header": "t"},
        "channels": [{"name": "Z1", "column": "Z1"}],
    }
    if read:
        given["cnc"]["axis_positions"] = {"Z_mm": {"axis": "Z", "travel_mm": TRAVEL_MM, "rapid_mm_per_min": 30000.0}}
    if fanuc:
        given["cnc"]["guard"] = {"increment_mm": 0.0001}
        given["cnc"]["opcua"].update(preset="fanuc", namespace_uri="urn:a:b")
    return configured(given)


def estimate(z_um: float, um_per_m: float) -> ThermalErrorEstimate:
    made = replace(BASE, thermal_error_um=np.array([z_um, um_per_m]), reference_id="r")
    assert isinstance(made, ThermalErrorEstimate)
    return made


class Day:
    """A machine of which Z errs by an offset and a slope, what is said of it and applied; three polls a row."""

    def __init__(self, configuration: Configuration, *, crooked_um_per_m: float = 0.0) -> None:
        self.told: list[str] = []
        self.watch = SkillWatch(axis_sources(configuration), configuration, self.told.append)
        self.crooked_um_per_m = crooked_um_per_m
        self.at_s = make.EPOCH_S

    def row(
        self,
        mm: float,
        true: tuple[float, float],
        said: tuple[float, float],
        applied: tuple[float, float] = (0.0, 0.0),
        told_mm: float | None = None,
    ) -> None:
        """Measure at a position: the error and what is applied there, each an offset and a slope."""
        for _ in range(3):
            self.at_s += 1.0
            positions = {"Z_mm": mm if told_mm is None else told_mm}
            self.watch.stand(make.cnc_sample(self.at_s, positions_mm=positions))
        along_m = 1e-3 * (mm - PIVOT_MM)
        um = true[0] + applied[0] + (true[1] + applied[1] + self.crooked_um_per_m) * along_m
        sample = DisplacementSample(
            utc_s=self.at_s - 0.5, um=np.array([um]), reason=np.zeros(1, dtype=np.uint8), source="test:1"
        )
        now = replace(estimate(*said), trace=make.trace(self.at_s))
        self.watch.displacement(sample, now, np.array(applied))

    def grow(
        self,
        true: tuple[float, float],
        said: tuple[float, float],
        applied: tuple[float, float] = (0.0, 0.0),
        places: tuple[float, ...] = (500.0,),
        rows: int = 4 * LEAST_PAIRS,
        **more: Any,
    ) -> str:
        """Let all of it come in time; return what the watch says at the end."""
        for row in range(rows + 1):
            share = min(row / 20.0, 1.0)
            now = [tuple(share * value for value in pair) for pair in (true, said, applied)]
            self.row(places[row % len(places)], *now, **more)  # type: ignore[arg-type]
        found = self.watch.inhibit()
        return "" if found is None else found.text


def test_a_right_estimate_of_offset_and_slope_does_no_harm_where_their_errors_cancel(tmp_path: Path) -> None:
    """At 500 mm nothing is to be seen of -20 um and 80 um/m; judged at the pivot 20 um would seem to be left."""
    assert Day(sloped(tmp_path)).grow((-20.0, 80.0), (-20.0, 80.0)) == ""
    assert Day(sloped(tmp_path)).grow((-20.0, 80.0), (-20.0, 80.0), (20.0, -80.0)) == "", "and with it applied"


def test_a_slope_of_the_wrong_sign_does_harm_that_shows_where_the_axis_stands(tmp_path: Path) -> None:
    said = Day(sloped(tmp_path)).grow((0.0, 80.0), (0.0, -80.0), (0.0, 80.0))
    assert "axis z" in said and "left by the estimate" in said
    assert Day(sloped(tmp_path)).grow((0.0, 80.0), (0.0, -80.0), (0.0, 80.0), places=(PIVOT_MM,)) == ""


@pytest.mark.parametrize(
    ("machine", "told_mm", "words"),
    [
        ({"read": False}, None, "cnc.axis_positions does not read where Z is: add an entry"),
        ({}, NOWHERE, "the control did not say where Z stood: reference the axis"),
        (
            {"fanuc": True},
            None,
            "where the guard was called last, and does not say where that was: measure while z_slope",
        ),
    ],
)
def test_where_nobody_knows_what_the_slope_makes_nothing_is_judged_and_that_is_said_once(
    tmp_path: Path, machine: dict[str, Any], told_mm: float | None, words: str
) -> None:
    day = Day(sloped(tmp_path, **machine))
    assert day.grow((-20.0, 80.0), (20.0, -80.0), (-20.0, 80.0), told_mm=told_mm) == ""
    (said,) = day.told
    assert said.startswith("what is measured on axis z is not judged: ") and words in said
    day.watch.count_from("another reference", "m")
    day.grow((-20.0, 80.0), (20.0, -80.0), (-20.0, 80.0), told_mm=told_mm)
    assert day.told == [said], "every part has a reference: it is said once"


@pytest.mark.parametrize("fanuc", [True, False])
def test_without_a_slope_in_estimate_and_compensation_the_position_does_not_matter(tmp_path: Path, fanuc: bool) -> None:
    day = Day(sloped(tmp_path, read=False, fanuc=fanuc))
    assert "axis z" in day.grow((12.0, 0.0), (-12.0, 0.0)) and day.told == []


async def test_the_control_task_judges_displacements_and_probes_where_the_axis_stands(tmp_path: Path) -> None:
    configuration, clock = sloped(tmp_path), HandClock()
    record = record_for(configuration, axes=proved())
    rig = Rig(configuration, MemoryNc(configuration, clock), clock, record=record)
    async with running(rig):
        rig.nc.positions_mm["Z_mm"] = 500.0
        await rig.turn()
        rig.set_reference()
        await rig.switch_on("z", "z_slope")
        said = {"channels": ("Z1", "Z1_per_m"), "band_um": np.full(2, np.nan)}
        for turn in range(120):
            share = min(turn / 40.0, 1.0)
            await rig.turn(rig.estimate(0.0, 0.0, thermal_error_um=share * np.array([-20.0, 80.0]), **said))
            um = np.array([share * (-20.0 + 0.25 * 80.0) + rig.applied["z"] + 0.25 * rig.applied["z_slope"]])
            utc_s = rig.clock.now().utc_s
            rig.control.deliver(
                DisplacementSample(utc_s=utc_s, um=um, reason=np.zeros(1, dtype=np.uint8), source="t:1")
            )
        assert rig.state == "ACTIVE" and rig.control.skill.inhibit() is None
        (record_of_z,) = rig.control.skill._records.values()
        assert len(record_of_z.left_um) > LEAST_PAIRS and max(map(abs, record_of_z.left_um)) < 5.0
        for _ in range(4):  # measuring takes longer than the guard's last step is ago
            grown = rig.estimate(0.0, 0.0, thermal_error_um=np.array([-20.0, 80.0]), **said)
            await rig.turn(grown, safe=False)
        applied_um = rig.applied["z"] + 0.25 * rig.applied["z_slope"]
        assert rig.control._measured.take_probe("z", 1.0) == ""
        await rig.turn(rig.estimate(0.0, 0.0, thermal_error_um=np.array([-20.0, 80.0]), **said))
        (record_of_z,) = rig.control.skill._records.values()
        assert record_of_z.measured_um[-1] == pytest.approx(1.0 - applied_um, abs=0.5), "at the pivot it were -19"
        assert record_of_z.left_um[-1] == pytest.approx(1.0 - applied_um, abs=0.5)
