"""Which pin of LinuxCNC's motion controller stands for which macro variable."""

from collections.abc import Mapping
from dataclasses import dataclass

from config.schema.cnc import CncConfig
from config.schema.cnc_drivers import LinuxcncConfig

VACANT = -999_999_999.0
"""Stands for a vacant variable: a pin always has a value."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Pins:
    """Numbers of analog inputs, which the daemon sets, and of analog outputs, which the NC program sets."""

    clock: int
    """Analog input with the seconds since LinuxCNC's start."""
    inputs: Mapping[int, int]
    """Macro variable -> analog input."""
    outputs: Mapping[int, int]
    """Macro variable -> analog output."""

    @classmethod
    def of(cls, config: CncConfig) -> "Pins":
        """Return the pins of the map: the clock and what the daemon writes, in the block's order, and the NC's own."""
        macros, own = config.macros, config.connection_as(LinuxcncConfig)
        request = macros.request_macros
        acknowledge = request.pop("acknowledge", None)
        nc = [*macros.echo_applied.values(), macros.echo_time, macros.echo_status, macros.echo_guard_version]
        nc += [*request.values(), *([] if macros.safe_flag is None else [macros.safe_flag])]
        ours = [number for number in macros.block if number not in nc and number != acknowledge]
        ours += [number for number in (acknowledge,) if number is not None]
        if config.temperature_macro is not None:
            ours.append(config.temperature_macro.macro)
        return cls(
            clock=own.analog_in,
            inputs={number: own.analog_in + 1 + place for place, number in enumerate(ours)},
            outputs={number: own.analog_out + place for place, number in enumerate(nc)},
        )

    def __len__(self) -> int:
        """Return how many analog pins `num_aio` has to allow."""
        return 1 + max(self.clock, *self.inputs.values(), *self.outputs.values())
