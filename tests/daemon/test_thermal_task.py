"""The thermal task: cycles in, cleansed temperatures, references and estimates out."""

import asyncio
from types import SimpleNamespace

import numpy as np
import pytest
import structlog
from control_rig import machine
from thermal_rig import Task, model

from daemon.estimation.task import _unsure, _waits_for, thermal_snapshot
from daemon.history.reader import HistoryReader
from daemon.messages import ReferenceEnded, ReferenceRebased, ReferenceRefused, ReferenceTakenUp
from models.quality import Quality, Reason
from models.records import TemperatureCycle


async def test_a_reference_before_any_temperature_is_refused_in_words(task):
    with structlog.testing.capture_logs() as logs:
        await task.ask()
    assert [item for item in task.delivered if isinstance(item, ReferenceRefused) and "no temperature" in item.why]
    assert not [entry for entry in logs if entry["event"] == "thermal.defect"]


async def test_the_reference_is_the_mean_of_the_last_minute(task):
    await task.minutes(5, spindle=10.0)
    for degc in (20.0, 20.5, 21.0, 20.5, 20.0, 20.5):
        await task.minutes(1 / 6, spindle=degc)
    # A step of ten degrees is held for two samples and then believed: use a level that is accepted at once.
    await task.minutes(2, spindle=20.0)
    await task.ask()
    assert task.references[-1].degc == pytest.approx(np.full(5, 20.0))


async def test_the_estimate_is_zero_at_the_reference_and_follows_from_there(task):
    await task.minutes(2)
    assert task.estimates == []
    await task.ask()
    assert task.estimates[0].thermal_error_um == pytest.approx([0.0])
    assert task.estimates[0].reference_id == "r1"
    await task.minutes(3, spindle=20.5, column=20.25)
    assert task.estimates[-1].thermal_error_um == pytest.approx([2.0 * 0.5 + 0.25])
    assert task.estimates[-1].confidence == 1.0 and task.estimates[-1].imputed == ()
    before = len(task.estimates)
    await task.minutes(1 / 6)
    assert len(task.estimates) == before + 2, "renewed at every line's cycle"


async def test_a_reference_taken_up_again_gives_estimates(task):
    await task.minutes(2)
    await task.ask()
    reference = task.references[0]
    task.delivered.clear()
    task.task._reference = None
    await task.task._take(task.taken_up(reference))
    await task.minutes(1)
    assert {estimate.reference_id for estimate in task.estimates} == {"r1"}


async def test_sensors_of_a_dead_line_are_imputed_once_they_are_stale(task):
    await task.minutes(2)
    await task.ask()
    await task.minutes(1, spindle=20.5, column=None)
    assert task.estimates[-1].imputed == ()
    await task.minutes(4, spindle=20.5, column=None)
    last = task.estimates[-1]
    assert last.imputed == (11, 12)
    assert last.confidence < 1.0
    assert np.isfinite(last.thermal_error_um).all()
    assert last.thermal_error_um == pytest.approx([1.0 + 0.5]), "imputed over the whole interval since the reference"
    latest = task.task.latest
    assert np.isnan(latest.degc[3:]).all()
    assert (latest.quality[3:] == Quality.MISSING).all()
    assert (latest.reason[3:] == Reason.STALE).all()
    assert np.isfinite(latest.degc).sum() == 3
    await task.minutes(3, spindle=20.5, column=20.0)
    assert task.estimates[-1].imputed == ()
    assert (task.task.latest.quality == Quality.GOOD).all()


async def test_nan_never_leaves(task):
    await task.minutes(2)
    await task.ask()
    await task.minutes(4, spindle=[np.nan, 20.5, np.nan])
    for estimate in task.estimates:
        assert np.isfinite(estimate.thermal_error_um).all()
    assert 1 in task.estimates[-1].imputed
    before = len(task.estimates)
    await task.minutes(5, spindle=np.nan, column=np.nan)
    for estimate in task.estimates[before:]:
        assert np.isfinite(estimate.thermal_error_um).all()
    assert np.isnan(task.task.latest.degc).all()
    assert len(task.estimates) - before <= 2 * 6 * 2.5, "and with nothing left there is no estimate"


async def test_without_a_model_there_are_references_but_no_estimates(tmp_path):
    task = Task(tmp_path, None)
    task.history.start()
    try:
        await task.minutes(2)
        await task.ask()
        await task.minutes(1)
        assert len(task.references) == 1 and task.estimates == []
    finally:
        task.history.close()


async def test_every_cycle_and_estimate_is_in_the_store(tmp_path):
    task = Task(tmp_path, model())
    task.history.start()
    await task.minutes(2)
    await task.ask()
    await task.minutes(1)
    await task.cycle("spindle", [20.0, np.nan, 20.0], complete=False)
    task.history.close()
    assert (task.task.cycles_received, task.task.cycles_incomplete) == (37, 1)
    with HistoryReader(task.configuration.history.path) as reader:
        assert reader.row_count("temperatures") == 37
        assert reader.row_count("estimates") == task.task.estimates
        assert reader.acknowledged() == task.numbers


async def test_the_task_survives_what_nobody_expected(task):
    running = asyncio.create_task(task.task.run())
    try:
        with structlog.testing.capture_logs() as logs:
            task.task.inbox.put_nowait(TemperatureCycle.__new__(TemperatureCycle))
            await task.ask()
            while not task.task.inbox.empty():
                await asyncio.sleep(0.001)
        assert [entry["event"] for entry in logs].count("thermal.defect") == 1
        assert not running.done()
    finally:
        running.cancel()
        await asyncio.gather(running, return_exceptions=True)


async def test_a_sensor_that_returns_at_another_level_moves_nothing(task):
    await task.minutes(2)
    await task.ask()
    await task.minutes(3, spindle=[22.0, 22.0, 22.0])
    before = task.estimates[-1].thermal_error_um.copy()
    await task.minutes(4, spindle=[np.nan, 22.0, 22.0])
    assert task.estimates[-1].imputed
    imputed = task.estimates[-1].thermal_error_um.copy()
    await task.minutes(4, spindle=[29.0, 22.0, 22.0])
    returned = task.estimates[-1]
    assert returned.imputed == ()
    assert returned.thermal_error_um == pytest.approx(imputed, abs=1e-9)
    assert imputed == pytest.approx(before, abs=1e-9)
    await task.minutes(4, spindle=[29.5, 22.0, 22.0])
    assert not np.allclose(task.estimates[-1].thermal_error_um, imputed), "and from then on it counts"
    assert not any(isinstance(item, ReferenceRebased) for item in task.delivered), "the reference stays what it was"
    assert task.task._cleansing.levels.shift_k == pytest.approx([7.0, 0.0, 0.0, 0.0, 0.0])


async def test_what_a_return_still_has_to_fade_is_told_and_is_gone_two_minutes_later(task):
    await task.minutes(2)
    await task.ask()
    await task.minutes(5, spindle=22.0, column=None)
    assert task.estimates[-1].imputed and task.estimates[-1].fading_um == 0.0
    begun = len(task.estimates)
    await task.minutes(4, spindle=22.0, column=20.0)
    returned = [each for each in task.estimates[begun:] if not each.imputed]
    first = returned[0]
    later = [
        each for each in returned if each.trace.first_byte.monotonic_s >= first.trace.first_byte.monotonic_s + 120.0
    ]
    assert first.fading_um > 0.5
    assert later[0].fading_um < 0.02 * first.fading_um
    off_um = np.abs(first.thermal_error_um - later[-1].thermal_error_um).max()
    assert off_um == pytest.approx(first.fading_um, rel=0.3), "the input has not changed since"


async def test_a_sensor_that_was_missing_at_the_reference_counts_from_its_first_value_on(task):
    await task.minutes(2, spindle=[np.nan, 20.0, 20.0])
    await task.ask()
    await task.minutes(2, spindle=[np.nan, 21.0, 21.0])
    imputed = task.estimates[-1].thermal_error_um.copy()
    await task.minutes(3, spindle=[35.0, 21.0, 21.0])
    assert task.estimates[-1].thermal_error_um == pytest.approx(imputed, abs=1e-9)
    assert task.estimates[-1].imputed == ()


async def test_after_a_reference_has_ended_nothing_is_estimated_from_it(task):
    await task.minutes(2)
    await task.ask()
    await task.minutes(1)
    count = len(task.estimates)
    assert count
    await task.task._take(ReferenceEnded(reference_id="another"))
    await task.minutes(1)
    assert len(task.estimates) > count
    await task.task._take(ReferenceEnded(reference_id="r1"))
    count = len(task.estimates)
    await task.minutes(1)
    assert len(task.estimates) == count


async def test_after_too_few_sensors_the_estimate_goes_on_from_what_was_followed_last(task):
    """The output has held meanwhile: what one sensor of two makes of it would lead it astray."""
    await task.minutes(2)
    await task.ask()
    await task.minutes(3, spindle=20.9)
    followed = task.estimates[-1]
    assert followed.confidence == 1.0 and followed.fading_um == followed.held_s == 0.0
    await task.minutes(0.5, spindle=None)
    assert task.estimates[-1].held_s == 30.0, "nothing is counted from what sensors said half a minute ago"
    await task.minutes(3.5, spindle=None)
    astray = task.estimates[-1]
    assert astray.confidence < 0.7 and abs(astray.thermal_error_um - followed.thermal_error_um) > 1.0
    seen = len(task.estimates)
    await task.minutes(12, spindle=21.3)
    back = [one for one in task.estimates[seen:] if one.confidence == 1.0]
    errors = [float(one.thermal_error_um[0]) for one in back]
    assert errors[0] == pytest.approx(followed.thermal_error_um[0], abs=1e-9)
    assert errors == sorted(errors) and errors[-1] == pytest.approx(2.6, abs=0.05)
    assert back[0].fading_um == pytest.approx(errors[-1] - errors[0], abs=0.1) and back[-1].fading_um < 0.1


async def test_a_reference_waits_until_no_mean_holds_two_levels(task):
    await task.minutes(2)
    await task.minutes(0.5, spindle=[22.5, 20.0, 20.0])
    await task.ask()
    refused = task.delivered[-1]
    assert isinstance(refused, ReferenceRefused)
    assert "the level of sensor 1 has changed within the last 60 s: position again in a minute" in refused.why
    await task.minutes(1.5, spindle=[22.5, 20.0, 20.0])
    await task.ask("r2")
    assert task.references[-1].reference_id == "r2" and task.references[-1].degc[0] == 22.5


async def test_a_reference_waits_until_no_mean_holds_what_a_silent_sensor_had(task):
    """The nose went on warming, and the reference held what it had before: that stayed, 1.5 um, as long as it did."""
    await task.minutes(4, spindle=20.0)
    await task.minutes(1.5, spindle=[np.nan, 20.0, 20.0])
    await task.ask()
    refused = task.delivered[-1]
    assert isinstance(refused, ReferenceRefused)
    assert "sensor 1 has been silent for 9" in refused.why and "position again when it is back" in refused.why
    await task.minutes(1.5, spindle=[21.0, 20.0, 20.0])
    await task.ask("r2")
    assert task.references[-1].reference_id == "r2" and task.references[-1].degc[0] == pytest.approx(21.0, abs=0.1)


@pytest.mark.parametrize(("silent_min", "heard"), [(0.3, True), (3.0, False)])
async def test_a_short_silence_and_a_sensor_that_is_left_out_keep_no_reference_waiting(task, silent_min, heard):
    await task.minutes(4, spindle=20.0)
    await task.minutes(silent_min, spindle=[np.nan, 20.0, 20.0])
    await task.ask()
    assert task.references[-1].reference_id == "r1" and bool(np.isfinite(task.references[-1].degc[0])) is heard


async def test_a_sensor_that_jumps_although_it_was_heard_all_the_time_is_doubted(task):
    """Its last value that counted is so old that the jump would be explained, but nobody was silent."""
    await task.minutes(2)
    await task.ask()
    await task.minutes(3, spindle=[22.5, 20.0, 20.0])
    assert task.estimates[-1].confidence == 0.0 and "the level of sensor 1 by 2.5 K" in task.estimates[-1].inhibit
    await task.minutes(3, spindle=20.0)
    assert task.estimates[-1].confidence == 1.0
    assert task.estimates[-1].thermal_error_um == pytest.approx(0.0, abs=0.01)


@pytest.mark.parametrize("jump_k", [4.0, 8.0, -8.0])
async def test_a_whole_line_that_jumps_although_it_was_heard_all_the_time_is_doubted(task, jump_k):
    """8 K took so long to be accepted that the sensors seemed away, and explained each other: 16 um in silence."""
    await task.minutes(5)
    await task.ask()
    await task.minutes(4, spindle=20.0 + jump_k)
    assert task.estimates[-1].confidence == 0.0 and "the level of sensor 1" in task.estimates[-1].inhibit
    await task.minutes(4)
    assert task.estimates[-1].confidence == 1.0 and task.estimates[-1].thermal_error_um == pytest.approx([0.0])


async def test_a_sensor_that_was_missing_at_the_reference_does_not_count_from_a_doubted_level(task):
    await task.minutes(2)
    await task.minutes(2, spindle=[np.nan, 20.0, 20.0])
    await task.ask()
    await task.minutes(3, spindle=[23.0, 20.0, 20.0])
    await task.minutes(4, spindle=20.0)
    assert task.estimates[-1].imputed == () and task.estimates[-1].confidence == 1.0
    assert task.estimates[-1].thermal_error_um == pytest.approx(0.0, abs=0.01)


async def test_a_model_released_while_sensors_come_and_go_waits(task):
    """The difference of two models stays as long as the reference: it is not taken where one has fewer sensors."""
    await task.minutes(2)
    await task.ask()
    await task.minutes(3, spindle=20.9)
    await task.task.use_model(model(model_id="next"))
    await task.minutes(4, spindle=None, column=None)
    await task.minutes(0.5, spindle=None, column=20.0)
    assert {one.model_id for one in task.estimates} == {"made-up"}, "it waits"
    waits = thermal_snapshot(task.task).model_waits
    assert waits.startswith("next makes no estimates yet: ") and not waits.endswith(": "), "and a person can read why"
    await task.minutes(12, spindle=21.3)
    assert task.estimates[-1].model_id == "next" and thermal_snapshot(task.task).model_waits == ""
    before = next(one for one in reversed(task.estimates) if one.model_id == "made-up")
    after = next(one for one in task.estimates if one.model_id == "next")
    assert before.imputed == after.imputed == ()
    assert after.thermal_error_um == pytest.approx(before.thermal_error_um, abs=0.5)


async def test_what_the_others_say_of_a_missing_sensor_holds_when_it_may_be_off(task):
    await task.minutes(2, spindle=[20.0, 20.0, 20.0])
    await task.ask()
    await task.minutes(5, spindle=[20.2, 20.1, 20.2])
    await task.minutes(2, spindle=[np.nan, 20.1, 20.2])
    alike = task.estimates[-1]
    assert (alike.imputed, alike.inhibit) == ((1,), ""), "those beside it have hardly departed from each other"
    await task.minutes(10, spindle=[np.nan, 20.1, 24.0])
    apart = task.estimates[-1]
    assert (apart.imputed, apart.confidence) == ((1,), 0.0)
    assert apart.inhibit == (
        "what the other sensors say in place of sensor 1 may be 4.8 um off since the reference: bring back what is "
        "missing, and if it still holds then, position the work again"
    )
    await task.ask("r2")
    assert task.estimates[-1].inhibit == "", "nothing has moved since"


@pytest.mark.parametrize(("imputed_um", "waits"), [(0.8, False), (1.2, True)])
def test_another_model_waits_while_what_it_imputes_may_be_off(imputed_um, waits):
    """It goes on from the estimate, so that its own error would stay when the sensor is back and it is right again."""
    time = SimpleNamespace(monotonic_s=100.0)
    estimate = SimpleNamespace(
        trace=SimpleNamespace(first_byte=time), reference_id="r", imputed=(1,), in_domain=True, confidence=1.0,
        held_s=0.0, fading_um=0.0,
    )  # fmt: skip
    levels = SimpleNamespace(jumps=())
    cleansing = SimpleNamespace(
        least=0.3, full=0.9, window_s=60.0, jumped_k=None, counted_degc=lambda *_: None, levels=levels
    )
    positions = SimpleNamespace(trust=lambda *_: (1.0, ""), behind=lambda *_: None)
    answer = SimpleNamespace(confidence=1.0, imputed_um=imputed_um), None
    to = SimpleNamespace(model=None, waits="", estimate=lambda *_: answer, drifted_before=lambda *_: False)
    said = _waits_for(to, estimate, estimate, cleansing, positions, SimpleNamespace(time=time), None)
    assert ("more than 1 um off" in said) is waits and bool(said) is waits


def test_a_sentence_about_missing_sensors_says_how_many_more_there_are():
    missing = SimpleNamespace(speed_unread_um=0.0, imputed_um=11.0, imputed=(1, 2, 3, 4, 5))
    said = _unsure(missing, None, np.zeros(5), np.zeros(5), (1, 2, 3, 4, 5))
    assert "in place of sensor 1, sensor 2, sensor 3 and 2 more may be 11.0 um off" in said


async def test_what_a_sensor_was_imputed_with_holds_after_a_restart_when_it_has_returned(task):
    await task.minutes(2, spindle=[np.nan, 20.0, 20.0])
    await task.ask()
    await task.minutes(5, spindle=[np.nan, 20.1, 24.0])
    await task.minutes(5, spindle=[26.0, 20.1, 24.0])
    assert task.estimates[-1].imputed == () and "one that is back may be" in task.estimates[-1].inhibit
    await task.history.flushed()
    counted = next(item.reference for item in reversed(task.delivered) if isinstance(item, ReferenceRebased))
    again = task.restarted(model())
    try:
        await again.task.recall()
        await again.task._take(ReferenceTakenUp(reference=counted, sensors=task.sensors))
        await again.minutes(3, spindle=[26.0, 20.1, 24.0])
        assert again.estimates[-1].imputed == () and "one that is back may be" in again.estimates[-1].inhibit
    finally:
        again.history.close()


async def test_a_line_that_answers_from_memory_holds_the_output_and_sets_no_reference(task):
    """Numbers that stand move nothing, while the machine goes on: 8 K at 3 um/K would be 24 um in silence."""
    noise = np.random.default_rng(5)

    async def heard(minutes):
        for _ in range(round(minutes * 6)):
            await task.minutes(1 / 6, *(np.round(20.0 + noise.normal(0.0, 0.03, n), 2) for n in (3, 2)))

    await heard(31)
    await task.ask()
    await heard(1)
    assert task.estimates[-1].confidence == 1.0
    await task.minutes(4.5, spindle=[20.01, 20.0, 20.02])
    assert task.estimates[-1].confidence == 1.0, "a few readings alike prove nothing"
    await task.minutes(1, spindle=[20.01, 20.0, 20.02])
    assert task.estimates[-1].confidence == 0.0
    assert "spindle has sent the very same numbers for 5 min" in task.estimates[-1].inhibit
    await task.ask("r2")
    refused = [item for item in task.delivered if isinstance(item, ReferenceRefused)]
    assert len(task.references) == 1 and "the very same numbers" in refused[-1].why
    await heard(1)
    assert task.estimates[-1].confidence == 1.0


@pytest.mark.parametrize("stood_min", [6.0, 2.0], ids=["found before", "begun before"])
async def test_that_a_line_answers_from_memory_outlives_a_restart(task, stood_min):
    """Who restarts the daemon because the output holds would have it follow what stands."""
    noise = np.random.default_rng(5)

    async def heard(of, minutes):
        for _ in range(round(minutes * 6)):
            await of.minutes(1 / 6, *(np.round(20.0 + noise.normal(0.0, 0.03, n), 2) for n in (3, 2)))

    await heard(task, 41)
    await task.ask()
    await task.minutes(stood_min, spindle=[20.01, 20.0, 20.02])
    await task.history.flushed()
    again = task.restarted(model())
    try:
        await again.task.recall()
        await again.task._take(task.taken_up(task.references[-1]))
        await again.minutes(6, spindle=[20.01, 20.0, 20.02])
        assert "spindle has sent the very same numbers" in again.estimates[-1].inhibit
        await heard(again, 2)
        assert again.estimates[-1].confidence == 1.0 and again.estimates[-1].inhibit == ""
    finally:
        again.history.close()


async def comes_back_seven_kelvin_warmer(task: Task, *, away_s: float) -> None:
    """After an outage a sensor reads 7 K more, which is doubted or moves nothing."""
    task.clock.monotonic_s += away_s
    again = task.restarted(model())
    await again.task.recall()
    await again.task._take(task.taken_up(task.references[0]))
    await again.minutes(4, spindle=[27.0, 20.0, 20.0])
    estimate = again.estimates[-1]
    assert estimate.confidence == 0.0 or estimate.thermal_error_um == pytest.approx([0.0], abs=1.0)
    again.history.close()


async def test_after_an_outage_as_long_as_is_taken_up_a_sensor_at_another_level_does_not_count_as_before(tmp_path):
    """A sensor that was exchanged meanwhile: believed as it came, 7 K at 2 um/K were 14 um with confidence 1."""
    of_rig = machine(tmp_path)
    reference = of_rig.compensation.reference.model_copy(update={"max_outage_s": 3600.0})
    compensation = of_rig.compensation.model_copy(update={"reference": reference})
    task = Task(tmp_path, model(), configuration=of_rig.model_copy(update={"compensation": compensation}))
    task.history.start()
    await task.minutes(5)
    await task.ask()
    await task.minutes(1)
    await comes_back_seven_kelvin_warmer(task, away_s=3000.0)


async def test_a_sensor_that_was_read_earlier_than_others_before_an_outage_is_held_against_its_past_too(tmp_path):
    """Ten minutes were looked through, no more once any sensor was found: 7 K of this one were 14 um, believed."""
    task = Task(tmp_path, model())
    task.history.start()
    await task.minutes(5)
    await task.ask()
    await task.minutes(1)
    task.clock.monotonic_s += 10.0
    await task.cycle("column", 20.0)
    await comes_back_seven_kelvin_warmer(task, away_s=595.0)
