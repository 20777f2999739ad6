"""Sensors that leave, return and are excluded: over a restart, another model, and in the means of labels."""

from dataclasses import replace

import numpy as np
import pytest
from control_rig import SENSOR_IDS
from thermal_rig import Task, model

from daemon.estimation.task import thermal_snapshot
from daemon.messages import ReferenceRebased, ReferenceTakenUp, TemperaturesTrusted


async def _away(task):
    """Bring it so far that sensor 1 is away while the others have risen by 2 K; return the estimate and the label."""
    await task.minutes(2)
    await task.ask()
    await task.minutes(3, spindle=22.0, column=22.0)
    await task.minutes(4, spindle=[np.nan, 22.0, 22.0], column=22.0)
    assert task.estimates[-1].imputed == (1,)
    return task.estimates[-1]


def assert_unmoved(task, before):
    """No estimate of this daemon is another than the one before."""
    assert task.estimates[-1].imputed == ()
    for estimate in task.estimates:
        assert estimate.thermal_error_um == pytest.approx(before.thermal_error_um, abs=1e-9)
        assert estimate.label_increment_degc["A"] == pytest.approx(before.label_increment_degc["A"], abs=1e-9)


async def test_a_sensor_that_returns_after_a_restart_moves_nothing_either(task):
    before, reference = await _away(task), task.references[-1]
    again = task.restarted(model())
    try:
        again.clock.monotonic_s += 300.0
        await again.task._take(task.taken_up(reference))
        await again.minutes(3, spindle=[30.0, 22.0, 22.0], column=22.0)
        assert_unmoved(again, before)
        await again.minutes(2, spindle=[30.5, 22.0, 22.0], column=22.0)
        assert again.estimates[-1].thermal_error_um == pytest.approx(before.thermal_error_um + 1.0), "then it counts"
    finally:
        again.history.close()


async def test_a_sensor_that_returns_after_the_model_was_loaded_anew_moves_nothing_either(task):
    before = await _away(task)
    task.delivered.clear()
    await task.task.use_model(model(model_id="another"))
    await task.minutes(3, spindle=[30.0, 22.0, 22.0], column=22.0)
    assert_unmoved(task, before)


async def test_a_sensor_that_returned_under_a_model_without_it_is_set_anew_by_the_next(task):
    before = await _away(task)
    without = model(
        model_id="without 1",
        sensor_ids=SENSOR_IDS[1:],
        sensor_names=tuple(f"t{i}" for i in SENSOR_IDS[1:]),
        coefficients_um_per_k=np.array([[0.0, 0.0, 1.0, 0.0]]),
        lowest_increment_k=np.full(4, -20.0),
        highest_increment_k=np.full(4, 20.0),
        test_pairs=[(np.full(4, 21.0), np.full(4, 20.0))],
    )
    await task.task.use_model(without)
    await task.minutes(2, spindle=[30.0, 22.0, 22.0], column=22.0)
    await task.task.use_model(model())
    task.delivered.clear()
    await task.minutes(2, spindle=[30.0, 22.0, 22.0], column=22.0)
    assert_unmoved(task, before)


async def test_after_a_restart_a_line_that_speaks_later_than_the_others_has_not_been_away(task):
    await task.minutes(2)
    await task.ask()
    await task.minutes(3, spindle=20.0, column=23.0)
    before, reference = task.estimates[-1], task.references[-1]
    assert before.thermal_error_um == pytest.approx([3.0])
    again = task.restarted(model())
    try:
        await again.task._take(task.taken_up(reference))
        await again.cycle("spindle", 20.0)
        assert again.estimates == []
        await again.minutes(2, spindle=20.0, column=23.0)
        assert_unmoved(again, before)
    finally:
        again.history.close()


async def test_after_a_restart_a_line_that_stays_silent_is_imputed_once_it_would_be_stale(task):
    await task.minutes(2)
    await task.ask()
    await task.minutes(1)
    again = task.restarted(model())
    try:
        await again.task._take(task.taken_up(task.references[-1]))
        await again.minutes(1, column=None)
        assert again.estimates == []
        await again.minutes(0.5, column=None)
        assert again.estimates[-1].imputed == (11, 12)
    finally:
        again.history.close()


async def test_what_is_known_since_another_reference_is_not_taken_over(task):
    await _away(task)
    await task.ask("r2")
    other = replace(task.references[0], reference_id="r0")
    again = task.restarted(model())
    try:
        await again.task._take(task.taken_up(other))
        await again.minutes(2, spindle=22.0, column=22.0)
        assert again.estimates[-1].thermal_error_um == pytest.approx([6.0])
    finally:
        again.history.close()


async def test_the_label_of_a_tool_does_not_jump_when_a_sensor_leaves_or_returns(tmp_path):
    """Sensor 12 is in the label, and the model does not know it."""
    chosen = SENSOR_IDS[:4]
    small = model(
        sensor_ids=chosen,
        sensor_names=tuple(f"t{i}" for i in chosen),
        coefficients_um_per_k=np.array([[2.0, 0.0, 0.0, 1.0]]),
        lowest_increment_k=np.full(4, -20.0),
        highest_increment_k=np.full(4, 20.0),
        test_pairs=[(np.full(4, 21.0), np.full(4, 20.0))],
    )
    task = Task(tmp_path, small)
    task.history.start()
    await task.minutes(2)
    await task.ask()
    await task.minutes(3, spindle=22.0, column=[22.0, 27.0])
    assert task.estimates[-1].label_increment_degc["A"] == pytest.approx(3.0)
    task.delivered.clear()
    await task.minutes(4, spindle=22.0, column=[22.0, np.nan])
    await task.minutes(4, spindle=22.0, column=[22.0, 42.0])
    assert {round(estimate.label_increment_degc["A"], 9) for estimate in task.estimates} == {3.0}
    await task.minutes(4, spindle=22.0, column=[22.0, np.nan])
    reference = next((item for item in reversed(task.delivered) if isinstance(item, ReferenceRebased)), None)
    assert reference is None, "the model has no sensor that returned"
    kept = task.task._reference
    again = task.restarted(small)
    try:
        await again.task._take(task.taken_up(kept))
        await again.minutes(4, spindle=22.0, column=[22.0, 10.0])
        assert {round(estimate.label_increment_degc["A"], 9) for estimate in again.estimates} == {3.0}
        await again.minutes(2, spindle=22.0, column=[22.0, 11.0])
        assert again.estimates[-1].label_increment_degc["A"] == pytest.approx(3.2)
    finally:
        again.history.close()


async def test_a_sensor_that_was_found_wrong_holds_when_the_tool_s_temperature_holds_it(task):
    """The model leaves it out; the mean of its label does not, and a tool may have begun to count from that."""
    await task.minutes(2)
    await task.ask()
    await task.minutes(2)
    task.task._tool_um_per_k = np.where(np.array(SENSOR_IDS) == 1, 0.5, 0.0)
    found = replace(task.sensors, excluded={1: "departure"})
    task.task._reference = None  # as after a restart
    await task.task._take(ReferenceTakenUp(reference=task.references[-1], sensors=found))
    await task.minutes(2)
    assert "tool" not in task.estimates[-1].inhibit, "it has made nothing of it yet"
    for rise_k in np.arange(0.5, 4.1, 0.5):
        await task.minutes(1, spindle=[20.0 + rise_k, 20.0, 20.0])
    await task.minutes(1, spindle=[24.0, 20.0, 20.0])
    assert "the tool's temperature holds sensor 1, found wrong, which may be 2.0 um" in task.estimates[-1].inhibit
    for rise_k in np.arange(3.5, -0.1, -0.5):
        await task.minutes(1, spindle=[20.0 + rise_k, 20.0, 20.0])
    assert "which may be 2.0 um" in task.estimates[-1].inhibit, "a tool may have begun meanwhile"
    assert task.sensors.wrong_in_tool_um == pytest.approx(2.0), "a restart knows it"
    await task.ask("r2")
    assert "tool" not in task.estimates[-1].inhibit


@pytest.mark.parametrize("restarted", [False, True])
async def test_a_reference_that_another_one_was_refused_for_is_in_doubt_as_before(tmp_path, restarted):
    """The work was positioned with an offset applied under zero_first: tool settings count from the former one."""
    task = Task(tmp_path, model())
    task.history.start()
    await task.minutes(3)
    await task.ask("r1")
    reference = task.references[-1]
    await task.minutes(3, spindle=[24.0, 20.0, 20.0])
    assert "the level of sensor 1 by 4.0 K" in task.estimates[-1].inhibit
    kept = task.taken_up(reference)
    await task.ask("r2")
    await task.minutes(0.5, spindle=[24.0, 20.0, 20.0])
    assert task.estimates[-1].inhibit == "" and task.estimates[-1].reference_id == "r2"
    await task.task._take(kept)
    await task.minutes(0.5, spindle=[24.0, 20.0, 20.0])
    if restarted:
        await task.history.flushed()
        task = task.restarted(model())
        await task.task._take(kept)
        await task.minutes(2, spindle=[24.0, 20.0, 20.0])
    assert task.estimates[-1].reference_id == "r1"
    assert "the level of sensor 1 by 4.0 K" in task.estimates[-1].inhibit
    await task.minutes(2)
    assert task.estimates[-1].inhibit == "", "it is where it was"
    task.history.close()


async def test_a_model_that_waits_waits_on_where_the_reference_at_which_it_took_over_is_refused(task):
    """It went on from an estimate that nobody follows: 4 um off once the sensor was back, until the next reference."""
    coefficients = np.zeros((1, len(SENSOR_IDS)))
    coefficients[0, 0] = 4.0
    await task.minutes(2)
    await task.ask("r1")
    await task.minutes(6, spindle=[np.nan, 20.0, 20.0])
    kept = task.taken_up(task.references[-1])
    await task.task.use_model(model(model_id="next", coefficients_um_per_k=coefficients))
    for rise_k in np.arange(0.5, 4.1, 0.5):
        await task.minutes(1, spindle=[np.nan, 20.0, 20.0 + rise_k])
    assert "may be 4.8 um off" in task.estimates[-1].inhibit
    await task.ask("r2")
    assert task.estimates[-1].model_id == "next", "what was before the new reference says nothing of it"
    await task.task._take(kept)
    await task.minutes(1, spindle=[np.nan, 20.0, 24.0])
    assert (task.estimates[-1].reference_id, task.estimates[-1].model_id) == ("r1", "made-up")
    assert thermal_snapshot(task.task).model_waits
    await task.minutes(6, spindle=[24.0, 20.0, 24.0])
    before = [one for one in task.estimates if one.model_id == "made-up"][-1]
    assert task.estimates[-1].model_id == "next" and before.inhibit == ""
    assert before.thermal_error_um == pytest.approx(8.0, abs=0.6), "the truth, but for what fades yet"


@pytest.mark.parametrize("restarted", [False, True])
async def test_nor_is_it_trusted_after_many_refusals_or_one_after_a_restart(tmp_path, restarted):
    """A program that positions again and again under zero_first, or the first time since the daemon was started."""
    task = Task(tmp_path, model())
    task.history.start()
    await task.minutes(3)
    await task.ask("r1")
    reference = task.references[-1]
    await task.minutes(3, spindle=[24.0, 20.0, 20.0])
    kept = task.taken_up(reference)
    if restarted:
        await task.history.flushed()
        task = task.restarted(model())
        await task.task._take(kept)
        await task.minutes(2, spindle=[24.0, 20.0, 20.0])
    for again in range(1 if restarted else 6):
        await task.ask(f"refused {again}")
        await task.task._take(kept)
        await task.minutes(2, spindle=[24.0, 20.0, 20.0])
        assert task.estimates[-1].reference_id == "r1"
        assert "the level of sensor 1 by 4.0 K" in task.estimates[-1].inhibit, again
    await task.minutes(2)
    assert task.estimates[-1].inhibit == "", "it is where it was"
    task.history.close()


async def test_what_a_person_trusts_is_not_doubted_again_by_a_reference_that_is_refused(tmp_path):
    task = Task(tmp_path, model())
    task.history.start()
    await task.minutes(3)
    await task.ask("r0")
    await task.minutes(3, spindle=[24.0, 20.0, 20.0])
    await task.ask("r1")
    reference = task.references[-1]
    await task.minutes(1, spindle=[24.0, 20.0, 20.0])
    kept = task.taken_up(reference)
    await task.task._take(TemperaturesTrusted(person="a person"))
    await task.ask("r2")
    await task.task._take(kept)
    await task.minutes(1, spindle=[24.0, 20.0, 20.0])
    assert task.estimates[-1].reference_id == "r1" and task.estimates[-1].inhibit == ""
    task.history.close()


async def test_the_label_of_a_tool_has_no_value_while_the_level_of_its_sensor_is_in_doubt(task):
    """A tool that came meanwhile began at the wrong level: once the sensor was itself again, it was 1.5 um off."""
    await task.minutes(2)
    await task.ask()
    await task.minutes(2)
    task.task._tool_um_per_k = np.full(len(SENSOR_IDS), 0.4)
    await task.minutes(3, spindle=[24.0, 20.0, 20.0])
    assert task.estimates[-1].confidence == 0.0 and task.estimates[-1].label_increment_degc == {}
    await task.minutes(3)
    assert task.estimates[-1].confidence == 1.0
    assert task.estimates[-1].label_increment_degc == {"A": pytest.approx(0.0, abs=0.01)}
