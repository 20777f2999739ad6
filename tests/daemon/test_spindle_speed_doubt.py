"""The speed follows no temperature that the compensation doubts: it is frozen, and says which sensor and why."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from control_rig import running
from speed_machine import bearing_model
from speed_rig import CUT, SAFE, SpeedRig
from thermal_rig import Task, model

from config.schema.service import HistoryConfig
from daemon.messages import TemperaturesTrusted
from daemon.state_store.store import StateStore
from drivers.guard.speed_text import SpeedStatus
from models.control.reference_records import ReferenceDocument, ReferenceRecord, ReferenceState
from models.records import MachineTemperatures
from models.thermomechanics.regression import FittedRange


class Sensors:
    """A thermal task on the clock of a bench, whose temperatures reach its control task."""

    def __init__(self, bench: SpeedRig, folder: Path) -> None:
        self.bench = bench
        changes = {"history": HistoryConfig(path=folder / "thermal.sqlite")}
        self.thermal = Task(folder, model(), bench.clock, bench.configuration.model_copy(update=changes))
        self.thermal.history.start()
        self.sent: list[MachineTemperatures] = []

    def told(self) -> None:
        """Hand on what the task has delivered since."""
        self.sent += [item for item in self.thermal.delivered if isinstance(item, MachineTemperatures)]
        if self.sent:
            self.bench.rig.control.deliver(self.sent[-1])

    async def speak(self, seconds: float, block: int, spindle: Any = 28.0, column: Any = 28.0) -> None:
        """Let time pass in a block of the part program while both lines speak every ten seconds; None: silent."""
        for _ in range(round(seconds)):
            if round(self.bench.clock.monotonic_s) % 10 == 0:
                self.thermal.delivered.clear()
                for line, degc in (("spindle", spindle), ("column", column)):
                    if degc is not None:
                        await self.thermal.cycle(line, degc)
                self.told()
            await self.bench.pass_by(1.0, block, temperatures=False)

    async def operation(self) -> float:
        """Begin an operation, let it be tuned, and cut with it; return its speed."""
        await self.speak(70.0, SAFE)
        await self.thermal.ask()
        self.bench.call()
        await self.speak(20.0, SAFE)
        speed_rpm, _, status = self.bench.call()
        assert status is SpeedStatus.APPLIED and self.bench.picture()["alarm"] == ""
        await self.speak(10.0, CUT)
        return speed_rpm

    async def positioned(self) -> None:
        """Position the work again, with a new reference."""
        self.thermal.delivered.clear()
        await self.thermal.ask("r2")


@pytest.fixture
async def sensors(tmp_path: Path) -> Any:
    bench = SpeedRig(tmp_path)
    async with running(bench.rig):
        await bench.rig.turn()
        sensors = Sensors(bench, tmp_path)
        yield sensors
        sensors.thermal.history.close()


async def frozen(
    sensors: Sensors, speed_rpm: float, why: str, spindle: Any = 28.0, column: Any = 28.0, grows: float = 1.0
) -> None:
    """However warm the machine gets: the speed stays, the target is none, and the alarm says why."""
    for rise_k in 0.2 * np.arange(1, 11):
        await sensors.speak(20.0, SAFE, spindle=spindle + rise_k, column=column + grows * rise_k)
    assert why in sensors.bench.picture()["alarm"]
    assert "the speed is frozen" in sensors.bench.picture()["reason"]
    assert sensors.bench.picture()["target_rpm"] is None
    assert sensors.bench.call()[0] == speed_rpm


async def test_a_sensor_at_a_level_that_is_doubted_moves_no_speed(sensors: Sensors) -> None:
    speed_rpm = await sensors.operation()
    await sensors.speak(40.0, CUT, spindle=[30.5, 28.0, 28.0])
    await frozen(sensors, speed_rpm, "sensor 1 is at a level that is doubted", np.array([30.5, 28.0, 28.0]))
    assert np.isnan(sensors.sent[-1].believed_degc).tolist() == [True, False, False, False, False]


async def test_nor_does_it_from_a_new_reference_on_until_a_person_trusts_it(sensors: Sensors) -> None:
    """What is counted from the reference is right, whatever the sensor says; its temperature is not."""
    speed_rpm = await sensors.operation()
    await sensors.speak(110.0, CUT, spindle=[30.5, 28.0, 28.0])
    await sensors.positioned()
    assert sensors.thermal.task._reference.reference_id == "r2"
    await frozen(sensors, speed_rpm, "sensor 1 is at a level that is doubted", np.array([30.5, 28.0, 28.0]))
    await sensors.thermal.history.flushed()
    sensors.thermal = sensors.thermal.restarted(model())
    await sensors.speak(60.0, SAFE, spindle=[32.5, 30.0, 30.0], column=30.0)
    assert "sensor 1 is at a level that is doubted" in sensors.bench.picture()["alarm"], "over a restart neither"
    await sensors.thermal.task._take(TemperaturesTrusted(person="a person"))
    await sensors.speak(60.0, SAFE, spindle=[32.5, 30.0, 30.0], column=30.0)
    assert sensors.bench.picture()["alarm"] == "" and sensors.bench.picture()["target_rpm"] != speed_rpm


async def test_it_counts_when_it_jumps_back_after_the_reference(sensors: Sensors) -> None:
    await sensors.operation()
    await sensors.speak(110.0, CUT, spindle=[30.5, 28.0, 28.0])
    await sensors.positioned()
    assert sensors.thermal.task._reference.reference_id == "r2"
    await sensors.speak(20.0, SAFE, spindle=[30.5, 28.0, 28.0])
    assert sensors.sent[-1].doubted == {0: "sensor 1 is at a level that is doubted"}
    await sensors.speak(40.0, SAFE)
    assert sensors.sent[-1].doubted == {} and sensors.bench.picture()["alarm"] == ""


async def test_a_sensor_that_the_watch_has_excluded_moves_no_speed(sensors: Sensors) -> None:
    speed_rpm = await sensors.operation()
    found = replace(sensors.thermal.sensors, excluded={3: "departure"})
    taken_up = replace(sensors.thermal.taken_up(sensors.thermal.task._reference), sensors=found)
    sensors.thermal.task._reference = None  # as after a restart
    await sensors.thermal.task._take(taken_up)
    await frozen(sensors, speed_rpm, "sensor 3 was found wrong")
    await sensors.positioned()
    await frozen(sensors, speed_rpm, "sensor 3 was found wrong", 30.0, 30.0)
    await sensors.thermal.task._take(TemperaturesTrusted(person="a person"))
    await sensors.speak(60.0, SAFE, spindle=32.0, column=32.0)
    assert sensors.bench.picture()["alarm"] == ""


async def test_a_line_that_answers_from_memory_moves_no_speed(sensors: Sensors) -> None:
    for number in range(200):
        await sensors.thermal.minutes(1 / 6, spindle=28.0 + 0.0625 * (number % 2), column=28.0 + 0.0625 * (number % 2))
    speed_rpm = await sensors.operation()
    for number in range(40):
        await sensors.speak(10.0, CUT, spindle=28.0 + 0.0625 * (number % 2))
    await frozen(sensors, speed_rpm, "sensor 11 may be answered from memory", grows=0.0)


async def test_a_sensor_that_came_back_at_another_level_counts_without_it(sensors: Sensors) -> None:
    speed_rpm = await sensors.operation()
    await sensors.speak(180.0, CUT, spindle=[np.nan, 28.0, 28.0])
    await sensors.speak(180.0, CUT, spindle=[35.0, 28.0, 28.0])
    await sensors.positioned()
    await sensors.speak(60.0, SAFE, spindle=[35.0, 28.0, 28.0])
    assert sensors.sent[-1].believed_degc == pytest.approx(np.full(5, 28.0))
    assert sensors.bench.picture()["alarm"] == "" and sensors.bench.call()[0] == speed_rpm


async def test_a_line_that_has_not_spoken_since_the_start_moves_no_speed(sensors: Sensors) -> None:
    """The mean of the other one's sensors is at another level."""
    bench = sensors.bench
    await sensors.speak(30.0, SAFE, spindle=36.0, column=None)
    bench.call()
    await sensors.speak(20.0, SAFE, spindle=36.0, column=None)
    assert "2 of 5 sensors of A have had no value since the start" in bench.picture()["alarm"]
    assert bench.call()[0] == 9000.0 and bench.picture()["target_rpm"] is None
    await sensors.speak(50.0, SAFE, spindle=36.0, column=20.0)
    assert bench.picture()["alarm"] == "" and bench.call()[2] is SpeedStatus.APPLIED


async def test_what_was_excluded_before_a_restart_is_not_believed_before_the_reference_is_taken_up(
    sensors: Sensors,
) -> None:
    """The control task takes the reference up when it has reached the CNC, and speeds are planned by then."""
    await sensors.operation()
    thermal = sensors.thermal
    found = replace(thermal.sensors, excluded={3: "departure"})
    record = ReferenceRecord(reference=thermal.task._reference, sensors=found)
    StateStore(thermal.history, thermal.clock).put(ReferenceDocument(state=ReferenceState.VALID, record=record))
    await thermal.history.flushed()
    sensors.thermal = again = thermal.restarted(model())
    for spindle in (28.0, 28.0, 28.0, 28.0):
        again.delivered.clear()
        await again.minutes(1 / 6, spindle=spindle, column=28.0)
        sensors.told()
    assert sensors.sent[-1].doubted == {2: "sensor 3 was found wrong"}
    assert np.isnan(sensors.sent[-1].believed_degc).tolist() == [False, False, True, False, False]
    again.delivered.clear()
    await again.ask("r2")
    await again.minutes(1 / 6, spindle=28.0, column=28.0)
    sensors.told()
    assert sensors.sent[-1].doubted == {2: "sensor 3 was found wrong"}


async def test_temperatures_beside_those_of_the_fit_move_no_speed(tmp_path: Path) -> None:
    """The bearings of a spindle at 34 degC were taken from a line through what was measured at 24 to 29."""
    fitted = FittedRange(lowest_degc=np.array([24.0]), highest_degc=np.array([29.0]))
    made = bearing_model()
    made = replace(made, axes={axis: replace(each, fitted_range=fitted) for axis, each in made.axes.items()})
    bench = SpeedRig(tmp_path, model=made)
    async with running(bench.rig):
        await bench.rig.turn()
        within_rpm, _, status = await bench.operation()
        assert status is SpeedStatus.APPLIED and within_rpm != 9000.0 and bench.picture()["alarm"] == ""
        await bench.pass_by(20.0, CUT)
        bench.degc = 34.0
        await bench.pass_by(120.0, CUT)
        await bench.pass_by(60.0, SAFE)
        assert bench.call()[0] == within_rpm
        assert "A 34.0 degC (fitted 24.0 to 29.0)" in bench.picture()["alarm"]
        bench.degc = 28.0
        await bench.pass_by(70.0, SAFE)
        assert bench.picture()["alarm"] == ""
