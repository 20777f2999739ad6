"""The order of sensors, channels and axes in the records of one machine."""

import json
from dataclasses import dataclass
from functools import cached_property
from typing import Self

import numpy as np
import numpy.typing as npt

from config.schema import Configuration


@dataclass(frozen=True, slots=True, kw_only=True)
class Layout:
    """The members of one BLOB, in order."""

    kind: str
    name: str
    members: str
    """JSON list."""


@dataclass(frozen=True, kw_only=True)
class MachineLayout:
    """Names of the positions in a machine's records."""

    sensor_ids: tuple[int, ...]
    """In the machine's order."""
    lines: dict[str, tuple[int, ...]]
    """Sensor IDs of each line by chain position, and of each source."""
    axes: tuple[str, ...]
    displacement_channels: tuple[str, ...] = ()
    sample_macros: frozenset[int] | None = None
    """Macros of a CNC sample that are kept; None keeps all. What we write stands in the audit."""

    @classmethod
    def from_configuration(cls, configuration: Configuration) -> Self:
        """Return the layout that a configuration describes; of the polled macros the echo is kept."""
        displacements, macros = configuration.displacements, configuration.cnc.macros
        return cls(
            sensor_ids=configuration.temperatures.sensor_ids,
            lines={each.name: each.sensor_ids for each in configuration.temperatures.inputs},
            axes=tuple(configuration.compensation.axes),
            displacement_channels=tuple(c.name for c in displacements.every_channel) if displacements else (),
            sample_macros=frozenset(
                [*macros.echo_applied.values(), macros.echo_time, macros.echo_status, macros.echo_guard_version]
            ),
        )

    @cached_property
    def machine(self) -> Layout:
        return Layout(kind="machine", name="", members=json.dumps(self.sensor_ids))

    @cached_property
    def line_layouts(self) -> dict[str, Layout]:
        return {
            name: Layout(kind="line", name=name, members=json.dumps(sensor_ids))
            for name, sensor_ids in self.lines.items()
        }

    @cached_property
    def line_positions(self) -> dict[str, npt.NDArray[np.intp]]:
        """Where the sensors of each line stand in the machine's order."""
        position = {sensor_id: index for index, sensor_id in enumerate(self.sensor_ids)}
        return {name: np.array([position[i] for i in ids], dtype=np.intp) for name, ids in self.lines.items()}

    @property
    def layouts(self) -> tuple[Layout, ...]:
        """Everything that the store has to know before a record of this machine."""
        return (self.machine, *self.line_layouts.values())
