"""The speed's step: safe blocks only, hysteresis, dwell, one jump between pockets, frozen within a cut."""

import math
from dataclasses import replace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from models.records import Phase
from models.spindle_speed.tuning import (
    SpeedChoice,
    SpeedState,
    SpeedTuningError,
    SpeedTuningInputs,
    SpeedTuningMemory,
    SpeedTuningSettings,
    SpindleSpeedCommand,
    initial_memory,
    step,
)

SETTINGS = SpeedTuningSettings(hysteresis_rpm=50.0, dwell_s=20.0, step_rpm=100.0)


def choice(speed_rpm: float, pocket: tuple[float, float] | None = None, alarm: str | None = None) -> SpeedChoice:
    return SpeedChoice(
        speed_rpm=speed_rpm,
        limiting_depth_mm=3.0,
        pocket_rpm=pocket or (speed_rpm - 400.0, speed_rpm + 400.0),
        alarm=alarm,
    )


def at(
    now_s: float, target: SpeedChoice | None, phase: Phase = Phase.SAFE_POINT, **changes: object
) -> SpeedTuningInputs:
    base = SpeedTuningInputs(
        now_s=now_s, phase=phase, enabled=True, programmed_rpm=8000.0, programmed_feed_mm_min=1600.0, choice=target
    )
    return replace(base, **changes)


def begun(speed_rpm: float = 8600.0) -> SpeedTuningMemory:
    command, memory = step(initial_memory(8000.0), at(0.0, choice(speed_rpm)), SETTINGS)
    assert command.write
    return memory


def test_a_step_of_a_sensor_may_move_the_target_by_less_than_half_the_hysteresis() -> None:
    SETTINGS.check_resolution(24.9)
    for change_rpm in (25.0, 40.0, math.nan, math.inf):
        with pytest.raises(SpeedTuningError, match="the speed would hunt"):
            SETTINGS.check_resolution(change_rpm)


def test_the_first_safe_block_takes_the_choice_with_its_feed() -> None:
    command, memory = step(initial_memory(8000.0), at(0.0, choice(8600.0)), SETTINGS)
    assert (command.speed_rpm, command.write, command.state) == (8600.0, True, SpeedState.TUNED)
    assert command.feed_mm_min == pytest.approx(1600.0 * 8600.0 / 8000.0)
    assert memory.commanded_rpm == 8600.0
    plain = step(initial_memory(8000.0), at(0.0, choice(8600.0)), replace(SETTINGS, keep_feed_per_tooth=False))[0]
    assert plain.feed_mm_min == 1600.0


def test_less_than_the_hysteresis_changes_nothing() -> None:
    memory = begun()
    for now_s in range(1, 200, 5):
        command, memory = step(memory, at(float(now_s), choice(8649.0)), SETTINGS)
        assert not command.write
    assert memory.commanded_rpm == 8600.0


def test_a_target_must_last_and_then_moves_in_steps_inside_the_pocket() -> None:
    memory = begun()
    pocket = (8300.0, 9200.0)
    for now_s in (1.0, 10.0, 20.9):
        command, memory = step(memory, at(now_s, choice(8850.0, pocket)), SETTINGS)
        assert not command.write
    taken = []
    for now_s in (21.0, 22.0, 23.0, 24.0):
        command, memory = step(memory, at(now_s, choice(8850.0, pocket)), SETTINGS)
        taken.append((command.speed_rpm, command.write, command.jump))
    assert taken == [(8700.0, True, False), (8800.0, True, False), (8800.0, False, False), (8800.0, False, False)]


def test_a_target_in_another_pocket_has_yet_to_last() -> None:
    memory = begun()
    for now_s in range(1, 60):
        command, memory = step(memory, at(float(now_s), choice(10600.0), Phase.CUTTING), SETTINGS)
    for now_s in (60.0, 70.0, 79.9):
        command, memory = step(memory, at(now_s, choice(7000.0)), SETTINGS)
        assert not command.write, "it is off the command for long, but there for a moment only"
        assert (command.speed_rpm, command.state) == (8600.0, SpeedState.HOLD)
        assert command.reason.startswith("8600 1/min is not among the stable speeds, 6600 to 7400, of which")
    command, memory = step(memory, at(80.1, choice(7000.0)), SETTINGS)
    assert command.write and command.jump and command.speed_rpm == 7000.0


def test_a_narrow_pocket_that_drifts_is_followed() -> None:
    memory = begun()
    for now_s in range(1, 60):
        speed_rpm = 10600.0 + 2.0 * now_s
        command, memory = step(memory, at(float(now_s), choice(speed_rpm, (speed_rpm, speed_rpm))), SETTINGS)
    assert memory.commanded_rpm > 10600.0


def test_the_filter_smooths_inside_a_pocket_only() -> None:
    settings = replace(SETTINGS, filter_s=60.0, dwell_s=0.0)
    memory = step(initial_memory(8000.0), at(0.0, choice(8600.0)), settings)[1]
    command, memory = step(memory, at(1.0, choice(8700.0, (8000.0, 9000.0))), settings)
    assert not command.write
    assert 8600.0 < memory.target_rpm < 8610.0
    assert step(memory, at(2.0, choice(6500.0, (6400.0, 6700.0))), settings)[0].speed_rpm == 6500.0


def test_another_pocket_is_one_jump() -> None:
    memory = begun()
    other = choice(6500.0, (6400.0, 6700.0))
    memory = step(memory, at(1.0, other), SETTINGS)[1]
    command, memory = step(memory, at(21.0, other), SETTINGS)
    assert (command.speed_rpm, command.jump, command.write) == (6500.0, True, True)


@pytest.mark.parametrize("phase", [Phase.CUTTING, Phase.IDLE])
def test_nothing_is_written_outside_a_safe_block(phase: Phase) -> None:
    memory = begun()
    for now_s, target in ((1.0, choice(9500.0)), (50.0, choice(6000.0)), (90.0, None)):
        command, memory = step(memory, at(now_s, target, phase), SETTINGS)
        assert (command.speed_rpm, command.write) == (8600.0, False)
    disabled, memory = step(memory, at(95.0, None, phase, enabled=False), SETTINGS)
    assert (disabled.speed_rpm, disabled.write) == (8600.0, False)


def test_lost_data_freeze_also_at_a_safe_block() -> None:
    memory = begun()
    command, memory = step(memory, at(100.0, None), SETTINGS)
    assert (command.state, command.speed_rpm, command.write) == (SpeedState.HOLD, 8600.0, False)


def test_a_flagged_property_that_moves_the_speed_blocks_it() -> None:
    memory = begun()
    command, memory = step(memory, at(100.0, choice(9000.0), flagged_span_rpm=51.0), SETTINGS)
    assert command.state is SpeedState.HOLD
    assert command.alarm is not None
    assert "51 1/min" in command.alarm
    assert memory.commanded_rpm == 8600.0
    assert step(memory, at(101.0, choice(9000.0), flagged_span_rpm=math.nan), SETTINGS)[0].state is SpeedState.HOLD


def test_no_stable_speed_returns_to_the_programmed_one_with_an_alarm() -> None:
    memory = begun()
    none = choice(8000.0, (8000.0, 8000.0), alarm="no speed is stable")
    memory = step(memory, at(1.0, none), SETTINGS)[1]
    command, memory = step(memory, at(21.0, none), SETTINGS)
    assert (command.state, command.speed_rpm, command.feed_mm_min) == (SpeedState.NO_STABLE_SPEED, 8000.0, 1600.0)
    assert command.alarm == "no speed is stable"


def test_disabling_returns_at_the_next_safe_block() -> None:
    memory = begun()
    command, memory = step(memory, at(1.0, choice(8600.0), enabled=False), SETTINGS)
    assert (command.state, command.speed_rpm, command.write) == (SpeedState.OFF, 8000.0, True)


@pytest.mark.parametrize("target", [None, choice(6000.0)])
def test_an_operation_that_begins_without_data_runs_as_programmed(target: SpeedChoice | None) -> None:
    blocked = at(1.0, target, programmed_rpm=6000.0, flagged_span_rpm=1e3)
    command, memory = step(begun(), blocked, SETTINGS)
    assert (command.state, command.speed_rpm, command.write) == (SpeedState.HOLD, 6000.0, True)
    later = at(2.0, choice(6100.0), programmed_rpm=6000.0)
    assert step(memory, later, SETTINGS)[0].speed_rpm == 6100.0


def test_without_a_stable_speed_the_programmed_one_is_taken_however_near_the_command_is() -> None:
    memory = step(initial_memory(8000.0), at(0.0, choice(8030.0)), SETTINGS)[1]
    assert memory.commanded_rpm == 8030.0
    none_stable = choice(8000.0, (8000.0, 8000.0), alarm="none")
    cutting = step(memory, at(1.0, none_stable, Phase.CUTTING), SETTINGS)[0]
    assert (cutting.speed_rpm, cutting.write, cutting.alarm) == (8030.0, False, "none")
    assert "waiting for a safe block" in cutting.reason
    command = step(memory, at(1.0, none_stable), SETTINGS)[0]
    assert (command.speed_rpm, command.write, command.state) == (8000.0, True, SpeedState.NO_STABLE_SPEED)


def test_a_failed_write_leaves_what_the_cnc_applies() -> None:
    memory = replace(begun(), commanded_rpm=8000.0)
    memory = step(memory, at(1.0, choice(8600.0, (7900.0, 9000.0))), SETTINGS)[1]
    assert step(memory, at(30.0, choice(8600.0, (7900.0, 9000.0))), SETTINGS)[0].speed_rpm == 8100.0


WISHES = st.one_of(
    st.none(),
    st.builds(choice, st.floats(4000.0, 12000.0)),
    st.just(choice(8000.0, (8000.0, 8000.0), alarm="none")),
)


@settings(deadline=None)
@given(
    st.lists(
        st.tuples(st.floats(0.0, 30.0), WISHES, st.sampled_from(list(Phase)), st.booleans(), st.floats(0.0, 100.0)),
        max_size=60,
    )
)
def test_whatever_happens(history: list) -> None:
    memory, now_s, before = initial_memory(8000.0), 0.0, 8000.0
    for elapsed_s, target, phase, enabled, span in history:
        now_s += elapsed_s
        inputs = at(now_s, target, phase, enabled=enabled, flagged_span_rpm=span)
        command, memory = step(memory, inputs, SETTINGS)
        assert isinstance(command, SpindleSpeedCommand)
        assert command.write == (command.speed_rpm != before)
        assert not (command.write and phase is not Phase.SAFE_POINT)
        assert math.isclose(command.feed_mm_min / command.speed_rpm, 1600.0 / 8000.0)
        assert 4000.0 <= command.speed_rpm <= 12000.0
        if command.state is SpeedState.NO_STABLE_SPEED and phase is Phase.SAFE_POINT:
            assert command.speed_rpm == 8000.0
        before = command.speed_rpm
