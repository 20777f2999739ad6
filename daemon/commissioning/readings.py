"""Reads the movement: from a displacement channel, an option that a person confirms, or a person at the instrument."""

import asyncio
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from config.schema import Configuration
from daemon.commissioning.dialogue import Dialogue
from daemon.commissioning.initialising import CommissioningRefusedError, UnreadError
from drivers import registry
from drivers.clock import Clock

SETTLED_LOOKS = 1.5
"""Rows that come within so many looks at the logger's file may be older than the question."""
KEPT_ROWS = 10_000


class Moment(IntEnum):
    """When the instrument is read."""

    BEFORE = 0
    AT_OFFSET = 1
    AFTER = 2


WORDS = {
    Moment.BEFORE: "at zero, before the offset",
    Moment.AT_OFFSET: "with the offset applied",
    Moment.AFTER: "back at zero",
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Reading:
    """One reading along one axis."""

    um: float
    source: str
    noise_um: float | None = None
    """Standard deviation of the samples [um], None where there was only one."""
    samples: int = 1


class DisplacementLog:
    """The displacement channels, followed while the commissioning runs."""

    def __init__(self, configuration: Configuration, clock: Clock) -> None:
        displacements = configuration.displacements
        if displacements is None:
            raise CommissioningRefusedError(
                "--channel needs displacement channels, and the configuration has no `displacements` section"
            )
        self._clock = clock
        self._configuration = configuration
        self._displacements = displacements
        self._names = tuple(channel.name for channel in displacements.every_channel)
        self._settle_s = SETTLED_LOOKS * displacements.longest_period_s
        self._wanted: set[str] = set()
        self._rows: deque[tuple[float, float, Mapping[str, float]]] = deque(maxlen=KEPT_ROWS)
        """When a row arrived, when it was measured, and its values."""

    def check(self, channel: str) -> None:
        """Refuse a channel that does not exist."""
        if channel not in self._names:
            raise CommissioningRefusedError(
                f"there is no displacement channel {channel}; the configuration has {', '.join(self._names)}"
            )
        self._wanted.add(channel)

    async def follow(self) -> None:
        """Take rows of the channels that were checked until cancelled; raises LinkError when one cannot be read."""
        tasks = [asyncio.ensure_future(self._follow(each)) for each in self._displacements.with_channels(self._wanted)]
        try:
            await asyncio.gather(*tasks)
        finally:
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)

    async def _follow(self, each: registry.DisplacementInput) -> None:
        source = registry.open_displacement_source(self._configuration, each, self._clock, None)
        try:
            async for sample in source.samples():
                row = dict(zip(self._names, sample.um.tolist(), strict=True))
                self._rows.append((self._clock.now().monotonic_s, sample.utc_s, row))
        finally:
            await source.close()

    async def mean(self, channels: Sequence[str], samples: int, patience_s: float) -> dict[str, Reading]:
        """Return means over rows that were measured after this call [um]."""
        begin = self._clock.now()
        begin_s = begin.monotonic_s
        while True:
            rows = [
                row
                for arrived_s, measured_utc_s, row in self._rows
                if arrived_s > begin_s + self._settle_s and measured_utc_s > begin.utc_s
            ]
            # The first value may have been measured before the question and written late.
            found = {name: [row[name] for row in rows if np.isfinite(row[name])][1:] for name in channels}
            if all(len(values) >= samples for values in found.values()):
                return {name: _mean(values[:samples], name) for name, values in found.items()}
            if self._clock.now().monotonic_s - begin_s > patience_s:
                fewest = min(found, key=lambda name: len(found[name]))
                raise CommissioningRefusedError(
                    f"displacement channel {fewest}: {len(found[fewest])} of {samples} samples came within "
                    f"{patience_s:g} s; check the logger and its clock, or ask for fewer with --samples"
                )
            await asyncio.sleep(0.02)


def _mean(values: Sequence[float], channel: str) -> Reading:
    return Reading(
        um=float(np.mean(values)),
        source=f"displacement channel {channel}",
        noise_um=float(np.std(values, ddof=1)) if len(values) > 1 else None,
        samples=len(values),
    )


class Instruments:
    """Every source of readings of one commissioning; a channel goes before an option, an option before a person."""

    def __init__(
        self,
        dialogue: Dialogue,
        *,
        log: DisplacementLog | None,
        channels: Mapping[str, str],
        given: Mapping[tuple[str, str], tuple[float, float, float]],
        samples: int,
        patience_s: float,
    ) -> None:
        """`channels` maps axes to displacement channels, `given` (commanded, observed) axes to three readings [um]."""
        self._dialogue = dialogue
        self._log = log
        self._channels = dict(channels)
        self._given = dict(given)
        self._samples = samples
        self._patience_s = patience_s
        self._unseen: set[tuple[str, str]] = set()
        """Pairs of (commanded, observed) axis where the person has no instrument."""
        if log is not None:
            for channel in self._channels.values():
                log.check(channel)

    def observed_by(self, axis: str) -> str:
        """Return in words what reads this axis when it is commanded."""
        if axis in self._channels:
            return f"displacement channel {self._channels[axis]}, mean of {self._samples} samples"
        return "readings given with --reading" if (axis, axis) in self._given else "your reading of the instrument"

    async def take(self, commanded: str, moment: Moment, axes: Sequence[str]) -> dict[str, Reading]:
        """Return the readings of the commanded axis and of every other one that is observed."""
        readings = await self._by_channel(axes)
        for axis in (commanded, *(axis for axis in axes if axis != commanded)):
            if axis in readings:
                continue
            given = self._given.get((commanded, axis))
            if given is not None:
                await self._confirm(axis, moment, given[moment])
                readings[axis] = Reading(um=given[moment], source="given with --reading")
            elif (commanded, axis) not in self._unseen:
                await self._ask(commanded, axis, moment, readings)
        return readings

    async def _confirm(self, axis: str, moment: Moment, um: float) -> None:
        """Have a person confirm now what --reading said beforehand: else it proves a movement that no person saw."""
        if not await self._dialogue.confirm_expressly(
            f"Does the instrument along {axis} read {um:g} um {WORDS[moment]}, as --reading says?"
        ):
            raise UnreadError(
                f"axis {axis}: no person has confirmed {um:g} um {WORDS[moment]}, so --reading proves nothing; leave "
                "it out and answer with what the instrument shows, or read it from a --channel"
            )

    async def _by_channel(self, axes: Sequence[str]) -> dict[str, Reading]:
        wanted = {axis: self._channels[axis] for axis in axes if axis in self._channels}
        if not wanted or self._log is None:
            return {}
        means = await self._log.mean(tuple(wanted.values()), self._samples, self._patience_s)
        return {axis: means[channel] for axis, channel in wanted.items()}

    async def _ask(self, commanded: str, axis: str, moment: Moment, readings: dict[str, Reading]) -> None:
        if axis == commanded:
            um = await self._dialogue.number(f"Reading along {axis}, {WORDS[moment]} [um]:")
            if um is None:
                raise UnreadError(
                    f"axis {axis}: there is no reading {WORDS[moment]}, and without one nothing is proved; read the "
                    "instrument, or name --channel or --reading"
                )
        else:
            um = await self._dialogue.number(
                f"Reading along {axis}, which must not move, {WORDS[moment]} [um] (Enter: no instrument there):"
            )
            if um is None:
                self._unseen.add((commanded, axis))
                return
        readings[axis] = Reading(um=um, source="read by the person")
