"""The parts of the daemon that a simulation replaces: the drivers, and the process that cleans the store."""

import sys
from collections.abc import Awaitable, Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass

from config.schema import Configuration
from config.schema.cnc_drivers import CncDriverConfig
from config.schema.temperatures import TemperatureInput
from daemon.cnc.cnc_lock import CncLock
from daemon.housekeeping.jobs import Housekeeping, housekeeping_scheduler
from daemon.model_release.loading import LoadedModel
from daemon.model_release.reload import load_beside
from drivers.clock import Clock
from drivers.contract import Cnc, DisplacementSource, TemperatureSource
from drivers.registry import DisplacementInput, open_cnc, open_displacement_source, open_temperature_source
from models.thermal.family import ThermalModel

SPEED_PLANNER = (sys.executable, "-P", "-m", "daemon.speed_planner")
"""Starts the process that plans the spindle speed."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Parts:
    """The edges of the product; a simulation may put others there."""

    open_temperature_source: Callable[[Configuration, TemperatureInput, Clock], TemperatureSource] = (
        open_temperature_source
    )
    open_displacement_source: Callable[[Configuration, DisplacementInput, Clock, float | None], DisplacementSource] = (
        open_displacement_source
    )
    open_cnc: Callable[[Configuration, Clock], Cnc] = open_cnc
    hold_cnc: Callable[[CncDriverConfig], AbstractContextManager[object]] = CncLock
    """Keeps a second writer on this computer away from the CNC."""
    housekeeping: Housekeeping = housekeeping_scheduler
    load_model: Callable[[Configuration], Awaitable[LoadedModel[ThermalModel]]] = load_beside
    """Loads the released model anew, off the loop."""
    speed_planner: Sequence[str] = SPEED_PLANNER


PARTS = Parts()
