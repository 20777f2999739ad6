"""Hands readings and the operation under way to the planner, and keeps its latest plan; the loop never waits for it."""

import asyncio
from collections import deque

from daemon.spindle_speed.messages import CalledOperation, PlannedSpeed, Planner, PlanRequest
from drivers.contract import LinkError
from models.records import FloatArray

MOST_READINGS = 60
"""Readings that may wait; older ones are left out."""


class SpeedWorker:
    """Asks for one plan at a time; owned by the control task."""

    def __init__(self, planner: Planner | None) -> None:
        self._planner = planner
        self._readings: deque[tuple[float, tuple[float, ...]]] = deque(maxlen=MOST_READINGS)
        self._last_s: float | None = None
        self._task: asyncio.Task[PlannedSpeed | None] | None = None
        self._latest: PlannedSpeed | None = None

    @property
    def inhibit(self) -> str:
        """Why no speed can be planned now, '' when it can."""
        return "" if self._planner is None else self._planner.inhibit

    @property
    def latest(self) -> PlannedSpeed | None:
        """The latest plan; none of a planner that has been lost since."""
        return None if self.inhibit else self._latest

    def take(self, time_s: float, degc: FloatArray) -> None:
        """Take a reading of all sensors [degC]."""
        if self._planner is not None:
            self._readings.append((time_s, tuple(degc.tolist())))
            self._last_s = time_s

    def update(self, called: CalledOperation | None, place: int | None) -> None:
        """Take over a plan that is ready, and ask for the next where readings wait; returns at once."""
        if self._task is not None:
            if not self._task.done():
                return
            task, self._task = self._task, None
            try:
                self._latest = task.result() or self._latest
            except LinkError:
                self._latest = None
        if self._planner is None or self._planner.inhibit:
            self._latest = None
            return
        unplanned = called is not None and place is not None and (self._latest is None or self._latest.called != called)
        if self._last_s is not None and (self._readings or unplanned):
            request = PlanRequest(readings=tuple(self._readings), time_s=self._last_s, called=called, place=place)
            self._readings.clear()
            self._task = asyncio.create_task(self._planner.plan(request))

    async def settled(self) -> None:
        """Wait for what is being computed."""
        if self._task is not None:
            await asyncio.wait([self._task])
