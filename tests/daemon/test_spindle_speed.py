"""The tuning of the spindle speed in the daemon, on a CNC in this process that runs the shipped speed program."""

import copy
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from control_rig import HandClock, running
from speed_machine import COLD, MACROS, bearing_model, speed_machine
from speed_rig import CUT, SAFE, SpeedRig, turned

from config.loader import parse_yaml_model
from config.machine.spindle import load_spindle, spindle_folder
from config.machine.spindle_chain import read_spindle
from config.machine.stability_case import load_stability_case
from config.schema import Configuration
from config.schema.base import ConfigurationError
from config.schema.spindle_speed import SpeedOperationConfig, SpindleSpeedConfig
from daemon.checkup.machine import preflight
from daemon.history.reader import HistoryReader
from daemon.spindle_speed.messages import CalledOperation
from daemon.spindle_speed.planning import planned_with
from drivers.guard.speed_text import SpeedStatus
from models.errors import StabilityError
from models.records import WriteOutcome
from models.spindle_speed.verification import StabilityVerification
from models.stability.collocation import radius_bounds
from models.stability.response import SampledResponse
from models.thermomechanics.artifact import model_to_json
from models.thermomechanics.regression import Bounds, PropertyRegression, ThermomechanicalModel
from models.thermomechanics.tool_point import AxisTracker, source_frequencies

bench = turned


async def test_an_operation_is_tuned_at_its_safe_block_and_the_nc_takes_the_pair(bench: SpeedRig) -> None:
    speed_rpm, feed_mm_min, status = await bench.operation()
    assert status is SpeedStatus.APPLIED
    assert speed_rpm != 9000.0
    assert 7200.0 <= speed_rpm <= 10800.0
    assert feed_mm_min == pytest.approx(1800.0 * speed_rpm / 9000.0, abs=0.06)
    await bench.pass_by(1.0, SAFE)
    picture = bench.picture()
    assert picture["state"] == "TUNED"
    assert picture["commanded_rpm"] == picture["applied_rpm"] == speed_rpm
    assert picture["limiting_depth_mm"] >= 2.0
    assert picture["change_per_sensor_step_rpm"]["A"] < 25.0
    await bench.pass_by(3.0, CUT)
    await bench.rig.history.flushed()
    with HistoryReader(bench.rig.configuration.history.path) as reader:
        audit = [record for record in reader.writes(0.0, 1e12) if record.cause == "spindle speed"]
    assert audit
    assert all(record.outcome is WriteOutcome.VERIFIED for record in audit)
    assert bench.rig.control.journal.fault is None


def verified_as_shipped(configuration: Configuration) -> None:
    assert SpindleSpeedConfig.model_fields["verify_with_sdm"].default is True
    assert configuration.spindle_speed is not None
    assert configuration.spindle_speed.verify_with_sdm


def stiff_operations(tmp_path: Path) -> list[SpeedOperationConfig]:
    """Return the machine's first operation with a tool that bears some millimetres beside 300 to 2500 Hz too."""
    tuning = speed_machine(tmp_path).spindle_speed
    assert tuning is not None
    stiff = dict.fromkeys(("x", "y"), Path("simulated_machine_16mm"))
    return [tuning.operations[0].model_copy(update={"spindles": stiff})]


async def test_a_verified_speed_is_taken_where_there_is_one_and_else_the_programmed_one(tmp_path: Path) -> None:
    """The lobes of zeroth order are stable to 3.4 mm at 9000 1/min; true limits are lower."""
    bench = SpeedRig(
        tmp_path,
        operations=stiff_operations(tmp_path),
        verify_with_sdm=SpindleSpeedConfig.model_fields["verify_with_sdm"].default,
    )
    verified_as_shipped(bench.configuration)
    async with running(bench.rig):
        await bench.rig.turn()
        speed_rpm, _, status = await bench.operation(S=8500.0, D=2.2)
        assert status is SpeedStatus.APPLIED
        assert 8900.0 < speed_rpm < 9200.0
        assert bench.picture()["alarm"] == ""
        await bench.pass_by(3.0, CUT)
        assert (await bench.operation(S=8500.0, D=3.0))[0] == 8500.0
        assert "does not die away fast enough; the programmed 8500 1/min stays" in bench.picture()["alarm"]
        assert (await bench.operation(S=8500.0, D=15.0))[0] == 8500.0
        assert "Hz beside them the tool's response is 0.31 um/N: at 15 mm a cut may chatter" in bench.picture()["alarm"]


def test_a_tool_that_the_lobes_do_not_know_needs_the_verification(tmp_path: Path) -> None:
    """Lobes offer speeds for straight edges; the helix is in the verification alone."""
    configuration = speed_machine(tmp_path)
    with (tmp_path / "case.yaml").open("a", encoding="utf-8") as case:
        case.write("helix_deg: 30\npitch_deg: [80, 100, 80, 100]\n")
    with pytest.raises(
        StabilityError, match=r"case.yaml: the lobes .* know no helix_deg, pitch_deg; set spindle_speed"
    ):
        planned_with(configuration, bearing_model())
    assert configuration.spindle_speed is not None
    verified = configuration.spindle_speed.model_copy(update={"verify_with_sdm": True})
    assert planned_with(configuration.model_copy(update={"spindle_speed": verified}), bearing_model())


async def test_nothing_changes_within_a_cut_and_the_pair_stays_valid(bench: SpeedRig) -> None:
    speed_rpm, *_ = await bench.operation()
    bench.degc = 36.0
    await bench.pass_by(60.0, CUT)
    assert set(bench.written()[-3:]) == {speed_rpm}
    assert bench.call()[0] == speed_rpm
    await bench.pass_by(3.0, SAFE)
    assert bench.call()[0] != speed_rpm


async def test_lost_temperatures_freeze_and_a_lost_daemon_expires(bench: SpeedRig) -> None:
    speed_rpm, *_ = await bench.operation()
    bench.degc = 36.0
    await bench.pass_by(90.0, SAFE, temperatures=False)
    assert bench.call()[0] == speed_rpm
    assert "no temperatures for 60 s; the speed is frozen" in bench.picture()["alarm"]
    bench.clock.monotonic_s += 40.0
    assert bench.call() == (9000.0, 1800.0, SpeedStatus.EXPIRED)


async def test_a_flagged_property_blocks(tmp_path: Path) -> None:
    bench = SpeedRig(tmp_path, model=bearing_model(flagged="ct_12"))
    async with running(bench.rig):
        await bench.rig.turn()
        assert (await bench.operation())[:2] == (9000.0, 1800.0)
        assert bench.picture()["state"] == "HOLD"
        assert "flagged property" in bench.picture()["alarm"]
        assert set(bench.written()) <= {0.0, 9000.0}


def flagged_within(share: float) -> ThermomechanicalModel:
    """The stiffness of bearings 3 and 4 is flagged, and known to a share."""

    def of(known: PropertyRegression) -> PropertyRegression:
        if known.name != "kt_34":
            return known
        return replace(known, bounds=Bounds(lowest=COLD["kt_34"], highest=COLD["kt_34"] * (1.0 + share)))

    model = bearing_model(flagged="kt_34")
    axes = {name: replace(axis, properties=tuple(map(of, axis.properties))) for name, axis in model.axes.items()}
    return replace(model, axes=axes)


@pytest.mark.parametrize(("share", "covered"), [(0.08, True), (0.1, False)])
async def test_a_flagged_property_and_the_hysteresis_together_stay_within_what_is_verified(
    tmp_path: Path, share: float, covered: bool
) -> None:
    """The command may stand off the target by the one, and the pocket by the other: 179 of 178 1/min."""
    bench = SpeedRig(tmp_path, model=flagged_within(share), hysteresis_rpm=100.0)
    async with running(bench.rig):
        await bench.rig.turn()
        speed_rpm, *_ = await bench.operation(D=1.6)
        picture = bench.picture()
        assert 50.0 < picture["flagged_span_rpm"] <= 100.0
        assert picture["state"] == ("TUNED" if covered else "HOLD") and (speed_rpm != 9000.0) is covered
        assert ("more than the tolerance of" in picture["alarm"]) is not covered


async def test_a_sensor_whose_step_would_make_the_speed_hunt_freezes_it(tmp_path: Path) -> None:
    bench = SpeedRig(tmp_path, sensor_step_k=1.0, hysteresis_rpm=10.0)
    async with running(bench.rig):
        await bench.rig.turn()
        assert (await bench.operation())[:2] == (9000.0, 1800.0)
        picture = bench.picture()
        largest = max(picture["change_per_sensor_step_rpm"].values())
        assert largest > 5.0 and picture["state"] == "HOLD"
        assert f"set the hysteresis above {2 * largest:.3g}" in picture["alarm"]
        assert set(bench.written()) <= {0.0, 9000.0}


async def test_no_stable_speed_is_the_programmed_one_and_an_alarm(bench: SpeedRig) -> None:
    assert (await bench.operation(D=15.0))[:2] == (9000.0, 1800.0)
    assert bench.picture()["state"] == "NO_STABLE_SPEED"
    assert "cut less deep or widen the limits" in bench.picture()["alarm"]


async def test_an_alarm_whose_numbers_run_on_is_recorded_once(bench: SpeedRig) -> None:
    await bench.operation(D=15.0)
    said = set()
    for _ in range(12):
        bench.degc += 0.5
        await bench.pass_by(5.0, SAFE)
        said.add(bench.picture()["alarm"])
    assert len(said) > 3
    for _ in range(3):
        await bench.operation(D=2.0)
        await bench.operation(D=15.0)
    assert "cut less deep" in bench.picture()["alarm"]
    await bench.operation(D=2.0)
    await bench.pass_by(190.0, SAFE)
    said = await alarms_of(bench)
    assert len(said) == 2, "also where the operation comes and goes"
    assert "cut less deep" in said[0]
    assert said[1] == f"over for 3 min: {said[0].removeprefix('spindle speed: ')}"


async def alarms_of(bench: SpeedRig) -> list[str]:
    await bench.rig.history.flushed()
    with HistoryReader(bench.rig.configuration.history.path) as reader:
        events = reader.events(0.0, 1e12)
    return [each.text for each in events if each.kind == "alarm" or each.text.startswith("over for")]


async def test_no_stable_speed_is_one_alarm_whatever_denies_the_speeds(tmp_path: Path) -> None:
    """Lobes and verification put it in other words, in turns as the spindle warms."""
    bench = SpeedRig(tmp_path, operations=stiff_operations(tmp_path), verify_with_sdm=True)
    async with running(bench.rig):
        await bench.rig.turn()
        await bench.operation(S=8500.0, D=3.6)
        said = set()
        for bench.degc in range(28, 37):
            await bench.pass_by(5.0, SAFE)
            said.add(bench.picture()["alarm"][:12])
        assert len(said) == 2
        assert len(await alarms_of(bench)) == 1


async def test_another_operation_does_not_inherit_the_speed(bench: SpeedRig) -> None:
    await bench.operation()
    assert bench.call(S=8000.0, F=1600.0) == (8000.0, 1600.0, SpeedStatus.ANOTHER)
    await bench.pass_by(2.0, CUT)
    assert bench.call(S=8000.0, F=1600.0)[2] is SpeedStatus.DISABLED


async def test_a_foreign_value_is_a_fault_and_nothing_more_is_written(bench: SpeedRig) -> None:
    await bench.operation()
    bench.nc.macros.set(MACROS.speed, 11000.0)
    await bench.pass_by(2.0, CUT)
    assert "macro #537 holds 11000" in str(bench.rig.control.journal.fault)
    count = len(bench.written())
    await bench.pass_by(30.0, SAFE)
    assert len(bench.written()) == count


async def test_a_write_that_is_not_taken_is_a_fault(bench: SpeedRig) -> None:
    bench.nc.forgets = MACROS.feed
    await bench.operation()
    assert "read-back of the spindle speed differs" in str(bench.rig.control.journal.fault)


async def test_an_intent_that_a_crash_left_is_settled_at_the_start(tmp_path: Path) -> None:
    bench = SpeedRig(tmp_path)
    async with running(bench.rig):
        bench.rig.history.write_intent(None, ((MACROS.speed, 9400.0),), "spindle speed")
        await bench.rig.history.flushed()
    async with running(bench.new_rig()):
        await bench.rig.turn()
        await bench.rig.history.flushed()
        with HistoryReader(bench.rig.configuration.history.path) as reader:
            (record,) = [each for each in reader.writes(0.0, 1e12) if each.cause == "spindle speed"]
            assert reader.unsettled_writes() == []
    assert record.outcome is WriteOutcome.FAILED
    assert "these macros are not polled" in str(record.detail)


async def test_the_check_names_what_the_tuning_lacks(tmp_path: Path) -> None:
    configuration = speed_machine(tmp_path)
    for there in (False, True):
        if there:
            (tmp_path / "bearings.json").write_text(model_to_json(bearing_model()), encoding="utf-8")
        found = {each.subject: each async for each in preflight(configuration, HandClock(), devices=False)}
        assert found["spindle speed"].passed is there
        assert ("there is no bearing model" in found["spindle speed"].detail) is not there
        assert ("made-up, sha256" in found["spindle speed"].detail) is there


def test_the_section_says_what_is_wrong_with_it(tmp_path: Path) -> None:
    good = speed_machine(tmp_path).spindle_speed
    assert good is not None
    content = good.model_dump(mode="json") | {"lowest_rpm": 13000.0, "validity_s": 2.0}
    content["macros"] = content["macros"] | {"feed": 537}
    with pytest.raises(ConfigurationError) as caught:
        parse_yaml_model(yaml.safe_dump(content), SpindleSpeedConfig, "speed.yaml")
    assert "#537 is used twice" in str(caught.value)
    with pytest.raises(ValueError, match="lies outside `writable`"):
        speed_machine(tmp_path, macros=good.macros.model_copy(update={"sequence_a": 600}))
    with pytest.raises(ValueError, match="belongs to the compensation"):
        speed_machine(tmp_path, macros=good.macros.model_copy(update={"sequence_a": 500}))


@pytest.mark.parametrize("change", [{"hysteresis_rpm": 250.0}, {"tolerance_percent": 0.4}, {"tolerance_percent": 0}])
def test_a_hysteresis_beyond_what_is_verified_is_refused(tmp_path: Path, change: dict[str, float]) -> None:
    """The command could stand, for ever, at a speed that was never verified."""
    good = speed_machine(tmp_path).spindle_speed
    assert good is not None
    content = good.model_dump(mode="json") | change
    with pytest.raises(ConfigurationError, match=r"hysteresis_rpm.*more than tolerance_percent allows"):
        parse_yaml_model(yaml.safe_dump(content), SpindleSpeedConfig, "speed.yaml")
    tool = content["operations"][0] | {"highest_rpm": 2400.0}
    with pytest.raises(ConfigurationError, match="highest speed of 2400: 48 1/min off"):
        slow = good.model_dump(mode="json") | {"operations": [tool]}
        parse_yaml_model(yaml.safe_dump(slow), SpindleSpeedConfig, "speed.yaml")


async def test_on_a_real_control_it_moves_the_speed_where_that_control_is_commissioned(tmp_path: Path) -> None:
    bench = SpeedRig(tmp_path)
    bench.nc.identity = "urn:a-real-control"
    refused = bench.new_rig()
    async with running(refused):
        await refused.turn()
        assert (await bench.operation())[:2] == (9000.0, 1800.0)
        assert not [number for number, _ in bench.nc.written if number in MACROS.ours]
        assert "the commissioning record is for" in bench.picture()["alarm"]
        assert bench.picture()["commanded_rpm"] is None
    async with running(bench.new_rig(cnc_identity="urn:a-real-control")) as rig:
        await rig.turn()
        speed_rpm, _, status = await bench.operation()
        assert status is SpeedStatus.APPLIED
        assert speed_rpm != 9000.0
        assert bench.picture()["alarm"] == ""


@pytest.mark.parametrize(("scale", "tool_mm", "at_hz"), [(1.0, (30, 6), "44.. Hz"), (2.5, (80, 40), "1.. Hz")])
def test_a_tool_whose_largest_resonance_lies_beside_the_band_is_refused(
    tmp_path: Path, scale: float, tool_mm: tuple[float, float], at_hz: str
) -> None:
    """A slender tool chatters above 2500 Hz, a heavy spindle below 300: the lobes called every depth stable."""
    shipped = shipped_spindle()
    for each in (*shipped["segments"], *shipped["holder"]["segments"], *shipped["bearings"]):
        for part in (each, each.get("ring", {})):
            part |= {key: scale * value for key, value in part.items() if key.endswith("_mm")}
    length_mm, outer_mm = tool_mm
    shipped["tool"]["segments"] = [{"length_mm": length_mm, "outer_mm": outer_mm, "material": "steel"}]
    with pytest.raises(StabilityError, match=f"largest resonance of T1 lies at {at_hz}, and 300 to 2500 Hz"):
        planned_with(with_spindle(tmp_path, shipped), bearing_model())


def test_a_cut_that_chatters_beside_the_band_is_refused_and_a_shallow_one_is_not(tmp_path: Path) -> None:
    """S8725 was verified to 1.4 mm, and within its tolerance the tool chatters at 3.4 kHz, where nobody looked."""
    shipped = shipped_spindle()
    shipped["tool"]["segments"][0]["length_mm"] = 38
    configuration = with_spindle(tmp_path, shipped, verify_with_sdm=True)
    (planning,) = planned_with(configuration, bearing_model()).values()
    called = CalledOperation(
        tool_number=1, program=1, speed_rpm=9000.0, feed_mm_min=1800.0, depth_mm=1.4, radial_mm=0.0
    )
    with pytest.raises(StabilityError, match=r"300 to 2500 Hz are computed, and at \d+ Hz .* up to 0.\d+ mm no speed"):
        planning.planner(called)
    assert planning.planner(replace(called, depth_mm=0.1))
    assembly = read_spindle(tmp_path / "spindle.yaml").assembly("tool")
    tracker = AxisTracker(bearing_model().axes["x"], assembly, source_frequencies())
    cut = load_stability_case(tmp_path / "case.yaml").cut()
    highest, within_rpm = [], [8725.0 * share for share in (0.98, 0.99, 1.0, 1.01, 1.02)]
    for end_hz in (2500.0, 9000.0):
        lines_hz = np.arange(300.0, end_hz, 3.0)
        receptance = tracker.receptances_at(lines_hz)[1][:, None, None] * np.eye(2)
        modes = StabilityVerification(cut).modes(SampledResponse(frequency_hz=lines_hz, receptance=receptance))
        highest.append(radius_bounds(modes, cut, feeds_deg=[0.0], speeds_rpm=within_rpm, depth_mm=1.4)[1].max())
    assert highest[0] < 0.98
    assert highest[1] > 1.01


def shipped_spindle() -> dict[str, Any]:
    return dict(yaml.safe_load((spindle_folder() / "simulated_machine.yaml").read_text("utf-8")))


def with_spindle(folder: Path, description: dict[str, Any], **changes: Any) -> Configuration:
    (spindle := folder / "spindle.yaml").write_text(yaml.safe_dump(description), encoding="utf-8")
    tuning = speed_machine(folder).spindle_speed
    assert tuning is not None
    operation = tuning.operations[0].model_copy(update={"spindles": {"x": spindle, "y": spindle}})
    return speed_machine(folder, operations=[operation], **changes)


def test_a_spindle_without_the_tool_is_none_of_its_operation(tmp_path: Path) -> None:
    """The response at the holder's front was taken for the tool's."""
    bare = shipped_spindle()
    del bare["tool"]
    with pytest.raises(StabilityError, match=r"spindle.yaml: it holds no tool, .* add `tool`, that of T1"):
        planned_with(with_spindle(tmp_path, bare), bearing_model())


@pytest.mark.parametrize("groups", [("front", "34", "5"), ("12", "34", "34")])
def test_the_bearings_of_another_spindle_are_refused(tmp_path: Path, groups: tuple[str, ...]) -> None:
    """Names that the model does not know ended in a KeyError, and a group that the spindle lacks in nothing."""
    other = shipped_spindle()
    for bearing in other["bearings"]:
        bearing["group"] = groups[("12", "34", "5").index(bearing["group"])]
    said = "knows the bearings 12, 34, 5 along x, and the spindle has " + ", ".join(sorted({*groups}))
    with pytest.raises(StabilityError, match=said):
        planned_with(with_spindle(tmp_path, other), bearing_model())


def test_bearings_that_were_identified_with_another_shaft_are_refused(tmp_path: Path) -> None:
    """Another holder, tool or word changes nothing; a longer segment, a softer material or a moved bearing does."""
    shipped = shipped_spindle()
    sha256 = load_spindle(spindle_folder() / "simulated_machine.yaml").shaft_sha256()
    model = replace(bearing_model(), shaft_sha256=sha256)
    shipped["note"] = shipped["segments"][0]["note"] = "measured again"
    shipped["tool"]["segments"][0]["length_mm"] -= 5.0
    shipped["bearings"][0]["kt_n_per_m"] *= 1.1
    shipped["materials"] = {"of_the_tool": {"E_gpa": 600.0, "G_gpa": 250.0, "nu": 0.2, "density_g_cm3": 14.0}}
    planned_with(with_spindle(tmp_path, shipped), model)
    for place, key in (("segments", "length_mm"), ("bearings", "position_mm")):
        other = copy.deepcopy(shipped)
        other[place][-2][key] -= 1.0
        with pytest.raises(StabilityError, match=r"spindle.yaml: the bearings of made-up .* another shaft"):
            planned_with(with_spindle(tmp_path, other), model)
    name = shipped["segments"][0].get("material") or next(iter(shipped["segments"][0]["mixture"]))
    shipped["materials"] = {name: {"E_gpa": 60.0, "G_gpa": 25.0, "nu": 0.3, "density_g_cm3": 7.8}}
    with pytest.raises(StabilityError, match="another shaft"):
        planned_with(with_spindle(tmp_path, shipped), model)
