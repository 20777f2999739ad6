"""Recordings for training from the daemon's own history: one-minute means, displacements without what was applied.

Displacement sensors feel what the NC applies, so the machine's own error is measured minus applied (the guard's echo).
Where that is unknown, or a FANUC or LinuxCNC applies a slope, the minute has no displacement; nor where the audit said
then that something else was applied than the echo says by the commissioning of now.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any

import numpy as np

from config.records.commissioning import load_commissioning
from config.schema import Configuration
from daemon.cnc.limits import CommissionedFactors
from daemon.history.columns.joining import time_s_of
from daemon.history.columns.kinds import WRITES
from daemon.history.reader import HistoryReader
from daemon.history.series import CncHistory
from daemon.state_store.documents import ControlRead, SensorLevelsDocument
from daemon.state_store.store import KEYS
from drivers.guard.sloped_axes import SlopedAxis, added_um, sloped_axes
from models.recordings.dataset import DatasetError, Recording
from models.records import FloatArray
from models.sensor_levels import BEGINNING_S
from models.thermal.features import BoolArray

MINUTE_S = 60.0
WINDOW_S = 6 * 3600.0
"""The history is read in pieces of this length, so that months of hundreds of sensors need little memory."""
LEAD_S = 600.0
"""Read before each piece, so that held temperatures have their last good value."""
LEAST_MIN = 120
"""Shorter stretches are left out [min]: models with lags take the machine as settled at the beginning of each."""
LONGEST_GAP_MIN = 10.0
"""After a longer stretch without displacements a new recording begins."""
OTHERWISE_UM, OTHERWISE_SHARE = 1.0, 0.05
"""By so much what was applied may differ between audit and echo, absolutely [um] and as a share."""


NAME = "history from minute "
"""A recording's name begins so; the number of its first minute since 1970 follows."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Minutes:
    """One-minute means of a piece of the history; NaN where nothing was measured."""

    minute: FloatArray
    """Number of the minute since 1970, shape (n,)."""
    speed_rpm: FloatArray
    degc: FloatArray
    own_um: FloatArray
    """Displacements minus what was applied [um], shape (n, n_channels)."""
    applied_um: FloatArray
    """What was applied [um], shape (n, n_channels)."""
    along_m: FloatArray
    """Distance of each channel's axis from its slope's pivot [m], NaN where it was not read; 0 without a slope."""
    measured: BoolArray
    """Where anything was measured, shape (n, n_channels)."""
    otherwise: int
    """Minutes that are left out because the control was commissioned otherwise since."""
    positions_mm: FloatArray
    """Axis positions [mm], in the order of `cnc.axis_positions`, shape (n, n_axes)."""
    file: tuple[str, ...]
    """The logger's file of each minute: another file may have another zero."""


def used_channels(configuration: Configuration) -> dict[str, str]:
    """Return the measured displacement channels that axes follow: axis by channel."""
    displacements = configuration.displacements
    measured = {channel.name for channel in displacements.every_channel} if displacements is not None else set()
    return {
        axis.estimate: name
        for name, axis in configuration.compensation.axes.items()
        if axis.estimate is not None and axis.estimate in measured
    }


def began_utc_s(recording: Recording) -> float:
    """Return when a recording from the history began [s]."""
    return MINUTE_S * int(recording.name.removeprefix(NAME))


def recordings_from_history(
    configuration: Configuration,
    reader: HistoryReader,
    um_per_unit: Mapping[str, float] | None,
    *,
    from_utc_s: float,
    to_utc_s: float,
    positions: bool = False,
) -> list[Recording]:
    """Return the stretches with displacements that are long enough to train on; raises DatasetError.

    `um_per_unit` is what one unit of an axis' echo macro means [um]; None on a machine that was never commissioned,
    where nothing can have been applied. With `positions` the axis positions are inputs too.
    """
    channels = used_channels(configuration)
    if not channels:
        raise DatasetError(
            "no axis follows a displacement channel that is measured, so there is nothing to train on: configure "
            "displacements, or train from recordings with `toolpoint thermal train`"
        )
    sensor_ids = configuration.temperatures.sensor_ids
    pieces = list(minutes_of_history(configuration, reader, channels, um_per_unit, from_utc_s, to_utc_s))
    axes = tuple(configuration.cnc.axis_positions) if positions else ()
    runs = list(_runs(pieces, sensor_ids, tuple(channels), axes))
    found = [run for run in runs if _lasted_min(run) >= LEAST_MIN]
    if not found:
        longest = max(map(_lasted_min, runs), default=0)
        raise DatasetError(
            f"the history has no {LEAST_MIN} minutes in a row with displacements of {', '.join(channels)}, "
            f"{longest} at most; leave the sensors in place for longer{_why_unknown(configuration, channels)}"
            f"{_commissioned_since(pieces)}"
            f"{what_is_left_out(reader, from_utc_s)}"
        )
    return found


def _lasted_min(recording: Recording) -> int:
    """Return from which to which minute it goes, however often was measured [min]."""
    return round(float(recording.time_s[-1]) / MINUTE_S) + 1


def _as_read_now_since_utc_s(reader: HistoryReader) -> float:
    """Return since when the configuration reads of every input what it reads now [s]."""
    gaps, others = _levels(reader).get("gaps", ()), _of_control(reader).get("since_utc_s", {}).values()
    return float(max([-np.inf, *others, *(gap["to_utc_s"] for gap in gaps if gap["from_utc_s"] < BEGINNING_S / 2)]))


def what_is_left_out(reader: HistoryReader, from_utc_s: float) -> str:
    """Return since when there is something to train on, '' where that is as early as it is asked for [s]."""
    if (since_s := _as_read_now_since_utc_s(reader)) <= from_utc_s:
        return ""
    since = datetime.fromtimestamp(since_s, UTC).isoformat(sep=" ", timespec="minutes")
    return f"; what is older than {since} is left out, because the configuration changed what sensors read"


def read_of_history(reader: HistoryReader) -> dict[str, str]:
    """Return what the daemon that wrote the history last read of each input of a model; empty: it did not say."""
    of_sensors: dict[str, str] = _levels(reader).get("reads", {})
    of_control: dict[str, str] = _of_control(reader).get("reads", {})
    return {f"sensor {sensor_id}": read for sensor_id, read in of_sensors.items()} | of_control


def _levels(reader: HistoryReader) -> dict[str, Any]:
    return reader.get_state(KEYS[SensorLevelsDocument]) or {}


def _of_control(reader: HistoryReader) -> dict[str, Any]:
    return reader.get_state(KEYS[ControlRead]) or {}


def _why_unknown(configuration: Configuration, channels: Mapping[str, str]) -> str:
    """Return what else may be why nothing was measured that counts, on axes whose slope counts for somewhere else."""
    sloped = [one for axis, one in sloped_axes(configuration).items() if axis in channels.values()]
    return "".join(f"; of axis {one.axis}: {one.unknown_share}" for one in sloped if one.unknown_share)


def _commissioned_since(pieces: Iterable[Minutes]) -> str:
    """Return how much is left out because signs or scales were others then, '' where nothing is."""
    if not (minutes := sum(piece.otherwise for piece in pieces)):
        return ""
    return f"; {minutes} minutes are left out, in which what was applied was counted by other signs or scales than now"


def commissioned_um_per_unit(configuration: Configuration) -> dict[str, float] | None:
    """Return what a unit of each axis' echo macro means [um]; None on a machine that was never commissioned."""
    axes = tuple(configuration.compensation.axes)
    record_path = configuration.compensation.commissioning_file
    if record_path is None or not record_path.is_file():
        return None
    factors = CommissionedFactors(load_commissioning(record_path), axes)
    return {axis: configuration.cnc.macros.unit_um * factors.get(axis, 1.0) for axis in axes}


def minutes_of_history(
    configuration: Configuration,
    reader: HistoryReader,
    channels: Mapping[str, str],
    um_per_unit: Mapping[str, float] | None,
    from_utc_s: float,
    to_utc_s: float,
    *,
    temperatures: bool = True,
) -> Iterator[Minutes]:
    """Yield one-minute means, piece by piece, as far as displacements were measured.

    With temperatures nothing of before the configuration reads under every ID what it reads now.
    """
    extent = reader.extent("displacements")
    if extent is None:
        return
    ours_s = _as_read_now_since_utc_s(reader) if temperatures else -np.inf
    start_s = max(from_utc_s, extent[0], ours_s) // MINUTE_S * MINUTE_S
    end_s = min(to_utc_s, extent[1] + MINUTE_S)
    while start_s < end_s:
        stop_s = min(start_s + WINDOW_S, end_s)
        sensor_ids = configuration.temperatures.sensor_ids if temperatures else ()
        piece = _piece(configuration, reader, channels, um_per_unit, sensor_ids, start_s, stop_s)
        if piece is not None:
            yield piece
        start_s += WINDOW_S


def _piece(
    configuration: Configuration,
    reader: HistoryReader,
    channels: Mapping[str, str],
    um_per_unit: Mapping[str, float] | None,
    sensor_ids: tuple[int, ...],
    start_s: float,
    stop_s: float,
) -> Minutes | None:
    displacements = reader.displacements(start_s, stop_s)
    if not len(displacements.time_s):
        return None
    first = round(start_s / MINUTE_S)
    count = max(int(np.ceil((stop_s - start_s) / MINUTE_S)), 1)
    raw = np.column_stack([displacements.um.get(name, np.full(len(displacements.time_s), np.nan)) for name in channels])
    um = means(displacements.time_s, raw, first, count)
    cnc, sloped = reader.cnc(start_s, stop_s), sloped_axes(configuration)
    along_m = np.column_stack([_along_m(cnc, sloped.get(axis)) for axis in channels.values()])
    applied_um, otherwise = np.zeros((count, len(channels))), np.zeros((count, len(channels)), dtype=bool)
    if um_per_unit is not None:
        echo = [_where_it_stood_um(configuration, cnc, axis, um_per_unit, sloped) for axis in channels.values()]
        applied_um = means(cnc.time_s, np.column_stack(echo), first, count)
        otherwise = _audited_otherwise(configuration, reader, cnc, um_per_unit, tuple(channels.values()), first, count)
        applied_um[otherwise] = np.nan
    degc = np.empty((count, 0))
    if sensor_ids:
        history = reader.temperatures(sensor_ids, start_s - LEAD_S, stop_s)
        degc = means(history.time_s, history.cleansed(), first, count)
    named = zip(displacements.time_s.tolist(), displacements.source, strict=True)
    files = {int(time_s // MINUTE_S): file for time_s, source in named if (file := source.rpartition(":")[0])}
    minute = first + np.arange(count)
    return Minutes(
        minute=minute.astype(np.float64),
        speed_rpm=means(cnc.time_s, cnc.spindle_speed_rpm[:, None], first, count)[:, 0],
        degc=degc,
        own_um=um - applied_um,
        applied_um=applied_um,
        along_m=means(cnc.time_s, along_m, first, count),
        measured=np.isfinite(um),
        otherwise=int((otherwise & np.isfinite(um)).any(axis=1).sum()),
        positions_mm=means(cnc.time_s, _positions_mm(configuration, cnc), first, count),
        file=tuple(files.get(int(number), "") for number in minute),
    )


def _audited_otherwise(
    configuration: Configuration,
    reader: HistoryReader,
    cnc: CncHistory,
    um_per_unit: Mapping[str, float],
    axes: Sequence[str],
    first: int,
    count: int,
) -> BoolArray:
    """Return in which minutes the audit of the writes knew something else applied than the echo says by now's units.

    The echo moves within a minute, and is polled at other times than a write reads it: what it said in the minutes
    around one counts.
    """
    frame = reader.frame(WRITES, MINUTE_S * first, MINUTE_S * (first + count), {"applied_um"})
    audited, sloped = frame.mapping("applied_um").values, sloped_axes(configuration)
    found = np.zeros((count, len(axes)), dtype=bool)
    for column, axis in enumerate(axes):
        for name in {axis, sloped[axis].slope if axis in sloped else axis} & audited.keys():
            then_um = means(time_s_of(frame), audited[name][:, None], first, count)[:, 0]
            low_um, high_um = _range_around(
                cnc.time_s, _echo_um(configuration, cnc, name, um_per_unit[name]), first, count
            )
            slack_um = OTHERWISE_UM + OTHERWISE_SHARE * np.abs(then_um)
            found[:, column] |= (then_um < low_um - slack_um) | (then_um > high_um + slack_um)
    return found


def _range_around(time_s: FloatArray, values: FloatArray, first: int, count: int) -> tuple[FloatArray, FloatArray]:
    """Return least and greatest value in each minute and its neighbours; infinite where there is none."""
    low, high = np.full(count + 2, np.inf), np.full(count + 2, -np.inf)
    place = np.floor(time_s / MINUTE_S).astype(np.intp) - first + 1
    known = (place >= 0) & (place < count + 2) & np.isfinite(values)
    np.minimum.at(low, place[known], values[known])
    np.maximum.at(high, place[known], values[known])
    low, high = (
        np.minimum(np.minimum(low[:-2], low[1:-1]), low[2:]),
        np.maximum(np.maximum(high[:-2], high[1:-1]), high[2:]),
    )
    return np.where(low <= high, low, -np.inf), np.where(low <= high, high, np.inf)


def _positions_mm(configuration: Configuration, cnc: CncHistory) -> FloatArray:
    """Return the axis positions of each poll [mm], in the configuration's order, NaN where there was none."""
    none = np.full(len(cnc.time_s), np.nan)
    named = configuration.cnc.axis_positions
    return np.array([cnc.positions_mm.get(name, none) for name in named]).reshape(len(named), len(none)).T


def _along_m(cnc: CncHistory, one: SlopedAxis | None) -> FloatArray:
    """Return how far an axis stood from its slope's pivot in each poll [m]."""
    none = np.full(len(cnc.time_s), np.nan)
    return np.zeros(len(none)) if one is None else one.along_m(cnc.positions_mm.get(one.position or "", none))


def _where_it_stood_um(
    configuration: Configuration,
    cnc: CncHistory,
    axis: str,
    um_per_unit: Mapping[str, float],
    sloped: Mapping[str, SlopedAxis],
) -> FloatArray:
    """Return what an axis was moved by in each poll, where it stood: at its slope's pivot if that is not read [um]."""
    um = _echo_um(configuration, cnc, axis, um_per_unit[axis])
    if (one := sloped.get(axis)) is None:
        return um
    per_m = _echo_um(configuration, cnc, one.slope, um_per_unit[one.slope])
    if not one.follows:
        return np.asarray(um + added_um(per_m, np.nan))
    return um if one.position is None else np.asarray(um + added_um(per_m, _along_m(cnc, one)))


def _echo_um(configuration: Configuration, cnc: CncHistory, axis: str, um_per_unit: float) -> FloatArray:
    number = configuration.cnc.macros.echo_applied[axis]
    values = cnc.macros.get(number)
    return np.full(len(cnc.time_s), np.nan) if values is None else values * um_per_unit


def means(time_s: FloatArray, values: FloatArray, first: int, count: int) -> FloatArray:
    """Return the mean of the known values in each minute, NaN where there is none, shape (count, columns)."""
    place = np.floor(time_s / MINUTE_S).astype(np.intp) - first
    inside = (place >= 0) & (place < count)
    place, values = place[inside], values[inside]
    known = np.isfinite(values)
    total, number = np.zeros((count, values.shape[1])), np.zeros((count, values.shape[1]))
    np.add.at(total, place, np.where(known, values, 0.0))
    np.add.at(number, place, known)
    return np.where(number > 0, total / np.maximum(number, 1.0), np.nan)


def _runs(
    pieces: list[Minutes], sensor_ids: tuple[int, ...], channels: tuple[str, ...], axes: tuple[str, ...]
) -> Iterator[Recording]:
    if not pieces:
        return
    minute = np.concatenate([piece.minute for piece in pieces])
    own_um = np.concatenate([piece.own_um for piece in pieces])
    file = np.array([name for piece in pieces for name in piece.file], dtype=object)
    measured = np.flatnonzero(np.isfinite(own_um).all(axis=1))
    if not len(measured):
        return
    breaks = (np.diff(minute[measured]) > LONGEST_GAP_MIN) | (file[measured][1:] != file[measured][:-1])
    speed = np.concatenate([piece.speed_rpm for piece in pieces])
    inputs = np.concatenate([np.column_stack([piece.degc, piece.positions_mm][: 1 + bool(axes)]) for piece in pieces])
    for rows in np.split(measured, np.flatnonzero(breaks) + 1):
        yield Recording(
            name=f"{NAME}{int(minute[rows[0]])}",
            time_s=MINUTE_S * (minute[rows] - minute[rows[0]]),
            speed_rpm=speed[rows] if np.isfinite(speed[rows]).any() else None,
            temperature_names=(*(f"T{sensor_id}" for sensor_id in sensor_ids), *axes),
            temperatures_degc=inputs[rows],
            axis_positions=axes,
            displacement_names=channels,
            displacements_um=own_um[rows],
        )
