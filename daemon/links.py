"""Keeps every link open: temperature lines, CNC, displacement files, local socket, metrics."""

from collections.abc import Awaitable, Callable, Coroutine, Iterator
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import structlog

from config.schema import Configuration
from config.schema.source_drivers import SourceEntry
from config.schema.temperatures import TemperatureInput
from daemon.cnc.session import CncLink
from daemon.rate_limit import RateLimit
from daemon.registry import Parts
from daemon.snapshots import DisplacementSnapshot, LinkSnapshot
from daemon.supervisor import Backoff, LinkHealth, run_with_reconnect
from drivers.clock import Clock
from drivers.contract import LinkError
from drivers.registry import DisplacementInput
from models.quality import Reason
from models.records import DisplacementSample, TemperatureCycle

log = structlog.get_logger(__name__)

PROBLEM_BURST = 3
"""So many problems of displacement files are reported one by one; then the latest once a minute, with their number."""

Serve = Callable[[Callable[[], None]], Awaitable[None]]
"""Serves until cancelled; calls what it gets when it can be connected to."""


class Links:
    """Opens each link anew when it is lost, and keeps the state of each."""

    def __init__(
        self, configuration: Configuration, clock: Clock, parts: Parts, cnc: CncLink, on_change: Callable[[], None]
    ) -> None:
        self._configuration = configuration
        self._clock = clock
        self._parts = parts
        self._cnc = cnc
        self._lines = {
            each.name: LinkHealth(f"{each.driver} {each.name}") for each in configuration.temperatures.inputs
        }
        displacements = configuration.displacements
        self._displacements = [] if displacements is None else [(each, _health(each)) for each in displacements.inputs]
        self.planner_health = LinkHealth("speed planner")
        self._own = {
            "service.socket": LinkHealth("local socket"),
            "service.http_port": LinkHealth("metrics"),
            "opcua_server": LinkHealth("OPC UA server"),
            "shdr": LinkHealth("SHDR adapter"),
        }
        sinks = {name: LinkHealth(name) for name in (f"sink {sink.name}" for sink in configuration.sinks or ())}
        self._own |= sinks
        self.shown = [*self._lines.values(), cnc.health]
        """Those to the machine, to the sinks, and to the process that plans for it."""
        self.shown += [health for _, health in self._displacements]
        self.shown += sinks.values()
        if configuration.spindle_speed is not None:
            self.shown.append(self.planner_health)
        for health in self.shown:
            health.on_change = on_change

    def snapshots(self) -> tuple[LinkSnapshot, ...]:
        return tuple(health.snapshot() for health in self.shown)

    def temperatures(self, take: Callable[[TemperatureCycle], Awaitable[None]]) -> Iterator[Coroutine[Any, Any, None]]:
        """Yield the work that keeps each line and source open; `take` may wait, a line then drops what does not fit."""
        for each in self._configuration.temperatures.inputs:
            yield self._input(each, take)

    def cnc(self) -> Coroutine[Any, Any, None]:
        """Return the work that keeps the session with the CNC open."""
        return self._keep(self._cnc.health, self._cnc.attempt)

    def planner(self, attempt: Callable[[], Awaitable[None]]) -> Coroutine[Any, Any, None]:
        """Return the work that keeps the process running that plans the spindle speed."""
        return self._keep(self.planner_health, attempt)

    def displacements(self, after_utc_s: Callable[[], float | None], log_: "DisplacementLog") -> Iterator[Any]:
        """Yield the work that follows each source of displacements; of files, rows up to `after_utc_s` are skipped."""

        async def attempt(each: DisplacementInput, came_up: Callable[[], None]) -> None:
            source = self._parts.open_displacement_source(self._configuration, each, self._clock, after_utc_s())
            try:
                async for sample in source.samples(log_.problem, came_up):
                    log_.row(sample)
            finally:
                await source.close()

        for each, health in self._displacements:
            facts = _exposed(each)
            yield self._keep(health, partial(attempt, each, partial(health.came_up, **facts)))

    def own(self, key: str, place: object, serve: Serve) -> Coroutine[Any, Any, None]:
        """Return the work that serves people or programs at a configured place."""
        health = self._own[key]

        async def attempt() -> None:
            try:
                await serve(health.came_up)
            except (OSError, KeyError) as error:
                raise LinkError(f"{key} {place} cannot be served: {error}") from error

        return self._keep(health, attempt)

    def _input(
        self, each: TemperatureInput, take: Callable[[TemperatureCycle], Awaitable[None]]
    ) -> Coroutine[Any, Any, None]:
        health = self._lines[each.name]
        facts = _exposed(each)

        async def attempt() -> None:
            source = self._parts.open_temperature_source(self._configuration, each, self._clock)
            try:
                async for cycle in source.cycles():
                    health.came_up(**facts)
                    await take(cycle)
            finally:
                await source.close()

        return self._keep(health, attempt)

    def _keep(self, health: LinkHealth, attempt: Callable[[], Awaitable[None]]) -> Coroutine[Any, Any, None]:
        service = self._configuration.service
        backoff = Backoff(service.retry_min_s, service.retry_max_s)
        return run_with_reconnect(health, attempt, backoff, utc_s=lambda: self._clock.now().utc_s)


def _health(each: DisplacementInput) -> LinkHealth:
    return LinkHealth(f"{each.driver} {each.name}" if isinstance(each, SourceEntry) else each.name)


def _exposed(each: TemperatureInput | DisplacementInput) -> dict[str, str]:
    """Return what is said of a link that others can read or change."""
    exposed = each.connection.exposed if isinstance(each, SourceEntry) else ""
    return {"security": exposed} if exposed else {}


class DisplacementLog:
    """Passes rows of displacements on, and reports to log, audit and status what could not be read."""

    def __init__(
        self,
        clock: Clock,
        take: Callable[[DisplacementSample], None],
        report: Callable[[str, str], None],
        publish: Callable[[DisplacementSnapshot], None],
    ) -> None:
        """`report` takes the kind of an event and its text."""
        self._clock = clock
        self._take = take
        self._report = report
        self._publish = publish
        self._snapshot = DisplacementSnapshot()
        self._limit = RateLimit[str](self._tell, burst=PROBLEM_BURST)

    def row(self, sample: DisplacementSample) -> None:
        self._take(sample)
        before = self._snapshot.latest
        if before is not None and (other := sample.reason == Reason.ELSEWHERE).any():
            latest = replace(
                sample,
                um=np.where(other, before.um, sample.um),
                reason=np.where(other, before.reason, sample.reason).astype(np.uint8),
            )
        else:
            latest = sample
        self._change(replace(self._snapshot, latest=latest, rows_read=self._snapshot.rows_read + 1))

    def problem(self, problem: str) -> None:
        now_utc_s, before = self._clock.now().utc_s, self._snapshot
        self._change(replace(before, problems=before.problems + 1, last_problem=problem, last_problem_utc_s=now_utc_s))
        self._limit(problem)

    def flush(self) -> None:
        """Report what is still held back; call it when nothing more comes."""
        self._limit.flush()

    def _change(self, snapshot: DisplacementSnapshot) -> None:
        self._snapshot = snapshot
        self._publish(snapshot)

    def _tell(self, problem: str, left_out: int) -> None:
        """Say one problem, how many before it were left out, and whether any row was ever read."""
        words = problem if not left_out else f"{problem} ({left_out} more since the last report)"
        if not self._snapshot.rows_read:
            words += "; no row has been read since the daemon started: check `displacements` in the configuration"
        log.warning("displacements.unreadable", problem=words, problems=self._snapshot.problems)
        self._report("displacements", words)
