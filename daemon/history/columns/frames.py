"""Frames: the rows of one kind of record as columns, from SQL rows or from packed bytes."""

import json
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from enum import Enum, auto
from typing import Any

import numpy as np

from daemon.history.columns.codec import ByteReader, FloatArray, IntArray, decode_floats, decode_integers, inflate

FORMAT = 1
Keys = tuple[str, ...] | None


class ColumnType(Enum):
    """How a column is held and packed."""

    INTEGER = auto()
    NUMBER = auto()
    """float64; SQL's NULL is NaN."""
    TEXT = auto()
    MAPPING = auto()
    """A JSON object of numbers per row, whose keys seldom change."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Column:
    name: str
    type: ColumnType
    relative_to: str | None = None
    """An INTEGER column before this one; only the difference to it is packed."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Kind:
    """One kind of record: its table and columns, in the order in which they are packed."""

    name: str
    table: str
    columns: tuple[Column, ...]

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(column.name for column in self.columns)

    def closure(self, names: Collection[str] | None) -> set[str]:
        """Return the names with the columns that they are relative to; None means all."""
        if names is None:
            return set(self.names)
        if unknown := set(names) - set(self.names):
            raise ValueError(f"{self.name} have no columns {sorted(unknown)}")
        return set(names) | {c.relative_to for c in self.columns if c.name in names and c.relative_to}


@dataclass(frozen=True, slots=True, kw_only=True)
class MappingColumn:
    """Numbers by key and row."""

    shapes: tuple[Keys, ...]
    """The distinct lists of keys that rows have, in their order; None for a row without a mapping."""
    shape_of_row: IntArray
    values: dict[str, FloatArray]
    """Per key one number for every row; NaN where it is null or the row does not have the key."""

    def row(self, index: int) -> dict[str, float | None] | None:
        """Return one row as it was written; null, and what JSON has no word for, as None."""
        keys = self.shapes[int(self.shape_of_row[index])]
        if keys is None:
            return None
        numbers = ((key, float(self.values[key][index])) for key in keys)
        return {key: number if np.isfinite(number) else None for key, number in numbers}


ColumnData = IntArray | FloatArray | list[str | None] | MappingColumn


@dataclass(frozen=True, slots=True, kw_only=True)
class Frame:
    """Rows of one kind as columns."""

    rows: int
    columns: dict[str, ColumnData]

    def integers(self, name: str) -> IntArray:
        column = self.columns[name]
        assert isinstance(column, np.ndarray)
        return column.astype(np.int64, copy=False)

    def numbers(self, name: str) -> FloatArray:
        column = self.columns[name]
        assert isinstance(column, np.ndarray)
        return column.astype(np.float64, copy=False)

    def texts(self, name: str) -> list[str | None]:
        column = self.columns[name]
        assert isinstance(column, list)
        return column

    def mapping(self, name: str) -> MappingColumn:
        column = self.columns[name]
        assert isinstance(column, MappingColumn)
        return column


def frame_from_rows(kind: Kind, names: Collection[str], rows: Sequence[Sequence[Any]]) -> Frame:
    """Return SQL rows, whose columns are those of `kind` that are in `names`, in kind's order."""
    wanted = [column for column in kind.columns if column.name in names]
    by_column: Iterable[Sequence[Any]] = zip(*rows, strict=True) if rows else [() for _ in wanted]
    return Frame(
        rows=len(rows),
        columns={column.name: _from_sql(column, values) for column, values in zip(wanted, by_column, strict=True)},
    )


def _from_sql(column: Column, values: Sequence[Any]) -> ColumnData:
    if column.type is ColumnType.INTEGER:
        return np.array(values, dtype=np.int64)
    if column.type is ColumnType.NUMBER:
        return np.array(values, dtype=np.float64)
    if column.type is ColumnType.TEXT:
        return list(values)
    return mapping_from_json(values)


def mapping_from_json(texts: Sequence[str | None]) -> MappingColumn:
    """Return JSON objects of numbers, one per row, as columns."""
    rows: list[dict[str, float | None] | None] = [None if text is None else json.loads(text) for text in texts]
    keys_of_row: list[Keys] = [None if row is None else tuple(row) for row in rows]
    codes = {keys: code for code, keys in enumerate(dict.fromkeys(keys_of_row))}
    values = {
        key: np.array([np.nan if row is None else row.get(key) for row in rows], dtype=np.float64)
        for key in all_keys(codes)
    }
    shape_of_row = np.array([codes[keys] for keys in keys_of_row], dtype=np.int64)
    return MappingColumn(shapes=tuple(codes), shape_of_row=shape_of_row, values=values)


def all_keys(shapes: Iterable[Keys]) -> list[str]:
    return list(dict.fromkeys(key for keys in shapes for key in keys or ()))


def decode_frame(kind: Kind, data: bytes | memoryview, names: Collection[str] | None = None) -> Frame:
    """Return the columns of a packed frame that are asked for; the others cost nothing.

    A frame that was packed before its kind got its last columns, numbers or mappings, has none in them.
    """
    reader = ByteReader(data)
    if (form := reader.byte()) != FORMAT:
        raise ValueError(f"packed {kind.name} have format {form}; this version of toolpoint knows {FORMAT}")
    rows = reader.varint()
    wanted = kind.closure(names)
    columns: dict[str, ColumnData] = {}
    for column in kind.columns:
        if not reader and column.type is ColumnType.NUMBER:
            columns[column.name] = np.full(rows, np.nan)
            continue
        if not reader and column.type is ColumnType.MAPPING:
            columns[column.name] = mapping_from_json([None] * rows)
            continue
        part = reader.block()
        if column.name not in wanted:
            continue
        decoded = _decode_column(column, part, rows)
        if column.relative_to is not None:
            decoded = np.asarray(decoded, dtype=np.int64) + np.asarray(columns[column.relative_to], dtype=np.int64)
        columns[column.name] = decoded
    return Frame(rows=rows, columns=columns)


def _decode_column(column: Column, data: memoryview, rows: int) -> ColumnData:
    if column.type is ColumnType.INTEGER:
        return decode_integers(data, rows)
    if column.type is ColumnType.NUMBER:
        return decode_floats(data, rows)
    return _decode_texts(data, rows) if column.type is ColumnType.TEXT else _decode_mapping(data, rows)


def _decode_texts(data: memoryview, rows: int) -> list[str | None]:
    reader = ByteReader(data)
    distinct: list[str | None] = json.loads(inflate(reader.block()))
    return [distinct[code] for code in decode_integers(reader.block(), rows).tolist()]


def _decode_mapping(data: memoryview, rows: int) -> MappingColumn:
    reader = ByteReader(data)
    listed: list[list[str] | None] = json.loads(inflate(reader.block()))
    shapes = tuple(None if keys is None else tuple(keys) for keys in listed)
    shape_of_row = decode_integers(reader.block(), rows)
    values = {}
    for key in all_keys(shapes):
        present = has_key(shapes, shape_of_row, key)
        values[key] = np.full(rows, np.nan)
        values[key][present] = decode_floats(reader.block(), int(present.sum()))
    return MappingColumn(shapes=shapes, shape_of_row=shape_of_row, values=values)


def has_key(shapes: Sequence[Keys], shape_of_row: IntArray, key: str) -> np.ndarray[Any, np.dtype[np.bool_]]:
    having = np.array([keys is not None and key in keys for keys in shapes], dtype=bool)
    return having[shape_of_row] if having.size else np.zeros(shape_of_row.size, dtype=bool)


def select_rows(frame: Frame, index: IntArray) -> Frame:
    """Return the rows of a frame at the given positions, in that order."""
    columns: dict[str, ColumnData] = {}
    for name, data in frame.columns.items():
        if isinstance(data, MappingColumn):
            columns[name] = MappingColumn(
                shapes=data.shapes,
                shape_of_row=data.shape_of_row[index],
                values={key: values[index] for key, values in data.values.items()},
            )
        elif isinstance(data, list):
            columns[name] = [data[i] for i in index.tolist()]
        else:
            columns[name] = data[index]
    return Frame(rows=int(index.size), columns=columns)


def concatenate(frames: Sequence[Frame]) -> Frame:
    """Return frames with the same columns, one after another. At least one is needed."""
    if len(frames) == 1:
        return frames[0]
    columns: dict[str, ColumnData] = {}
    for name, first in frames[0].columns.items():
        if isinstance(first, MappingColumn):
            columns[name] = _concatenate_mappings([frame.mapping(name) for frame in frames])
        elif isinstance(first, list):
            columns[name] = [text for frame in frames for text in frame.texts(name)]
        else:
            columns[name] = np.concatenate([np.asarray(frame.columns[name]) for frame in frames])
    return Frame(rows=sum(frame.rows for frame in frames), columns=columns)


def _concatenate_mappings(parts: Sequence[MappingColumn]) -> MappingColumn:
    codes = {keys: code for code, keys in enumerate(dict.fromkeys(keys for part in parts for keys in part.shapes))}
    renumbered = [
        np.array([codes[keys] for keys in part.shapes], dtype=np.int64)[part.shape_of_row]
        for part in parts
        if part.shape_of_row.size
    ]
    values = {
        key: np.concatenate([part.values.get(key, np.full(part.shape_of_row.size, np.nan)) for part in parts])
        for key in all_keys(codes)
    }
    shape_of_row = np.concatenate(renumbered) if renumbered else np.zeros(0, dtype=np.int64)
    return MappingColumn(shapes=tuple(codes), shape_of_row=shape_of_row, values=values)
