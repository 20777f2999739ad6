"""The thermal task: cycles in, cleansed temperatures, references and estimates out."""

import asyncio
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import structlog

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "support"))

from control_rig import SENSOR_IDS, HandClock, machine

from config.machines import shipped_file
from daemon.history import HistoryReader
from daemon.history.layout import MachineLayout
from daemon.history.writer import HistoryWriter
from daemon.release.loading import load_released
from daemon.release.reach import own_account
from daemon.telemetry import Telemetry
from daemon.thermal import ReferenceEnded, ReferenceRebased, ReferenceRefused, ReferenceRequest, ThermalTask
from models.quality import Quality, Reason
from models.records import Reference, TemperatureCycle, ThermalErrorEstimate, Trace
from models.thermal.model import TestVector, ThermalModel

PERIOD_S = 10.0
CHAINS = {"spindle": (1, 2, 3), "column": (11, 12)}


def model(**changes):
    """Z1 = 2 um/K of sensor 1, plus 1 um/K of sensor 11."""
    count = len(SENSOR_IDS)
    coefficients = np.zeros((1, count))
    coefficients[0, 0], coefficients[0, 3] = 2.0, 1.0
    content = {
        "model_id": "made-up",
        "kind": "increments",
        "channels": ("Z1",),
        "sensor_ids": SENSOR_IDS,
        "sensor_names": tuple(f"t{i}" for i in SENSOR_IDS),
        "coefficients_um_per_k": coefficients,
        "drift_um_per_min": np.zeros(1),
        "interval_min": 1.0,
        "ridge_k2": 0.0,
        "lowest_increment_k": np.full(count, -20.0),
        "highest_increment_k": np.full(count, 20.0),
        "band_um": np.full(1, np.nan),
        "training": (),
        "created": "2026-01-01T00:00:00Z",
        "test_vectors": (
            TestVector(
                degc=np.full(count, 21.0),
                reference_degc=np.full(count, 20.0),
                elapsed_min=1.0,
                thermal_error_um=np.array([3.0]),
            ),
        ),
    }
    return ThermalModel(**(content | changes))


class Task:
    """A thermal task with a real store, fed by hand."""

    def __init__(self, directory: Path, the_model: ThermalModel | None, clock: HandClock | None = None) -> None:
        self.directory = directory
        self.configuration = machine(directory)
        self.clock = clock or HandClock()
        self.history = HistoryWriter(
            self.configuration.history.path,
            clock=self.clock,
            machine=MachineLayout.from_configuration(self.configuration),
        )
        self.delivered: list[ThermalErrorEstimate | Reference | ReferenceRefused] = []
        self.numbers = dict.fromkeys(CHAINS, 0)
        self.task = ThermalTask(
            self.configuration,
            self.clock,
            self.history,
            Telemetry(),
            the_model,
            asyncio.Queue(),
            self.delivered.append,
        )

    def restarted(self, the_model: ThermalModel | None) -> "Task":
        """End this daemon; return the next one on the same store."""
        self.history.close()
        again = Task(self.directory, the_model, self.clock)
        again.history.start()
        return again

    async def cycle(self, line: str, degc: object, *, quality: object = None, complete: bool = True) -> None:
        """Take one cycle of a line that completes now."""
        self.numbers[line] += 1
        now = self.clock.now()
        values = np.broadcast_to(np.asarray(degc, dtype=float), len(CHAINS[line])).copy()
        missing = np.isnan(values)
        await self.task._take(
            TemperatureCycle(
                line=line,
                number=self.numbers[line],
                degc=values,
                quality=np.where(missing, Quality.MISSING, Quality.GOOD).astype(np.uint8),
                reason=np.where(missing, Reason.NOT_RECEIVED, Reason.NONE).astype(np.uint8),
                complete=complete,
                trace=Trace(first_byte=now, last_byte=now),
            )
        )

    async def minutes(self, count: float, spindle: object = 20.0, column: object = 20.0) -> None:
        """Let both lines speak every ten seconds; None: a line is silent."""
        for _ in range(round(count * 60.0 / PERIOD_S)):
            self.clock.monotonic_s += PERIOD_S
            if spindle is not None:
                await self.cycle("spindle", spindle)
            if column is not None:
                await self.cycle("column", column)

    async def ask(self, reference_id: str = "r1") -> None:
        await self.task._take(
            ReferenceRequest(
                reference_id=reference_id, source="O1000 N100", program=1000, work_offset=54, power_on_count=7
            )
        )

    @property
    def estimates(self) -> list[ThermalErrorEstimate]:
        return [item for item in self.delivered if isinstance(item, ThermalErrorEstimate)]

    @property
    def references(self) -> list[Reference]:
        return [item for item in self.delivered if isinstance(item, Reference)]


@pytest.fixture
def task(tmp_path):
    task = Task(tmp_path, model())
    task.history.start()
    yield task
    task.history.close()


async def test_a_reference_before_any_temperature_is_refused_in_words(task):
    with structlog.testing.capture_logs() as logs:
        await task.ask()
    assert [item for item in task.delivered if isinstance(item, ReferenceRefused) and "no temperature" in item.why]
    assert not [entry for entry in logs if entry["event"] == "thermal.defect"]


async def test_a_reference_while_every_line_is_silent_is_refused(task):
    await task.minutes(2)
    task.clock.monotonic_s += 120.0
    await task.ask()
    assert task.references == []
    assert any("no temperature" in item.why for item in task.delivered if isinstance(item, ReferenceRefused))


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
    await task.task._take(reference)
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
    assert task.task.usable == 3
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
    assert task.task.usable == 0
    assert len(task.estimates) - before <= 2 * 6 * 2.5, "and with nothing left there is no estimate"


async def test_an_impossible_value_is_held_back(task):
    await task.minutes(2)
    await task.ask()
    await task.minutes(1 / 6, spindle=[85.0, 20.0, 20.0])
    assert task.estimates[-2].thermal_error_um == pytest.approx([0.0])
    latest = task.task.latest
    assert latest.quality[0] == Quality.HELD and latest.reason[0] == Reason.RATE
    assert latest.measured_degc[0] == 85.0, "what was measured is kept"


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


def test_a_model_for_sensors_that_do_not_exist_is_refused(tmp_path):
    configuration = machine(tmp_path)
    compensation = configuration.compensation.model_copy(
        update={
            "model_file": shipped_file("simulated_machine_model.json"),
            "allow_writable_model_directory": True,
        }
    )
    found = load_released(configuration.model_copy(update={"compensation": compensation}), own_account())
    assert found.model is None
    assert "simulated_machine_model.json" in found.obstacle
    assert "sensors that this machine does not have" in found.obstacle


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


async def test_a_sensor_that_returns_is_rebased_so_that_its_return_moves_nothing(task):
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
    rebased = next(item for item in reversed(task.delivered) if isinstance(item, ReferenceRebased)).reference
    assert rebased.reference_id == "r1" and rebased.degc[0] == pytest.approx(27.0, abs=0.01)


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
        await again.task._take(reference)
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
    vector = TestVector(
        degc=np.full(4, 21.0), reference_degc=np.full(4, 20.0), elapsed_min=1.0, thermal_error_um=np.array([1.0])
    )
    without = model(
        model_id="without 1",
        sensor_ids=SENSOR_IDS[1:],
        sensor_names=tuple(f"t{i}" for i in SENSOR_IDS[1:]),
        coefficients_um_per_k=np.array([[0.0, 0.0, 1.0, 0.0]]),
        lowest_increment_k=np.full(4, -20.0),
        highest_increment_k=np.full(4, 20.0),
        test_vectors=(vector,),
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
        await again.task._take(reference)
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
        await again.task._take(task.references[-1])
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
        await again.task._take(other)
        await again.minutes(2, spindle=22.0, column=22.0)
        assert again.estimates[-1].thermal_error_um == pytest.approx([6.0])
    finally:
        again.history.close()


async def test_the_label_of_a_tool_does_not_jump_when_a_sensor_leaves_or_returns(tmp_path):
    """Sensor 12 is in the label, and the model does not know it."""
    chosen = SENSOR_IDS[:4]
    vector = TestVector(
        degc=np.full(4, 21.0), reference_degc=np.full(4, 20.0), elapsed_min=1.0, thermal_error_um=np.array([3.0])
    )
    small = model(
        sensor_ids=chosen,
        sensor_names=tuple(f"t{i}" for i in chosen),
        coefficients_um_per_k=np.array([[2.0, 0.0, 0.0, 1.0]]),
        lowest_increment_k=np.full(4, -20.0),
        highest_increment_k=np.full(4, 20.0),
        test_vectors=(vector,),
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
        await again.task._take(kept)
        await again.minutes(4, spindle=22.0, column=[22.0, 10.0])
        assert {round(estimate.label_increment_degc["A"], 9) for estimate in again.estimates} == {3.0}
        await again.minutes(2, spindle=22.0, column=[22.0, 11.0])
        assert again.estimates[-1].label_increment_degc["A"] == pytest.approx(3.2)
    finally:
        again.history.close()
