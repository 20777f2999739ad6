"""What the history says of a model of an axis with a slope: judged where the axis stood, or counted as not judged."""

from collections import Counter
from pathlib import Path
from typing import Any

import history_records as make
import numpy as np
import pytest
from control_rig import record_for
from sloped_machine import PIVOT_MM, TRAVEL_MM, configured, content, proved

from config.records.commissioning_file import commissioning_text
from config.schema import Configuration
from daemon.history.layout import MachineLayout
from daemon.history.reader import HistoryReader
from daemon.history.writer import HistoryWriter
from daemon.model_release.model_errors import MeasuredError, measured_errors
from daemon.model_release.past_recordings import commissioned_um_per_unit
from models.records import ProbeSample

MINUTES = 131
ECHO, ECHO_SLOPE = 512, 513
CROOKED_UM_PER_M = 70.0
"""The machine errs along the axis when cold, too."""
PLACES = (20.0, PIVOT_MM, 480.0)


def given(directory: Path, *, fanuc: bool, read: bool) -> dict[str, Any]:
    made = content(directory)
    if read:
        made["cnc"]["axis_positions"] = {"Z_mm": {"axis": "Z", "travel_mm": TRAVEL_MM, "rapid_mm_per_min": 30000.0}}
    if fanuc:
        made["cnc"]["guard"] = {"increment_mm": 0.0001}
        made["cnc"]["opcua"].update(preset="fanuc", namespace_uri="urn:a:b")
    made["displacements"] = {
        "file": {"path": "/srv/*.csv", "header": "time"},
        "channels": [{"name": "Z1", "column": "Z"}],
    }
    made["compensation"]["commissioning_file"] = str(directory / "commissioning.json")
    record = record_for(configured(made), axes=proved())
    (directory / "commissioning.json").write_text(commissioning_text(record), encoding="utf-8")
    return made


def fill(
    configuration: Configuration,
    start_s: float,
    *,
    right: float = 1.0,
    on: bool = True,
    lost: range = range(0),
    probes: bool = False,
) -> None:
    """A warm-up in which Z errs by 20 um and 80 um/m; the slope is estimated `right`, both are applied as estimated."""
    clock = make.StillClock(start_s)
    layout = MachineLayout.from_configuration(configuration)
    writer = HistoryWriter(configuration.history.path, clock=clock, machine=layout)
    writer.start()
    for minute in range(-1, MINUTES):
        at_s, mm = start_s + 60.0 * minute, PLACES[minute % 3]
        clock.utc_s = at_s
        grown = 1.0 - np.exp(-max(minute, 0) / 40.0)
        true, said = np.array([20.0, 80.0]) * grown, np.array([20.0, 80.0 * right]) * grown
        applied = -said if on else np.zeros(2)
        macros = {ECHO: applied[0] / 1000.0, ECHO_SLOPE: applied[1] / 1000.0}
        told_mm = np.nan if minute in lost else mm
        writer.cnc_sample(make.cnc_sample(at_s + 1.0, macros=macros, positions_mm={"Z_mm": told_mm}))
        along_m = 1e-3 * (mm - PIVOT_MM)
        if minute < 0:
            reference = make.reference(at_s + 1.0, len(layout.sensor_ids))
            writer.reference(
                reference.__class__(**{n: getattr(reference, n) for n in reference.__slots__} | {"reference_id": "r"})
            )
            continue
        made = make.estimate(at_s + 1.0, said, channels=("Z1", "Z1_per_m"), band_um=np.full(2, 2.5), model_id="m1")
        writer.estimate(made.__class__(**{n: getattr(made, n) for n in made.__slots__} | {"reference_id": "r"}))
        left_um = (true + applied) @ [1.0, along_m]
        if probes and minute % 10 == 0:
            probe = ProbeSample(
                time=make.instant(at_s + 2.0),
                axis="z",
                deviation_um=float(left_um),
                applied_um=float(applied[0]),
                thermal_error_um=float(said[0]),
                reference_id="r",
                accepted=True,
                reason="",
            )
            writer.probe(probe)
        elif not probes:
            seen_um = left_um + CROOKED_UM_PER_M * along_m
            writer.displacement(make.displacement(at_s + 2.0, np.array([seen_um]), source=f"/srv/a.csv:{minute + 2}"))
    writer.close()


def judged(configuration: Configuration) -> tuple[list[MeasuredError], Counter[tuple[str, str]]]:
    unjudged: Counter[tuple[str, str]] = Counter()
    units = commissioned_um_per_unit(configuration)
    with HistoryReader(configuration.history.path) as reader:
        found = measured_errors(configuration, reader, units, from_utc_s=0.0, to_utc_s=4e9, unjudged=unjudged)
    return found, unjudged


@pytest.mark.parametrize("on", [True, False])
@pytest.mark.parametrize("probes", [False, True])
def test_a_right_model_leaves_nothing_anywhere_on_the_travel(tmp_path: Path, on: bool, probes: bool) -> None:
    configuration = configured(given(tmp_path, fanuc=False, read=True))
    fill(configuration, make.EPOCH_S, on=on, probes=probes)
    found, unjudged = judged(configuration)
    assert len(found) >= 12 and {each.source for each in found} == {"probe" if probes else "displacement"}
    assert max(abs(each.left_um) for each in found) < 0.2 and max(abs(each.without_um) for each in found) > 20.0
    assert not unjudged


def test_a_slope_of_the_wrong_sign_leaves_more_than_there_was(tmp_path: Path) -> None:
    configuration = configured(given(tmp_path, fanuc=False, read=True))
    fill(configuration, make.EPOCH_S, right=-1.0)
    found, _ = judged(configuration)
    along_m = 1e-3 * (480.0 - PIVOT_MM)
    assert max(abs(each.left_um) for each in found) == pytest.approx(2.0 * 80.0 * along_m, rel=0.15)


@pytest.mark.parametrize("probes", [False, True])
@pytest.mark.parametrize(
    ("machine", "lost", "words"),
    [
        ({"fanuc": False, "read": False}, range(0), "cnc.axis_positions does not read where Z is: add an entry"),
        ({"fanuc": False, "read": True}, range(MINUTES), "the control did not say where Z stood: reference the axis"),
        ({"fanuc": True, "read": True}, range(0), "where the guard was called last, and does not say where that was"),
    ],
)
def test_what_cannot_be_judged_is_counted_with_the_reason(
    tmp_path: Path, machine: dict[str, bool], lost: range, words: str, probes: bool
) -> None:
    configuration = configured(given(tmp_path, **machine))
    fill(configuration, make.EPOCH_S, lost=lost, probes=probes)
    found, unjudged = judged(configuration)
    ((axis, why),) = unjudged
    assert axis == "z" and words in why
    assert not any(each.without_um for each in found), "but for a probe before the slope was anything"
    assert len(found) <= 1 and unjudged[axis, why] >= (12 if probes else MINUTES - 2)
