"""Least, greatest and mean of the series in one packed hour: what a chart of months needs of it."""

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from daemon.history.columns.codec import ByteReader, FloatArray, block, deflate, inflate
from daemon.history.columns.frames import ColumnType, Frame, Kind, MappingColumn
from daemon.history.columns.temperature_chunks import CycleBlock
from models.quality import Quality
from models.units import degc_from_int16

FORMAT = 1
MAPPINGS = frozenset(
    {"thermal_error_um", "band_um", "label_degc", "um", "requested_um", "compensation_um", "applied_um"}
)
SCALARS = frozenset({"spindle_speed_rpm", "motor_temperature_degc"})


@dataclass(frozen=True, slots=True, kw_only=True)
class Extremes:
    """Of each series in one hour."""

    names: tuple[str, ...]
    """`mapping.key` or the column; of temperatures none: the series are the positions of the line."""
    table: npt.NDArray[np.float32]
    """Least, greatest, mean, and of how many values, shape (4, series); zeros where there is none."""

    def place(self, name: str) -> int | None:
        """Return the column of a series, None where the hour has none of it."""
        return self.names.index(name) if name in self.names else None


def temperature_extremes(content: CycleBlock) -> bytes:
    """Return the extremes of the accepted values of one line, by position."""
    good = content.quality == Quality.GOOD
    return _encoded((), np.where(good, degc_from_int16(content.counts), np.nan))


def frame_extremes(kind: Kind, frame: Frame) -> bytes:
    """Return the extremes of a kind's numbers; b"" where it has none to show."""
    found = dict(_series(kind, frame))
    return _encoded(tuple(found), np.column_stack(list(found.values()))) if found else b""


def _series(kind: Kind, frame: Frame) -> Iterator[tuple[str, FloatArray]]:
    for column in kind.columns:
        if column.type is ColumnType.MAPPING and column.name in MAPPINGS:
            values: MappingColumn = frame.mapping(column.name)
            for key, numbers in values.values.items():
                yield f"{column.name}.{key}", numbers
        elif column.name in SCALARS:
            yield column.name, frame.numbers(column.name)


def _encoded(names: Sequence[str], values: FloatArray) -> bytes:
    """Encode the extremes of a table, shape (rows, series); NaN does not count."""
    known = np.isfinite(values)
    count = known.sum(axis=0)
    mean = np.where(known, values, 0.0).sum(axis=0) / np.maximum(count, 1)
    least, greatest = np.where(known, values, np.inf).min(axis=0), np.where(known, values, -np.inf).max(axis=0)
    table = np.array([np.where(count, least, 0.0), np.where(count, greatest, 0.0), mean, count], dtype="<f4")
    planes = table.view(np.uint8).reshape(-1, 4).T
    return bytes([FORMAT]) + deflate(block(json.dumps(list(names)).encode()) + planes.tobytes())


def decode_extremes(data: bytes) -> Extremes:
    """Return what was encoded; raises ValueError when a newer version did it."""
    if data[0] != FORMAT:
        raise ValueError(f"extremes have format {data[0]}; this version of toolpoint knows {FORMAT}")
    reader = ByteReader(inflate(memoryview(data)[1:]))
    names = tuple(json.loads(bytes(reader.block())))
    planes = np.frombuffer(reader.rest(), dtype=np.uint8).reshape(4, -1)
    table = np.ascontiguousarray(planes.T).view("<f4").reshape(4, -1)
    return Extremes(names=names, table=table)
