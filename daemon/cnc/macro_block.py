"""The block of macro variables: encodes a command, decodes the echo, and tells our values from foreign ones."""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from config.schema.cnc import MacroMapConfig
from config.schema.guard import GuardConfig
from drivers.guard.check import PER_SECOND, block_check
from models.control.state import OutputLimits
from models.records import CompensationCommand, FloatArray

ECHO_SLACK_UM = 0.05
"""Allowed between the echo and what explains it [um]."""
NO_STATUS = -1
"""Stands for an echo status that is no whole number, which no guard has written."""
UNFINISHED = 14
"""Echo status of a run of the guard that was broken off."""
UNSETTLED = (6, 8, 9, UNFINISHED)
"""Echo status with which the echo may not say what is applied: inch, which leaves a broken run as it is, memory
damaged, offset unsettled, unfinished."""
LAST_SEQUENCE = 999_999
"""Sequence numbers run from 1 to here and start again."""
UNRECORDED_WRITES = 3
"""So many writes may have gone out while a slow disk had not yet committed the first of them."""


def begun_after(
    known: Mapping[int, tuple[float, ...]], found: Mapping[int, float | None], sequence_a: int, sequence_b: int
) -> bool:
    """Say whether a block's sequence numbers show a write that was begun after everything that is recorded.

    That is what a power cut leaves when it comes between the write and the disk: the next numbers, or the
    next in sequence_a and the recorded one still in sequence_b. A value that somebody else has put there
    leaves them as they were.
    """
    first, last, recorded = found.get(sequence_a), found.get(sequence_b), known.get(sequence_a)
    if first is None or last is None or not recorded or first in recorded or not first.is_integer():
        return False
    ahead = (round(first) - round(recorded[-1])) % LAST_SEQUENCE
    return 1 <= ahead <= UNRECORDED_WRITES and (last == first or last in known.get(sequence_b, ()))


def sequence_of(value: float | None) -> int:
    """Return the sequence number that a macro holds, 0 where it holds none."""
    return int(value) if value is not None and value.is_integer() and 0 <= value <= LAST_SEQUENCE else 0


def status_of(value: float | None) -> int | None:
    """Return the status that a program of the NC has left in a macro, None where it is vacant."""
    return None if value is None else int(value) if value.is_integer() else NO_STATUS


@dataclass(frozen=True, slots=True, kw_only=True)
class Echo:
    """What the guard says it did."""

    applied_um: FloatArray
    """Per axis [um], NaN where vacant."""
    time_s: float | None
    status: int | None
    """A GuardStatus, or NO_STATUS; None where vacant."""
    guard_version: float | None

    @property
    def settled(self) -> bool:
        """What it says is what is applied."""
        return self.status not in UNSETTLED


class MacroBlock:
    """Layout of the block for one machine."""

    def __init__(
        self,
        macros: MacroMapConfig,
        axes: Sequence[str],
        factors: Mapping[str, float],
        guard: GuardConfig | None = None,
        also_polled: Iterable[int] = (),
        pivots_mm: Mapping[str, float] | None = None,
    ) -> None:
        """`guard` says what an expired block does; without it an expired block keeps what is applied."""
        self._pivots_mm = pivots_mm
        self._map = macros
        self._guard = guard
        self._axes = tuple(axes)
        self._um_per_unit = np.array([macros.unit_um * factors.get(axis, 1.0) for axis in axes])
        self.um_per_unit = dict(zip(self._axes, self._um_per_unit.tolist(), strict=True))
        """Movement per unit of the macro value by axis [um]."""
        self.ours = (
            macros.sequence_a,
            *(macros.values[axis] for axis in axes),
            macros.valid_until,
            macros.enable,
            *(() if macros.check is None else (macros.check,)),
            macros.sequence_b,
        )
        self.polled = tuple(dict.fromkeys((*macros.block, *also_polled)))
        self.read_back = (
            *self.ours,
            *(macros.echo_applied[axis] for axis in axes),
            macros.echo_time,
            macros.echo_status,
            macros.echo_guard_version,
        )

    def encode(
        self, command: CompensationCommand, *, sequence: int, valid_until_s: float
    ) -> tuple[tuple[tuple[int, float], ...], ...]:
        """Return the groups to write, strictly one after another: sequence_a, content with its check, sequence_b.

        Values are whole nanometres and valid_until whole tenths of a second, so that the check is a whole number.
        """
        nm_per_unit = self._map.unit_um * 1000.0
        nm = np.round(command.compensation_um / self._um_per_unit * nm_per_unit)
        bits = sum(1 << index for index, on in enumerate(command.enable) if on)
        content = [
            (self._map.values[axis], float(value) / nm_per_unit) for axis, value in zip(self._axes, nm, strict=True)
        ]
        tenths = math.floor(valid_until_s * PER_SECOND)
        content += [(self._map.valid_until, tenths / PER_SECOND), (self._map.enable, float(bits))]
        if self._map.check is not None:
            held = {**dict(content), self._map.sequence_b: float(sequence)}
            content.append((self._map.check, block_check(self._map, self._axes, held, self._pivots_mm)))
        return (((self._map.sequence_a, float(sequence)),), tuple(content), ((self._map.sequence_b, float(sequence)),))

    def echo(self, macros: Mapping[int, float | None]) -> Echo:
        """Decode the guard's echo from macro values."""
        values = [macros.get(self._map.echo_applied[axis]) for axis in self._axes]
        units = np.array([np.nan if value is None else value for value in values])
        status = macros.get(self._map.echo_status)
        return Echo(
            applied_um=units * self._um_per_unit,
            time_s=macros.get(self._map.echo_time),
            status=status_of(status),
            guard_version=macros.get(self._map.echo_guard_version),
        )

    def differences(
        self, acceptable: Mapping[int, tuple[float | None, ...]], found: Mapping[int, float | None]
    ) -> list[str]:
        """Return what is vacant or foreign among our macros, in words; one that may hold None may be vacant."""
        vacant: dict[int, None] = {}
        problems: list[str] = []
        for number, allowed in acceptable.items():
            value = found.get(number)
            if value is None:
                if None not in allowed:
                    vacant[number] = None
                continue
            for expected in allowed:
                if expected is not None and self._close(value, expected):
                    break
            else:
                written = " or ".join(dict.fromkeys(f"{v:g}" for v in allowed if v is not None)) or "nothing"
                problems.append(f"macro #{number} holds {value:g}, we wrote {written}")
        return self.vacant(vacant) + problems if vacant else problems

    def unrecorded(
        self, known: Mapping[int, tuple[float, ...]], found: Mapping[int, float | None], limits: OutputLimits
    ) -> bool:
        """Say whether this is a block of ours that a power cut kept from the disk: begun next, and within the bounds.

        Whether the guard's echo fits it is asked apart, as of every block.
        """
        values = {number: found.get(number) for number in self.ours}
        if any(value is None or not math.isfinite(value) for n, value in values.items() if n != self._map.valid_until):
            return False
        bits = found.get(self._map.enable) or 0.0
        within = np.abs(self.values_um(found)) <= limits.absolute_bound_um + limits.rounding_um
        return (
            begun_after(known, found, self._map.sequence_a, self._map.sequence_b)
            and bits in range(1 << len(self._axes))
            and bool(within.all())
        )

    def vacant(self, ours: Mapping[int, float | None]) -> list[str]:
        """Return which of our macros are vacant, in words; power-off clears valid_until, so that one may be."""
        return [
            f"macro #{number} is vacant; commissioning initialises it"
            for number, value in ours.items()
            if value is None and number != self._map.valid_until
        ]

    @property
    def expires_to_zero(self) -> bool:
        """The guard takes the offset out, step by step, when the block has expired."""
        return self._guard is not None and self._guard.on_expiry == "zero"

    def expired(self, macros: Mapping[int, float | None], clock_s: float) -> bool:
        """Whether the guard would call this block expired at this reading of the CNC's clock [s]."""
        valid_until_s = macros.get(self._map.valid_until)
        ahead_s = np.inf if self._guard is None else self._guard.max_validity_s
        return valid_until_s is None or not clock_s < valid_until_s <= clock_s + ahead_s

    def implausible_echo(
        self, macros: Mapping[int, float | None], limits: OutputLimits, *, after_expiry: bool = False
    ) -> list[str]:
        """Return what the guard cannot have applied: more than the bound, or more than a step from what is written.

        `after_expiry`: the guard may have taken an expired block's offset out, so anything between zero and what is
        written is plausible as well.
        """
        found, allowed = (
            (self.echo(macros).applied_um, self.values_um(macros)),
            (limits.absolute_bound_um, limits.step_um),
        )
        rows = zip(self._axes, *(each.tolist() for each in (*found, *allowed, limits.rounding_um)), strict=True)
        problems = []
        for axis, applied_um, held_um, bound_um, step_um, slack_um in rows:
            written_um = 0.0 if math.isnan(held_um) else held_um
            if abs(applied_um) > bound_um + slack_um:
                problems.append(
                    f"axis {axis}: the CNC says that it applies {applied_um:.3f} um, the bound is {bound_um:g} um"
                )
            elif after_expiry and _between_zero_and(written_um, applied_um, slack_um):
                continue
            elif abs(applied_um - written_um) > step_um + slack_um:
                problems.append(
                    f"axis {axis}: the CNC says that it applies {applied_um:.3f} um, the block holds "
                    f"{written_um:.3f} um, and the guard's step is {step_um:g} um"
                )
        return problems

    def values_um(self, macros: Mapping[int, float | None]) -> FloatArray:
        """Return the compensation that the block holds per axis [um], NaN where it is vacant."""
        values = [macros.get(self._map.values[axis]) for axis in self._axes]
        units: FloatArray = np.array([np.nan if value is None else value for value in values]) * self._um_per_unit
        return units

    def enabled(self, macros: Mapping[int, float | None]) -> bool:
        return bool(macros.get(self._map.enable))

    def sequence(self, macros: Mapping[int, float | None]) -> int:
        """Return the sequence number in the CNC, 0 where there is none."""
        return sequence_of(macros.get(self._map.sequence_b))

    def _close(self, value: float, expected: float) -> bool:
        return value == expected or abs(value - expected) <= max(self._map.tolerance, 1e-9 * abs(expected))


def _between_zero_and(written_um: float, applied_um: float, slack_um: float) -> bool:
    """Whether the way from the written value to zero leads over what is applied."""
    return bool(min(written_um, 0.0) - slack_um <= applied_um <= max(written_um, 0.0) + slack_um)
