"""A recording of temperatures and displacements, what may be wrong with it, and its parts."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from models.errors import RefusedInputError
from models.recordings.blocks import block_means
from models.recordings.plausibility import impossible_displacements, impossible_speeds, impossible_temperatures
from models.records import FloatArray


class DatasetError(RefusedInputError, ValueError):
    """A recording cannot be used; the text names column and row and says what to do."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Recording:
    """Temperatures and displacements over time.

    Raises DatasetError when shapes and names do not fit together, or times are not finite and increasing.
    """

    name: str
    """Where it came from, for messages and reports."""
    time_s: FloatArray
    """Seconds since the recording's first row [s], shape (n,); a part keeps the times of the whole."""
    speed_rpm: FloatArray | None
    """Spindle speed [1/min], shape (n,), NaN where unknown; None when it was not recorded."""
    temperature_names: tuple[str, ...]
    temperatures_degc: FloatArray
    """Temperatures [degC], shape (n, n_sensors), NaN where missing."""
    displacement_names: tuple[str, ...]
    displacements_um: FloatArray
    """Displacements [um], shape (n, n_channels), NaN where missing; raw, as measured."""
    axis_positions: tuple[str, ...] = ()
    """The last of `temperature_names`, when they are axis positions [mm]: inputs of models like temperatures."""
    pivots_mm: Mapping[str, float] = field(default_factory=dict)
    """Displacement channels that are slopes along an axis [um/m], and where each adds nothing [mm]."""
    rows_before: int = 0
    """Rows of the file that come before the first one, so that findings name the file's row."""

    def __post_init__(self) -> None:
        rows = len(self.time_s)
        tables = (
            ("temperature", self.temperature_names, self.temperatures_degc),
            ("displacement", self.displacement_names, self.displacements_um),
        )
        for kind, names, table in tables:
            if table.shape != (rows, len(names)):
                raise DatasetError(
                    f"{self.name}: {rows} times and {len(names)} {kind} names need a table of that shape, "
                    f"not {table.shape}"
                )
        if self.speed_rpm is not None and self.speed_rpm.shape != (rows,):
            raise DatasetError(f"{self.name}: {rows} times need as many speeds, not {self.speed_rpm.shape}")
        names = (*self.temperature_names, *self.displacement_names)
        if twice := sorted({name for name in names if names.count(name) > 1}):
            raise DatasetError(f"{self.name}: the columns {', '.join(twice)} appear twice; names must be unique")
        if self.axis_positions != self.temperature_names[self.sensors :]:
            raise DatasetError(f"{self.name}: axis positions must be the last inputs, not {self.axis_positions}")
        _require_increasing(self.name, self.time_s)
        for array in (self.time_s, self.temperatures_degc, self.displacements_um):
            array.flags.writeable = False
        if self.speed_rpm is not None:
            self.speed_rpm.flags.writeable = False

    @property
    def rows(self) -> int:
        """Number of rows."""
        return len(self.time_s)

    @property
    def sensors(self) -> int:
        """Number of temperature sensors, which come before the axis positions."""
        return len(self.temperature_names) - len(self.axis_positions)

    @property
    def sample_s(self) -> float:
        """Median time between rows [s]; NaN with fewer than two rows."""
        return float(np.median(np.diff(self.time_s))) if self.rows > 1 else float("nan")

    def part(self, first: int, stop: int) -> "Recording":
        """Return rows `first` to `stop` (exclusive, from 0) as a recording with the same clock."""
        return replace(
            self,
            rows_before=self.rows_before + first,
            time_s=self.time_s[first:stop],
            speed_rpm=None if self.speed_rpm is None else self.speed_rpm[first:stop],
            temperatures_degc=self.temperatures_degc[first:stop],
            displacements_um=self.displacements_um[first:stop],
        )

    def between_hours(self, from_hours: float, to_hours: float) -> "Recording":
        """Return the rows with ``from_hours <= time < to_hours``, counted from the first row [h].

        Raises DatasetError when no row lies there.
        """
        if not from_hours < to_hours:
            raise DatasetError(f"{self.name}: hours {from_hours:g} to {to_hours:g} run backwards")
        first, stop = np.searchsorted(self.time_s, (from_hours * 3600.0, to_hours * 3600.0), side="left")
        if stop <= first:
            raise DatasetError(
                f"{self.name}: there is no row in hours {from_hours:g} to {to_hours:g}; "
                f"the recording covers {self._covers()}"
            )
        return self.part(int(first), int(stop))

    def _covers(self) -> str:
        if self.rows == 0:
            return "nothing"
        return f"hours {self.time_s[0] / 3600.0:.2f} to {self.time_s[-1] / 3600.0:.2f}"

    def with_channels(self, names: tuple[str, ...]) -> "Recording":
        """Return the recording with the named displacement channels only, in that order.

        Raises DatasetError when a channel does not exist.
        """
        if unknown := [name for name in names if name not in self.displacement_names]:
            raise DatasetError(
                f"{self.name}: there is no displacement channel {', '.join(unknown)}; "
                f"there are {', '.join(self.displacement_names)}"
            )
        columns = [self.displacement_names.index(name) for name in names]
        return replace(
            self,
            displacement_names=names,
            displacements_um=self.displacements_um[:, columns],
            pivots_mm={name: mm for name, mm in self.pivots_mm.items() if name in names},
        )

    def downsampled(self, period_s: float) -> "Recording":
        """Return block means over `period_s` [s] (see `models.recordings.blocks.block_means`).

        A recording that is already sampled at the period, or more slowly, is returned unchanged:
        means cannot add rows.
        """
        if self.rows < 2 or self.sample_s >= period_s:
            return self
        speed_rpm = None
        if self.speed_rpm is not None:
            _, speed_rpm = block_means(self.time_s, self.speed_rpm, period_s)
        time_s, temperatures_degc = block_means(self.time_s, self.temperatures_degc, period_s)
        _, displacements_um = block_means(self.time_s, self.displacements_um, period_s)
        return replace(
            self,
            rows_before=0,
            time_s=time_s,
            speed_rpm=speed_rpm,
            temperatures_degc=temperatures_degc,
            displacements_um=displacements_um,
        )

    def without_impossible(self) -> "Recording":
        """Return the recording in which single values that cannot be are missing (`models.recordings.plausibility`)."""
        wrong_degc = np.zeros(self.temperatures_degc.shape, dtype=np.bool_)
        wrong_degc[:, : self.sensors] = impossible_temperatures(self.temperatures_degc[:, : self.sensors])
        wrong_um = impossible_displacements(self.displacements_um)
        speed_rpm = self.speed_rpm
        if speed_rpm is not None and (wrong_rpm := impossible_speeds(speed_rpm)).any():
            speed_rpm = np.where(wrong_rpm, np.nan, speed_rpm)
        if speed_rpm is self.speed_rpm and not wrong_degc.any() and not wrong_um.any():
            return self
        return replace(
            self,
            speed_rpm=speed_rpm,
            temperatures_degc=np.where(wrong_degc, np.nan, self.temperatures_degc),
            displacements_um=np.where(wrong_um, np.nan, self.displacements_um),
        )


def _require_increasing(name: str, time_s: FloatArray) -> None:
    if not np.all(np.isfinite(time_s)):
        row = int(np.argmin(np.isfinite(time_s))) + 1
        raise DatasetError(f"{name}: column time, row {row}: not a time; every row needs one")
    steps = np.diff(time_s)
    if np.any(steps <= 0):
        row = int(np.argmax(steps <= 0)) + 2
        raise DatasetError(
            f"{name}: column time, row {row}: {time_s[row - 1]:g} s does not come after {time_s[row - 2]:g} s; "
            "sort the rows, and split the file where the logger was restarted"
        )
