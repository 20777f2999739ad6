"""Sorts the macro variables of the block before anything is written: vacant, ours, or foreign."""

from collections.abc import Mapping
from dataclasses import dataclass

from config.schema.cnc import MacroMapConfig
from config.schema.spindle_speed import SpeedMacrosConfig
from daemon.cnc.macro_block import MacroBlock

VALUE_SLACK = 1e-6


@dataclass(frozen=True, slots=True, kw_only=True)
class BlockFound:
    """What stands in the variables that are ours."""

    values: Mapping[int, float | None]
    vacant: tuple[int, ...]
    """To be set to 0; valid_until is never among them, because vacant is its rest."""
    foreign: tuple[int, ...]
    """Neither vacant nor 0 nor what our own audit says."""

    @property
    def foreign_in_words(self) -> str:
        return ", ".join(f"#{number} = {self.values[number]:g}" for number in self.foreign)


def find_block(
    macros: MacroMapConfig,
    block: MacroBlock,
    known: Mapping[int, tuple[float, ...]] | None,
    found: Mapping[int, float | None],
    speed: SpeedMacrosConfig | None = None,
) -> BlockFound:
    """Sort the variables that are ours; `known` is what the audit says they may hold."""
    ours = ours_to_initialise(macros, block, speed)
    guarded = {*block.ours, *(() if speed is None else speed.ours)}
    at_rest = {macros.valid_until, None if speed is None else speed.valid_until}
    values = {number: found.get(number) for number in ours}
    return BlockFound(
        values=values,
        vacant=tuple(number for number, value in values.items() if value is None and number not in at_rest),
        foreign=tuple(
            number
            for number, value in values.items()
            if value is not None
            and abs(value) > VALUE_SLACK
            and number in guarded
            and not any(abs(value - before) <= VALUE_SLACK for before in (known or {}).get(number, ()))
        ),
    )


def ours_to_initialise(
    macros: MacroMapConfig, block: MacroBlock, speed: SpeedMacrosConfig | None = None
) -> tuple[int, ...]:
    """Return the variables that only the daemon writes: the block, the answer of the handshake, the speed's block."""
    acknowledge = macros.request_macros.get("acknowledge")
    compensation = block.ours if acknowledge is None else (*block.ours, acknowledge)
    return compensation if speed is None else (*compensation, *speed.ours)


def zero_groups(
    macros: MacroMapConfig, numbers: tuple[int, ...], speed: SpeedMacrosConfig | None = None
) -> tuple[tuple[tuple[int, float], ...], ...]:
    """Return zeros for these variables in the order of every write: sequence_a, the rest, sequence_b."""
    blocks: list[MacroMapConfig | SpeedMacrosConfig] = [macros] if speed is None else [macros, speed]
    firsts, lasts = {each.sequence_a for each in blocks}, {each.sequence_b for each in blocks}
    others = firsts | lasts | {each.valid_until for each in blocks}
    first = tuple((n, 0.0) for n in numbers if n in firsts)
    last = tuple((n, 0.0) for n in numbers if n in lasts)
    rest = tuple((n, 0.0) for n in numbers if n not in others)
    return tuple(group for group in (first, rest, last) if group)


class CommissioningRefusedError(Exception):
    """The commissioning cannot begin or go on; the text says what, why, and what the person can do."""


class UnreadError(CommissioningRefusedError):
    """A person has not said that the instrument shows what would prove the axis."""


class ForeignWriterError(CommissioningRefusedError):
    """Another program writes the block: nothing more may be written, not even a retreat."""
