"""Keeps the process that plans the spindle speed and its plan; while it is lost, the commanded speed is frozen."""

import asyncio
import math
import signal
from collections import deque
from collections.abc import Callable, Coroutine, Mapping, Sequence
from dataclasses import replace

from pydantic import ValidationError

from config.schema import Configuration
from daemon.spindle_speed.messages import (
    REPLY,
    CalledOperation,
    OpenedModel,
    PlannedSpeed,
    Planner,
    PlanRequest,
    Reply,
    to_line,
)
from drivers.contract import LinkError
from models.records import FloatArray

ANSWER_WITHIN_S = 60.0
"""A process that has not answered by then hangs [s of the wall clock]; the longest plans take some seconds."""
LONGEST_ANSWER = 1 << 20
"""Bytes; what is longer is no answer."""
STARTING = "the process that plans the spindle speed is being started; the speed is frozen until then"
Overdue = Callable[[], Coroutine[None, None, object]]
"""Returns when an answer is overdue."""


async def _answer_time() -> None:
    await asyncio.sleep(ANSWER_WITHIN_S)


class PlannerProcess:
    """The planner of the spindle speed in a process of its own, which `attempt` runs until it is lost."""

    def __init__(
        self,
        command: Sequence[str],
        configuration: Configuration,
        on_opened: Callable[[OpenedModel], object],
        overdue: Overdue = _answer_time,
    ) -> None:
        self._command, self._configuration = command, configuration
        self._on_opened, self._overdue = on_opened, overdue
        self._asked: asyncio.Queue[tuple[PlanRequest, asyncio.Future[PlannedSpeed | None]]] = asyncio.Queue()
        self._lost, self._told = STARTING, ""
        self.opened: OpenedModel | None = None
        self.process_id: int | None = None
        """Of the process that runs; None while there is none."""

    @property
    def inhibit(self) -> str:
        """Why no speed can be planned now, '' when it can."""
        if self._lost:
            return self._lost
        return self.opened.inhibit if self.opened is not None else STARTING

    async def plan(self, request: PlanRequest) -> PlannedSpeed | None:
        """Return the plan; raises LinkError when the process is lost before it has answered."""
        if inhibit := self.inhibit:
            raise LinkError(inhibit)
        answer: asyncio.Future[PlannedSpeed | None] = asyncio.get_running_loop().create_future()
        self._asked.put_nowait((request, answer))
        return await answer

    async def attempt(self) -> None:
        """Run one process until it is lost, and raise LinkError then; where it has no model, wait for the end."""
        try:
            process = await asyncio.create_subprocess_exec(
                *self._command, stdin=asyncio.subprocess.PIPE, stdout=asyncio.subprocess.PIPE, limit=LONGEST_ANSWER
            )
        except OSError as error:
            raise self._gone(f"cannot be started ({error.strerror})") from error
        try:
            self.process_id = process.pid
            await self._serve(process)
        except Exception as error:
            if not isinstance(error, LinkError):
                self._gone(f"cannot be served any longer (unexpected {type(error).__name__}: {error})")
            raise
        finally:
            self.process_id = None
            if process.returncode is None:
                process.kill()
            await process.wait()

    async def _serve(self, process: asyncio.subprocess.Process) -> None:
        ended = asyncio.create_task(process.wait())
        try:
            reply = await self._answer(process, ended, self._configuration.model_dump_json().encode() + b"\n")
            if reply.opened is None:
                raise self._gone("has not said what it opened")
            self.opened, self._lost = (opened := reply.opened), ""
            self._on_opened(replace(opened, words="") if opened.words == self._told else opened)
            self._told = opened.words
            if reply.opened.inhibit:
                process.kill()
                await asyncio.Event().wait()
            while True:
                await self._next(process, ended)
        finally:
            ended.cancel()

    async def _next(self, process: asyncio.subprocess.Process, ended: asyncio.Task[int]) -> None:
        """Wait for a request or the end of the process, and answer the request."""
        asked = asyncio.create_task(self._asked.get())
        try:
            await asyncio.wait([asked, ended], return_when=asyncio.FIRST_COMPLETED)
            if not asked.done():
                raise self._gone(_how_it_ended(ended.result()))
        finally:
            asked.cancel()
        request, answer = asked.result()
        try:
            reply = await self._answer(process, ended, to_line(request))
            if not _answers(request, reply.planned):
                raise self._gone("has answered something else than it was asked")
            if not answer.done():
                answer.set_result(reply.planned)
        finally:
            if not answer.done():
                answer.set_exception(LinkError(self._lost or STARTING))
                answer.exception()  # the caller may have gone

    async def _answer(self, process: asyncio.subprocess.Process, ended: asyncio.Task[int], line: bytes) -> Reply:
        """Return the answer to a line; raises LinkError where none comes."""
        assert process.stdin is not None
        assert process.stdout is not None
        overdue = asyncio.create_task(self._overdue())
        reading = asyncio.create_task(process.stdout.readline())
        try:
            process.stdin.write(line)
            await asyncio.wait([reading, overdue], return_when=asyncio.FIRST_COMPLETED)
            if not reading.done():
                raise self._gone("has not answered in time and is killed")
            text = reading.result()
            if not text.endswith(b"\n"):
                raise self._gone(_how_it_ended(await ended))
            reply = REPLY.validate_json(text)
        except (ValidationError, ValueError) as error:
            raise self._gone(f"has given an answer that cannot be read ({error})") from error
        finally:
            overdue.cancel()
            reading.cancel()
        if reply.defect:
            raise self._gone(f"has ended: {reply.defect}")
        return reply

    def _gone(self, how: str) -> LinkError:
        """Note that there is no planner now, and return what to raise."""
        self._lost = f"the process that plans the spindle speed {how}; it is started again, and the speed is frozen"
        self.opened = None
        while not self._asked.empty():
            _, answer = self._asked.get_nowait()
            if not answer.done():
                answer.set_exception(LinkError(self._lost))
                answer.exception()
        return LinkError(self._lost)


def _answers(request: PlanRequest, planned: PlannedSpeed | None) -> bool:
    """Return whether this is a plan of what was asked for, with a speed that is a number."""
    if planned is None:
        return True
    of_the_request = planned.called == request.called and planned.time_s == request.time_s
    return of_the_request and (planned.plan is None or 0.0 < planned.plan.choice.speed_rpm < math.inf)


def _how_it_ended(status: int) -> str:
    """Return how a process ended, by its status, in words."""
    if status >= 0:
        return f"has ended with status {status}"
    return f"was ended by {signal.Signals(-status).name}"


MOST_READINGS = 60
"""Readings that may wait; older ones are left out."""


class SpeedWorker:
    """Asks for one plan at a time; owned by the control task."""

    def __init__(self, planner: Planner | None) -> None:
        self._planner = planner
        self._readings: deque[tuple[float, tuple[float, ...]]] = deque(maxlen=MOST_READINGS)
        self._last_s: float | None = None
        self._doubted: Mapping[int, str] = {}
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

    def take(self, time_s: float, degc: FloatArray, doubted: Mapping[int, str]) -> None:
        """Take a reading of all sensors [degC], and why those at some places are not believed."""
        if self._planner is not None:
            self._readings.append((time_s, tuple(degc.tolist())))
            self._last_s, self._doubted = time_s, doubted

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
            request = PlanRequest(
                readings=tuple(self._readings), time_s=self._last_s, called=called, place=place, doubted=self._doubted
            )
            self._readings.clear()
            self._task = asyncio.create_task(self._planner.plan(request))
