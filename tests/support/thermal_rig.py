"""A thermal task that a test feeds by hand, on a real store."""

import asyncio
from pathlib import Path

import numpy as np
from control_rig import SENSOR_IDS, HandClock, machine

from config.schema import Configuration
from daemon.estimation.inputs import Delivery
from daemon.estimation.task import ThermalTask
from daemon.history.layout import MachineLayout
from daemon.history.writer import HistoryWriter
from daemon.messages import ReferenceRequest, ReferenceTakenUp, SensorsSinceReference
from daemon.telemetry.metrics import Telemetry
from models.quality import Quality, Reason
from models.records import Reference, TemperatureCycle, ThermalErrorEstimate, Trace
from models.thermal.family import ThermalModel
from models.thermal.training.making import increment_model

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
        "lowest_increment_k": np.full(count, -20.0),
        "highest_increment_k": np.full(count, 20.0),
        "band_um": np.full(1, np.nan),
        "training": (),
        "created": "2026-01-01T00:00:00Z",
        "test_pairs": [(np.full(count, 21.0), np.full(count, 20.0))],
    }
    return increment_model(**(content | changes))


class Task:
    """A thermal task with a real store, fed by hand."""

    def __init__(
        self,
        directory: Path,
        the_model: ThermalModel | None,
        clock: HandClock | None = None,
        configuration: Configuration | None = None,
    ) -> None:
        self.directory = directory
        self.configuration = configuration or machine(directory)
        self.clock = clock or HandClock()
        self.history = HistoryWriter(
            self.configuration.history.path,
            clock=self.clock,
            machine=MachineLayout.from_configuration(self.configuration),
        )
        self.delivered: list[Delivery] = []
        self.sensors: SensorsSinceReference | None = None
        self.numbers = dict.fromkeys(CHAINS, 0)
        self.task = ThermalTask(
            self.configuration,
            self.clock,
            self.history,
            Telemetry(),
            the_model,
            asyncio.Queue(),
            self._deliver,
        )

    def _deliver(self, item: Delivery) -> None:
        self.delivered.append(item)
        if isinstance(item, SensorsSinceReference):
            self.sensors = item

    def taken_up(self, reference: Reference) -> ReferenceTakenUp:
        """What the control task says of a reference after a restart."""
        return ReferenceTakenUp(reference=reference, sensors=self.sensors)

    def restarted(self, the_model: ThermalModel | None) -> "Task":
        """End this daemon; return the next one on the same store."""
        self.history.close()
        again = Task(self.directory, the_model, self.clock, self.configuration)
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
