"""What the thermal task takes, and what it gives."""

import asyncio
from collections.abc import Collection, Mapping

from daemon.messages import (
    EstimateComing,
    ReferenceEnded,
    ReferenceRebased,
    ReferenceRefused,
    ReferenceRequest,
    ReferenceTakenUp,
    SensorsSinceReference,
    SpindleSpeed,
    TemperaturesTrusted,
)
from drivers.contract import Capability, Cnc
from models.records import CncSample, FloatArray, MachineTemperatures, Reference, TemperatureCycle, ThermalErrorEstimate
from models.thermal.family import ThermalModel

MOST_WAITING = 100
"""When so many messages wait, a line's next cycle waits until some are taken."""

Message = (
    TemperatureCycle
    | SpindleSpeed
    | ReferenceRequest
    | ReferenceEnded
    | ReferenceTakenUp
    | TemperaturesTrusted
    | ThermalModel
)
Delivery = (
    ThermalErrorEstimate
    | EstimateComing
    | Reference
    | ReferenceRebased
    | ReferenceRefused
    | SensorsSinceReference
    | MachineTemperatures
)
"""What it gives."""


class ThermalInbox(asyncio.Queue[Message]):
    """What waits for the thermal task; a line that is faster than the task waits with it."""

    def __init__(self) -> None:
        super().__init__()
        self._taken = asyncio.Event()

    def _get(self) -> Message:
        self._taken.set()
        return super()._get()

    async def put_cycle(self, cycle: TemperatureCycle) -> None:
        """Queue a line's cycle when there is room."""
        while self.qsize() >= MOST_WAITING:
            self._taken.clear()
            await self._taken.wait()
        self.put_nowait(cycle)


def poll_of(sample: CncSample, cnc: Cnc | None) -> SpindleSpeed:
    """Return what the thermal task needs of a poll."""
    return SpindleSpeed(
        monotonic_s=sample.time.monotonic_s,
        rpm=sample.spindle_speed_rpm,
        positions_mm=sample.positions_mm,
        no_position="" if cnc is None else cnc.cannot.get(Capability.AXIS_POSITION, ""),
    )


class NoPositions:
    """No axis position is read."""

    names: tuple[str, ...] = ()

    def take(self, poll: SpindleSpeed) -> None:
        """Take one poll of the CNC."""

    def behind(self, degc: FloatArray, now_s: float) -> FloatArray:
        """Return the temperatures [degC], and behind them the positions in the mean [mm], NaN where not known."""
        return degc

    def at_reference(self, degc: FloatArray) -> FloatArray:
        """Return the temperatures at the reference, and behind them the positions at it."""
        return degc

    def believed(self, name: str, time_s: FloatArray, mm: FloatArray) -> FloatArray:
        """Return recorded positions of an axis without those that cannot be."""
        return mm

    def set_reference(self, now_s: float) -> dict[str, float]:
        """Count from where the axes stand now, and return that for a restart [mm]."""
        return {}

    def take_up(self, kept: Mapping[str, float]) -> None:
        """Count from where the axes stood at a reference of before."""

    def unknown(self, model: ThermalModel, now_s: float) -> str:
        """Return which position that a model needs is not known, and why, '' when all are."""
        return ""

    def trust(self, model: ThermalModel, now_s: float, imputed: Collection[int]) -> tuple[float, str]:
        """Return how far an estimate may be followed for what is known of the positions, 0..1, and why it is not."""
        return 1.0, ""
