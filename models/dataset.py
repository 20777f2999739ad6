"""A recording of temperatures and displacements, what may be wrong with it, and its parts."""

import itertools
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from models.align import block_means, contiguous_runs
from models.records import FloatArray

TOO_HOT_DEGC = 150.0
"""A median above this is no machine tool in degC (kelvin start at 253 here)."""
SMALLEST_SPAN_UM = 0.5
"""All channels moving less than this while the machine warms are not in micrometres."""
WARMING_K = 2.0
"""A temperature span that moves any machine tool by more than `SMALLEST_SPAN_UM`."""
LARGEST_SPAN_UM = 5000.0
"""A channel that moves more is not in micrometres (no displacement sensor of a nest reaches so far)."""


class DatasetError(ValueError):
    """A recording cannot be used; the text names column and row and says what to do."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Finding:
    """One thing that is wrong, or noteworthy, in a recording."""

    severity: Literal["error", "warning"]
    column: str
    """Name of the column; empty when it is about the recording as a whole."""
    row: int | None
    """Row from 1 (without the header), None when it is about the whole column."""
    sentence: str

    def __str__(self) -> str:
        """Return `column <name>, row <n>: <sentence>`."""
        place = [f"column {self.column}"] if self.column else []
        place += [f"row {self.row}"] if self.row is not None else []
        return f"{', '.join(place)}: {self.sentence}" if place else self.sentence


@dataclass(frozen=True, slots=True, kw_only=True)
class Recording:
    """Temperatures and displacements over time.

    Raises
    ------
    DatasetError
        When shapes and names do not fit together, or times are not finite and increasing.

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
    def sample_s(self) -> float:
        """Median time between rows [s]; NaN with fewer than two rows."""
        return float(np.median(np.diff(self.time_s))) if self.rows > 1 else float("nan")

    def part(self, first: int, stop: int) -> "Recording":
        """Return rows `first` to `stop` (exclusive, from 0) as a recording with the same clock."""
        return replace(
            self,
            time_s=self.time_s[first:stop],
            speed_rpm=None if self.speed_rpm is None else self.speed_rpm[first:stop],
            temperatures_degc=self.temperatures_degc[first:stop],
            displacements_um=self.displacements_um[first:stop],
        )

    def between_hours(self, from_hours: float, to_hours: float) -> "Recording":
        """Return the rows with ``from_hours <= time < to_hours``, counted from the first row [h].

        Raises
        ------
        DatasetError
            When no row lies there.

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

        Raises
        ------
        DatasetError
            When a channel does not exist.

        """
        if unknown := [name for name in names if name not in self.displacement_names]:
            raise DatasetError(
                f"{self.name}: there is no displacement channel {', '.join(unknown)}; "
                f"there are {', '.join(self.displacement_names)}"
            )
        columns = [self.displacement_names.index(name) for name in names]
        return replace(self, displacement_names=names, displacements_um=self.displacements_um[:, columns])

    def downsampled(self, period_s: float) -> "Recording":
        """Return block means over `period_s` [s] (see `models.align.block_means`).

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
            time_s=time_s,
            speed_rpm=speed_rpm,
            temperatures_degc=temperatures_degc,
            displacements_um=displacements_um,
        )

    def split_at_speed_changes(self, change_rpm: float = 100.0) -> list["Recording"]:
        """Return the stretches of constant spindle speed.

        Spindle deformation by inertia makes displacements jump at a change of speed; increments
        that never cross one do not carry the jump.

        Parameters
        ----------
        change_rpm
            A stretch ends where the speed has left its first value by more than this [1/min].

        Raises
        ------
        DatasetError
            When the speed was not recorded.

        """
        if self.speed_rpm is None:
            raise DatasetError(f"{self.name}: to split at changes of speed, the recording needs a speed column")
        bounds = [0]
        level_rpm = self.speed_rpm[0] if self.rows else 0.0
        for row, speed_rpm in enumerate(self.speed_rpm):
            if abs(speed_rpm - level_rpm) > change_rpm or np.isnan(level_rpm):
                bounds.append(row)
                level_rpm = speed_rpm
        bounds.append(self.rows)
        return [self.part(a, b) for a, b in itertools.pairwise(bounds) if b > a]

    def findings(self, rows_together: int | None = None) -> tuple[Finding, ...]:
        """Return everything that is wrong or noteworthy, errors first (see `require_usable`)."""
        found = [*self._row_findings(rows_together), *self._column_findings(), *self._unit_findings()]
        return tuple(sorted(found, key=lambda finding: finding.severity != "error"))

    def _row_findings(self, rows_together: int | None) -> list[Finding]:
        variables = len(self.temperature_names)
        rows = self.rows if rows_together is None else rows_together
        if rows <= variables:
            sentence = f"{rows} rows cannot determine {variables} variables; record longer or choose fewer temperatures"
            return [Finding(severity="error", column="", row=None, sentence=sentence)]
        runs = contiguous_runs(self.time_s, self.sample_s)
        return [
            Finding(
                severity="warning",
                column="time",
                row=first + 1,
                sentence=f"a gap of {self.time_s[first] - self.time_s[first - 1]:g} s before this row; "
                "no difference is taken across it",
            )
            for first, _ in runs[1:]
        ]

    def _column_findings(self) -> list[Finding]:
        found = []
        columns = [
            *zip(self.temperature_names, self.temperatures_degc.T, strict=True),
            *zip(self.displacement_names, self.displacements_um.T, strict=True),
        ]
        if self.speed_rpm is not None and len(self.speed_rpm) and not np.isfinite(self.speed_rpm).any():
            sentence = "no value at all, which is not standstill; take the column out of the file or of the map"
            found.append(Finding(severity="error", column="spindle speed", row=None, sentence=sentence))
        for name, column in columns:
            missing = ~np.isfinite(column)
            if not len(column) or missing.all():
                sentence = "no value at all; take the column out of the map"
                found.append(Finding(severity="error", column=name, row=None, sentence=sentence))
                continue
            if missing.any():
                row = int(np.argmax(missing)) + 1
                sentence = f"{missing.sum()} values are missing, the first here; rows without them are left out"
                found.append(Finding(severity="warning", column=name, row=row, sentence=sentence))
            known = column[~missing]
            if len(known) > 2 and known.min() == known.max():
                sentence = f"constant at {known[0]:g} over the whole recording; is the sensor connected?"
                found.append(Finding(severity="warning", column=name, row=None, sentence=sentence))
        return found

    def _unit_findings(self) -> list[Finding]:
        found = []
        spans_k = []
        for name, column in zip(self.temperature_names, self.temperatures_degc.T, strict=True):
            known = column[np.isfinite(column)]
            if not len(known):
                continue
            spans_k.append(float(np.ptp(known)))
            if (median := float(np.median(known))) > TOO_HOT_DEGC:
                unit = "kelvin; subtract 273.15" if median < 400.0 else "raw counts; convert them"
                sentence = f"a median of {median:.4g} cannot be degC; it looks like {unit}"
                found.append(Finding(severity="error", column=name, row=None, sentence=sentence))
        spans_um = {}
        for name, column in zip(self.displacement_names, self.displacements_um.T, strict=True):
            known = column[np.isfinite(column)]
            if len(known):
                spans_um[name] = float(np.ptp(known))
        for name, span_um in spans_um.items():
            if span_um > LARGEST_SPAN_UM:
                sentence = f"moves by {span_um:.4g}, too far for micrometres; it looks like nanometres or raw counts"
                found.append(Finding(severity="error", column=name, row=None, sentence=sentence))
        warmed_k = max(spans_k, default=0.0)
        if warmed_k > WARMING_K and spans_um and (widest := max(spans_um.values())) < SMALLEST_SPAN_UM:
            name = max(spans_um, key=lambda channel: spans_um[channel])
            sentence = (
                f"no displacement moves by more than {widest:.3g} while temperatures change by {warmed_k:.3g} K; "
                "that looks like millimetres; multiply by 1000"
            )
            found.append(Finding(severity="error", column=name, row=None, sentence=sentence))
        return found

    def require_usable(self, rows_together: int | None = None) -> tuple[Finding, ...]:
        """Return the warnings of a recording that training may use.

        Parameters
        ----------
        rows_together
            Rows of all recordings that are used together with this one, which have to be more than the
            variables; None: it is used alone.

        Returns
        -------
        tuple of Finding
            Gaps, missing values, constant sensors.

        Raises
        ------
        DatasetError
            Naming every error: fewer rows than variables, columns without values, units that
            cannot be right.

        """
        found = self.findings(rows_together)
        if errors := [finding for finding in found if finding.severity == "error"]:
            raise DatasetError("\n".join(f"{self.name}: {finding}" for finding in errors))
        return found


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
