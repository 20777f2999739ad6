"""A machine that plays a recording: its temperatures, displacements and spindle speed, on a simulated NC.

The mean of the recording's first block stands still for `LEAD_IN_S`; then work is positioned, for as long as a request
of that has no answer where the map has one. From there on the tool is always at a safe point, so that the NC applies
what it is given once a second. Temperatures, axis positions and displacements go straight from one row to the next:
rows of a minute are no steps of several kelvin.
"""

from collections.abc import Mapping, Sequence
from typing import Any, Protocol

import numpy as np

from config.schema.cnc import MacroMapConfig
from config.schema.compensation import AxisConfig
from config.schema.guard import GuardConfig
from config.schema.temperatures import SensorConfig
from drivers.sim.contract import AxisTruth
from drivers.sim.nc.nc import NumericalControl, RunCode
from drivers.sim.nc.nc_programs import NcPrograms
from drivers.sim.nc.program import Block
from drivers.sim.nc.safe_point import SafePointApplication
from models.records import FloatArray

LEAD_IN_S = 120.0
"""The reference is the mean of a minute, so the first block is shown for longer than that [s]."""
POSITIONING_S = 20.0
PROGRAM, POSITIONING, SAFE = 3000, 100, 900
ROOM_DEGC = 25.0
BRIDGED_S = 600.0
"""Over a longer time without rows nothing is known, and the last row stands [s]."""


class PlayedRecording(Protocol):
    """What is played: a row per time."""

    @property
    def time_s(self) -> FloatArray:
        """Times, increasing [s], shape (n,)."""

    @property
    def temperatures_degc(self) -> FloatArray:
        """Temperatures [degC], shape (n, n_sensors), then axis positions [mm], NaN where missing."""

    @property
    def axis_positions(self) -> tuple[str, ...]:
        """Names of the last columns of these, when they are axis positions."""

    @property
    def displacement_names(self) -> tuple[str, ...]: ...

    @property
    def displacements_um(self) -> FloatArray:
        """Displacements [um], shape (n, n_channels), NaN where missing."""

    @property
    def speed_rpm(self) -> FloatArray | None:
        """Spindle speed [1/min], shape (n,); None when it was not recorded."""


class RecordedMachine:
    """Implements `drivers.sim.contract.SimulatedMachine` for one recording; every channel is an axis."""

    def __init__(
        self,
        recording: PlayedRecording,
        sensors: Sequence[SensorConfig],
        macro_map: MacroMapConfig,
        axes: Mapping[str, AxisConfig],
        guard: GuardConfig | None = None,
        *,
        block_s: float,
        positions: Mapping[str, str] | None = None,
    ) -> None:
        """`positions`: letters of the axes whose positions the NC shows, by the name of the recording's column."""
        first_position = recording.temperatures_degc.shape[1] - len(recording.axis_positions)
        if len(sensors) != (columns := first_position):
            raise ValueError(f"the recording has {columns} temperatures, the machine {len(sensors)} sensors")
        self._recording = recording
        self._time_s = recording.time_s - recording.time_s[0]
        first = self._time_s < block_s
        self._first_degc: FloatArray = recording.temperatures_degc[first].mean(axis=0)
        self._zero_um: FloatArray = recording.displacements_um[first].mean(axis=0)
        self._position = {sensor.id: index for index, sensor in enumerate(sensors)}
        self._axes = tuple(axes)
        names = recording.displacement_names
        self._channels = {name: axis.estimate for name, axis in axes.items() if axis.estimate in names}
        self.time_s = 0.0
        of_column = {name: first_position + index for index, name in enumerate(recording.axis_positions)}
        self._positions = {letter: of_column[name] for name, letter in (positions or {}).items()}
        self._request = macro_map.request
        self._sequence_number = POSITIONING
        self._nc = NumericalControl(program=PROGRAM, clock_s=5000.0, clock_ppm=0.0, power_on_count=1, tool_number=1)
        self._guard = SafePointApplication(macro_map, axes, guard)
        self._nc.keeps_all, self._nc.external_mm = self._guard.keeps_all, self._guard.control.external_mm
        self._guard.initialise(self._nc.macros, self._nc.clock_s)
        self._programs = NcPrograms(self._guard, self._nc, lambda *_: None)
        self._coming = [
            (LEAD_IN_S, Block(sequence_number=POSITIONING, kind="positioning", duration_s=POSITIONING_S)),
            (LEAD_IN_S + POSITIONING_S, Block(sequence_number=SAFE, kind="safe", duration_s=self.duration_s)),
        ]
        self._blocks = BlockMeans(block_s, len(self._axes))
        self._show()

    @property
    def nc(self) -> NumericalControl:
        return self._nc

    @property
    def duration_s(self) -> float:
        """How long it plays, lead-in included [s]."""
        return LEAD_IN_S + float(self._time_s[-1])

    def advance(self, to_s: float) -> None:
        """Move on to the simulated time `to_s` [s]; a past time is ignored."""
        if to_s <= self.time_s:
            return
        self.time_s = to_s
        self._show()
        while self._coming and self._coming[0][0] <= to_s:
            start_s, block = self._coming.pop(0)
            self._programs.run_until(start_s)
            if block.kind == "safe" and not self._answered:
                self._coming.insert(0, (start_s + POSITIONING_S, block))
                if self._programs.waits_until_s is not None:
                    continue
                block = Block(sequence_number=POSITIONING, kind="positioning", duration_s=POSITIONING_S)
            self._sequence_number = self._nc.sequence_number = block.sequence_number
            self._programs.enter(block, start_s, probed_um=None)
        self._programs.run_until(np.nextafter(to_s, np.inf))
        if LEAD_IN_S <= to_s <= self.duration_s:
            self._blocks.add(to_s - LEAD_IN_S, self._error_um(), self._applied_um())

    @property
    def _answered(self) -> bool:
        """Whether the daemon has set the reference that was asked for; True where nobody asks."""
        if self._request is None:
            return True
        asked, answer = (self._nc.macros.get(n) for n in (self._request.counter, self._request.acknowledge))
        return bool(asked) and answer == asked

    def register_codes(self, sensor_ids: Sequence[int]) -> list[int]:
        """Return the TMP102 codes of the recording's row now; NaN in the recording reads 0."""
        row = self._inputs()
        codes = []
        for sensor_id in sensor_ids:
            degc = row[self._position[sensor_id]]
            counts = 0 if not np.isfinite(degc) else round(float(np.clip(degc, -128.0, 127.9)) * 16)
            codes.append(counts & 0xFFF)
        return codes

    def _inputs(self) -> FloatArray:
        """Return temperatures [degC] and axis positions [mm] now."""
        playing = self.time_s >= LEAD_IN_S
        return self._between_rows(self._recording.temperatures_degc) if playing else self._first_degc

    def displacement_um(self) -> dict[str, float]:
        """Return the recording's displacements now by channel [um], with what the NC applies to their axes."""
        row = self._between_rows(self._recording.displacements_um)
        readings = dict(zip(self._recording.displacement_names, row.tolist(), strict=True))
        for axis, channel in self._channels.items():
            assert channel is not None
            readings[channel] += self._guard.applied_um[axis]
        return readings

    def truth(self) -> dict[str, AxisTruth]:
        """Return what was measured since the first block, without and with what the NC has applied."""
        if self.time_s < LEAD_IN_S:
            return {}
        error, applied = self._error_um(), self._applied_um()
        return {
            axis: AxisTruth(uncompensated_um=float(error[i]), compensated_um=float(error[i] + applied[i]), cutting=True)
            for i, axis in enumerate(self._axes)
        }

    def channels(self) -> dict[str, dict[str, dict[str, float]]]:
        """Return RMSE and largest error per channel without and with compensation [um], of the block means."""
        without, compensated = self._blocks.series()
        return {
            axis: {"without": _summary(without[:, i]), "with": _summary(compensated[:, i])}
            for i, axis in enumerate(self._axes)
        }

    def series(self) -> dict[str, Any]:
        """Return the block means without and with compensation per channel [um], None where nothing was measured."""
        tables = [np.where(np.isfinite(table), np.round(table, 3), np.nan) for table in self._blocks.series()]
        columns = {
            axis: {
                case: [None if np.isnan(value) else value for value in table[:, i].tolist()]
                for case, table in zip(("without", "with"), tables, strict=True)
            }
            for i, axis in enumerate(self._axes)
        }
        return {"block_s": self._blocks.block_s, "channels": columns}

    def _row(self) -> int:
        played_s = max(self.time_s - LEAD_IN_S, 0.0)
        return max(int(np.searchsorted(self._time_s, played_s, side="right")) - 1, 0)

    def _between_rows(self, table: FloatArray) -> FloatArray:
        """Return a row of a table as it is now: on the straight line to the next one, where both are known."""
        row = self._row()
        if row + 1 >= len(table) or (span_s := float(self._time_s[row + 1] - self._time_s[row])) > BRIDGED_S:
            return np.asarray(table[row])
        share = max(self.time_s - LEAD_IN_S - float(self._time_s[row]), 0.0) / span_s
        between = table[row] + min(share, 1.0) * (table[row + 1] - table[row])
        return np.asarray(np.where(np.isfinite(between), between, table[row]))

    def _error_um(self) -> FloatArray:
        return self._between_rows(self._recording.displacements_um) - self._zero_um

    def _applied_um(self) -> FloatArray:
        return np.array(list(self._guard.applied_um.values()))

    def _show(self) -> None:
        nc, speed = self._nc, self._recording.speed_rpm
        nc.clock_s = nc.clock_at(self.time_s)
        self._guard.show(nc.macros, nc.clock_s)
        nc.spindle_speed_rpm = float(speed[self._row()]) if speed is not None else 0.0
        nc.motor_temperature_degc = ROOM_DEGC
        if self._positions:
            inputs = self._inputs()
            nc.positions_mm.update({letter: float(inputs[column]) for letter, column in self._positions.items()})
        positioned = self.time_s >= LEAD_IN_S
        nc.run = RunCode.START if positioned else RunCode.STOP
        if positioned:
            nc.sequence_number = self._sequence_number


class BlockMeans:
    """Means over successive blocks of errors without and with compensation."""

    def __init__(self, block_s: float, width: int) -> None:
        self.block_s = block_s
        self._number = 0
        self._count = 0
        self._sums = np.zeros((2, width))
        self._done: list[FloatArray] = []

    def add(self, time_s: float, error_um: FloatArray, applied_um: FloatArray) -> None:
        number = int(time_s // self.block_s)
        if number != self._number:
            self._close()
            self._number = number
        self._sums += (error_um, error_um + applied_um)
        self._count += 1

    def series(self) -> tuple[FloatArray, FloatArray]:
        """Return the two series of block means [um], shape (blocks, channels) each, from the first block's level."""
        rows = [*self._done, self._sums / self._count] if self._count else self._done
        if not rows:
            empty = np.zeros((0, self._sums.shape[1]))
            return empty, empty
        stacked = np.array(rows)
        return stacked[:, 0], stacked[:, 1]

    def _close(self) -> None:
        if self._count:
            self._done.append(self._sums / self._count)
        self._sums = np.zeros_like(self._sums)
        self._count = 0


def _summary(series_um: FloatArray) -> dict[str, float]:
    known = series_um[np.isfinite(series_um)]
    if not known.size:
        return {"rmse_um": float("nan"), "max_um": float("nan")}
    return {"rmse_um": float(np.sqrt(np.mean(known**2))), "max_um": float(np.abs(known).max())}
