"""A slope from the configuration to the axis: limits shared with the offset, released, enabled, commissioned, shown."""

import asyncio
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from control_rig import HandClock, Rig, record_for, running
from memory_cnc import MemoryNc
from sloped_machine import FARTHEST_M, PIVOT_MM, SLOPE, TRAVEL_MM, Z, configured, content, proved, sloped
from small_model import model

from daemon.cnc.limits import output_limits
from daemon.commissioning.initialising import CommissioningRefusedError
from daemon.commissioning.slope import positions_of, slope_to_write
from daemon.model_release.gate import unfit
from daemon.model_release.release_checks import gate_inhibit
from models.control.state import OperatorRequest

Change = Callable[[dict[str, Any]], object]


# --- the configuration -------------------------------------------------------------------


def test_offset_and_slope_share_what_the_axis_may(tmp_path: Path) -> None:
    configuration = sloped(tmp_path)
    limits = output_limits(configuration)
    assert limits.axes == ("z", "z_slope")
    for array, key in ((limits.absolute_bound_um, "absolute_bound_um"), (limits.slew_um_per_min, "slew_um_per_min")):
        assert array[0] + FARTHEST_M * array[1] == pytest.approx(Z[key]) and array[1] == SLOPE[key]
    assert limits.step_um[0] + FARTHEST_M * limits.step_um[1] == pytest.approx(Z["step_um"])
    assert configuration.compensation.axes["z"].absolute_bound_um == Z["absolute_bound_um"], "what the file says stays"


def axes_of(content: dict[str, Any]) -> dict[str, Any]:
    axes: dict[str, Any] = content["compensation"]["axes"]
    return axes


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda c: axes_of(c)["z_slope"].update(absolute_bound_um=200.0), "leaves the offset nothing of the 50 um of"),
        (lambda c: axes_of(c)["z_slope"].update(step_um=40.0), "compensation.axes.z.step_um"),
        (lambda c: axes_of(c)["z_slope"]["slope"].update(of="q"), "there is no axis q that takes an offset"),
        (lambda c: axes_of(c)["z_slope"]["slope"].update(of="z_slope"), "there is no axis z_slope that takes an"),
        (lambda c: axes_of(c)["z_slope"]["slope"].update(travel_mm=[500.0, 0.0]), "the lowest position comes first"),
        (lambda c: c["cnc"]["guard"]["axes"].update(z_slope={"letter": "Z", "number": 3}), "a slope acts on the axis"),
        (
            lambda c: (c["cnc"].update(guard={}, driver="haas", haas={"host": "127.0.0.1"}), c["cnc"].pop("opcua")),
            "only a SINUMERIK, a FANUC and LinuxCNC take a slope",
        ),
        (
            lambda c: (
                c["cnc"].update(guard={"memory": 994}),
                c["cnc"]["opcua"].update(preset="fanuc", namespace_uri="urn:a:b"),
            ),
            "it needs #994 to #1001",
        ),
        (
            lambda c: (
                c["cnc"].update(guard={}),
                c["cnc"]["opcua"].update(preset="fanuc", namespace_uri="urn:a:b"),
                c["cnc"]["macros"]["writable"].append(597),
            ),
            "it needs #590 to #597",
        ),
        (
            lambda c: axes_of(c)["z_slope"].update(tool_term={"length_mm": 100.0, "temperatures": {"A": 1.0}}),
            "a slope takes no tool term",
        ),
    ],
)
def test_a_slope_that_does_not_fit_is_refused_by_its_key(tmp_path: Path, change: Change, words: str) -> None:
    given = content(tmp_path)
    change(given)
    with pytest.raises(ValueError, match=words):
        configured(given)


# --- model and commissioning record ------------------------------------------------------


def test_a_model_s_slope_goes_to_a_slope_about_the_same_pivot_only(tmp_path: Path) -> None:
    configuration = sloped(tmp_path)
    plain = replace(model(), channels=("Z1", "Z1_per_m"))
    fits = replace(plain, pivots_mm={"Z1_per_m": PIVOT_MM})
    assert unfit(fits, configuration) == ""
    for each, words in (
        (plain, "channel Z1_per_m is no slope along an axis"),
        (replace(plain, pivots_mm={"Z1": PIVOT_MM, "Z1_per_m": PIVOT_MM}), "channel Z1 is a slope along an axis"),
        (replace(plain, pivots_mm={"Z1_per_m": 0.0}), "is a slope about 0 mm, and z_slope about 250 mm"),
    ):
        assert words in unfit(each, configuration)
        assert words in gate_inhibit(each, configuration)


@pytest.mark.parametrize(
    ("axes", "words"),
    [
        ({"z": proved()["z"]}, "not commissioned: axis z_slope"),
        ({"z": proved()["z"], "z_slope": proved()["z"]}, "was commissioned as an offset and is a slope of z about 250"),
        (proved(pivot_mm=0.0), "as a slope of z about 0 mm and is a slope of z about 250 mm now"),
        (proved(of="x"), "as a slope of x about 250 mm"),
        ({"z": proved()["z_slope"], "z_slope": proved()["z_slope"]}, "as a slope of z about 250 mm and is an offset"),
    ],
)
async def test_a_slope_that_nobody_has_seen_is_not_enabled(tmp_path: Path, axes: Any, words: str) -> None:
    rig = a_rig(tmp_path, axes=axes)
    async with running(rig):
        await rig.turn()
        refusal = rig.control.request(OperatorRequest(enable=frozenset({"z", "z_slope"})), "a person")
        assert words in refusal
        await rig.follow(10.0, 0.0, 5, **errors(10.0, 60.0))
        assert rig.applied == {"z": 0.0, "z_slope": 0.0}


def a_rig(directory: Path, axes: Any = None, *, fanuc: bool = False) -> Rig:
    """The control task at the simulated SINUMERIK, or FANUC."""
    given = content(directory)
    if fanuc:
        given["cnc"]["guard"] = {"increment_mm": 0.0001}
        given["cnc"]["opcua"].update(preset="fanuc", namespace_uri="urn:a:b")
    configuration, clock = configured(given), HandClock()
    record = record_for(configuration, axes=proved() if axes is None else axes)
    return Rig(configuration, MemoryNc(configuration, clock), clock, record=record)


def errors(z_um: float, z_um_per_m: float) -> dict[str, Any]:
    """What an estimate says instead of the rig's own channels."""
    return {
        "channels": ("Z1", "Z1_per_m"),
        "thermal_error_um": np.array([z_um, z_um_per_m]),
        "band_um": np.full(2, np.nan),
    }


# --- the output --------------------------------------------------------------------------


async def test_a_slope_is_requested_limited_written_verified_and_applied_beside_the_offset(tmp_path: Path) -> None:
    rig = a_rig(tmp_path)
    async with running(rig):
        await rig.turn()
        rig.set_reference()
        await rig.switch_on("z", "z_slope")
        moved = rig.nc.guard.control.moved_mm
        for _ in range(120):
            before = [moved("Z", at) for at in (*TRAVEL_MM, PIVOT_MM)]
            await rig.turn(rig.estimate(0.0, 0.0, **errors(10.0, 60.0)))
            after = [moved("Z", at) for at in (*TRAVEL_MM, PIVOT_MM)]
            most_um = max(abs(a - b) for a, b in zip(after, before, strict=True)) * 1000.0
            assert most_um <= Z["step_um"] + 1e-3
        assert rig.state == "ACTIVE"
        assert rig.applied == {"z": pytest.approx(-10.0), "z_slope": pytest.approx(-60.0)}
        assert moved("Z", 500.0) * 1000.0 == pytest.approx(-10.0 - 0.25 * 60.0)
        await rig.follow(0.0, 0.0, 200, **errors(90.0, 900.0))
        assert abs(moved("Z", 500.0)) * 1000.0 == pytest.approx(Z["absolute_bound_um"], abs=1.0)
        assert {"z:bound", "z_slope:bound"} <= set(rig.control.memory.limits_hit)
        rig.control.request(OperatorRequest(zero=True), "a person")
        await rig.follow(0.0, 0.0, 200, **errors(90.0, 900.0))
        assert rig.state == "OFF" and rig.applied == {"z": 0.0, "z_slope": 0.0}


async def test_at_a_fanuc_the_offset_is_what_the_place_needs_that_the_axis_stands_at_and_none_is_left(
    tmp_path: Path,
) -> None:
    rig = a_rig(tmp_path, fanuc=True)
    control = rig.nc.guard.control
    async with running(rig):
        await rig.turn()
        rig.set_reference()
        await rig.switch_on("z", "z_slope")
        for turn in range(200):
            control.positions_mm[2] = (0.0, 0.0, 500.0, 130.0)[turn % 4] if turn < 160 else 500.0
            before_mm = control.external_mm[2]
            await rig.turn(rig.estimate(0.0, 0.0, **errors(10.0, 60.0)))
            assert abs(control.external_mm[2] - before_mm) * 1000.0 <= Z["step_um"] + 1e-3
            assert abs(control.external_mm[2]) * 1000.0 <= Z["absolute_bound_um"]
        assert rig.state == "ACTIVE"
        assert control.external_mm[2] * 1000.0 == pytest.approx(-10.0 - 0.25 * 60.0)
        control.positions_mm[2] = PIVOT_MM
        await rig.follow(0.0, 0.0, 10, **errors(10.0, 60.0))
        assert rig.applied == {"z": pytest.approx(-10.0), "z_slope": pytest.approx(-60.0)}
        control.positions_mm[2] = 0.0
        rig.control.request(OperatorRequest(zero=True), "a person")
        await rig.follow(0.0, 0.0, 200, **errors(90.0, 900.0))
        assert rig.state == "OFF" and control.external_mm[2] == pytest.approx(0.0, abs=1e-9)


async def test_at_a_fanuc_the_second_call_far_from_the_one_before_or_outside_the_travel_is_an_alarm_in_words(
    tmp_path: Path,
) -> None:
    rig = a_rig(tmp_path, fanuc=True)
    control, ends = rig.nc.guard.control, (0.0, 500.0)
    async with running(rig):
        await rig.turn()
        rig.set_reference()
        await rig.switch_on("z", "z_slope")
        control.positions_mm[2] = PIVOT_MM
        await rig.follow(0.0, 0.0, 200, **errors(10.0, 100.0))
        told = []
        for turn in range(12):
            control.positions_mm[2] = ends[turn % 2]
            await rig.follow(0.0, 0.0, 1, **errors(10.0, 100.0))
            told.append(rig.control.journal.alarm)
        assert rig.state == "ACTIVE" and told[0] == "" and told[-1].startswith("the guard applies the block, but a")
        control.positions_mm[2] = 510.0
        await rig.follow(0.0, 0.0, 6, **errors(10.0, 100.0))
        assert rig.control.journal.alarm.startswith("the guard applies nothing of the block, of any axis: one with")
        control.positions_mm[2] = PIVOT_MM
        await rig.follow(0.0, 0.0, 20, **errors(10.0, 100.0))
        assert rig.control.journal.alarm == "" and rig.applied["z_slope"] == pytest.approx(-100.0)


async def test_a_slope_that_nobody_enabled_stays_at_zero_while_the_offset_is_followed(tmp_path: Path) -> None:
    rig = a_rig(tmp_path)
    async with running(rig):
        await rig.turn()
        rig.set_reference()
        await rig.switch_on("z")
        await rig.follow(0.0, 0.0, 120, **errors(10.0, 60.0))
        assert rig.applied == {"z": pytest.approx(-10.0), "z_slope": 0.0}


async def test_a_foreign_value_in_the_slope_s_macro_is_a_fault_and_moves_nothing(tmp_path: Path) -> None:
    rig = a_rig(tmp_path)
    async with running(rig):
        await rig.turn()
        rig.set_reference()
        await rig.switch_on("z", "z_slope")
        await rig.follow(0.0, 0.0, 120, **errors(10.0, 60.0))
        rig.nc.macros.set(503, 0.1)
        await rig.follow(0.0, 0.0, 5, **errors(10.0, 60.0))
        assert rig.state == "FAULT"
        assert rig.applied == {"z": pytest.approx(-10.0), "z_slope": pytest.approx(-60.0)}


# --- commissioning -----------------------------------------------------------------------


class Told:
    """A person who says these numbers."""

    interactive = True

    def __init__(self, *numbers: float | None) -> None:
        self.numbers = list(numbers)

    async def number(self, question: str) -> float | None:
        return self.numbers.pop(0)


@pytest.mark.parametrize(
    ("numbers", "words"),
    [
        ((20.0, None), "is proved at two positions of z"),
        ((-1.0, 480.0), "do not both lie in the travel"),
        ((100.0, 300.0), "closer than half of the travel"),
    ],
)
def test_positions_that_show_no_slope_are_refused(tmp_path: Path, numbers: Any, words: str) -> None:
    axis = sloped(tmp_path).compensation.outputs["z_slope"]
    with pytest.raises(CommissioningRefusedError, match=words):
        asyncio.run(positions_of("z_slope", axis, {}, Told(*numbers)))  # type: ignore[arg-type]


def test_the_slope_that_is_written_moves_one_position_by_the_offset_against_the_other(tmp_path: Path) -> None:
    axis = sloped(tmp_path).compensation.outputs["z_slope"]
    assert asyncio.run(positions_of("z_slope", axis, {}, Told(20.0, 480.0))) == (20.0, 480.0)  # type: ignore[arg-type]
    assert slope_to_write("z_slope", axis, 5.0, (20.0, 480.0), 1.0) == 10.0
    assert slope_to_write("z_slope", axis, -5.0, (480.0, 20.0), 1.0) == -10.0
    for offset_um, words in ((60.0, "outside its bound of 120 um/m"), (2.1, "proves nothing")):
        with pytest.raises(CommissioningRefusedError, match=words):
            slope_to_write("z_slope", axis, offset_um, (20.0, 480.0), 1.0)
