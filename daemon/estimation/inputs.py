"""What the thermal task takes beside temperatures, and the snapshot of it that others read."""

from collections.abc import Collection, Mapping
from types import MappingProxyType
from typing import TYPE_CHECKING

from daemon.messages import SpindleSpeed
from daemon.snapshots import ThermalSnapshot
from drivers.contract import Capability, Cnc
from models.records import CncSample, FloatArray
from models.thermal.family import ThermalModel

if TYPE_CHECKING:
    from daemon.estimation.task import ThermalTask


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


def thermal_snapshot(thermal: "ThermalTask") -> ThermalSnapshot:
    """Return what has arrived and what is estimated now."""
    online, following = thermal._online, thermal._next
    waits = f"{following.model.model_id} makes no estimates yet: {following.waits}" if following is not None else ""
    return ThermalSnapshot(
        temperatures=thermal.latest,
        estimate=thermal.latest_estimate,
        line_faults=MappingProxyType(dict(thermal.line_faults)),
        cycles_received=thermal.cycles_received,
        cycles_incomplete=thermal.cycles_incomplete,
        estimates=thermal.estimates,
        model_waits=waits,
        contributions=online.contributions() if online is not None and thermal.latest_estimate is not None else None,
    )
