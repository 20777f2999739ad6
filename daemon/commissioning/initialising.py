"""The macro variables of the block before anything is written: vacant, ours, or somebody else's."""

from collections.abc import Mapping
from dataclasses import dataclass

from config.schema.cnc import MacroMapConfig
from daemon.output.macro_block import MacroBlock

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
        """Each foreign variable with its value."""
        return ", ".join(f"#{number} = {self.values[number]:g}" for number in self.foreign)


def find_block(
    macros: MacroMapConfig,
    block: MacroBlock,
    known: Mapping[int, tuple[float, ...]] | None,
    found: Mapping[int, float | None],
) -> BlockFound:
    """Sort the variables that are ours; `known` is what the audit says they may hold."""
    ours = ours_to_initialise(macros, block)
    values = {number: found.get(number) for number in ours}
    return BlockFound(
        values=values,
        vacant=tuple(number for number, value in values.items() if value is None and number != macros.valid_until),
        foreign=tuple(
            number
            for number, value in values.items()
            if value is not None
            and abs(value) > VALUE_SLACK
            and number in block.ours
            and not any(abs(value - before) <= VALUE_SLACK for before in (known or {}).get(number, ()))
        ),
    )


def ours_to_initialise(macros: MacroMapConfig, block: MacroBlock) -> tuple[int, ...]:
    """Return the variables that only the daemon writes: the block, and the answer of the handshake."""
    acknowledge = macros.request_macros.get("acknowledge")
    return block.ours if acknowledge is None else (*block.ours, acknowledge)


def zero_groups(macros: MacroMapConfig, numbers: tuple[int, ...]) -> tuple[tuple[tuple[int, float], ...], ...]:
    """Return zeros for these variables in the order of every write: sequence_a, the rest, sequence_b."""
    first = tuple((n, 0.0) for n in numbers if n == macros.sequence_a)
    last = tuple((n, 0.0) for n in numbers if n == macros.sequence_b)
    rest = tuple((n, 0.0) for n in numbers if n not in (macros.sequence_a, macros.sequence_b, macros.valid_until))
    return tuple(group for group in (first, rest, last) if group)
