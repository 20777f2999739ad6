"""The snapshot of the thermal task."""

from types import MappingProxyType
from typing import TYPE_CHECKING

from daemon.snapshots import ThermalSnapshot

if TYPE_CHECKING:
    from daemon.estimation.task import ThermalTask


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
