"""Frozen records as JSON values and back, by their annotations."""

import math
import types
from collections.abc import Mapping
from dataclasses import MISSING, fields, is_dataclass
from enum import StrEnum
from functools import cache
from types import MappingProxyType
from typing import Any, Union, get_args, get_origin, get_type_hints

import numpy as np

from models.json_values import plain
from models.records import Instant

PLAIN = (int, str, bool, type(None))
"""Types that are JSON values themselves."""


class DocumentError(ValueError):
    """A stored document is not what its record says; the text says where."""


def to_json(value: Any) -> Any:
    """Return a record as JSON values: NaN as null, an instant as its UTC [s]."""
    if value is None or isinstance(value, bool | int | str):
        return value
    if isinstance(value, float):
        return float(value) if math.isfinite(value) else None
    if isinstance(value, np.ndarray):
        value = value.tolist() if value.dtype.kind != "f" or np.isfinite(value).all() else plain(value)
        return value
    if isinstance(value, Instant):
        return value.utc_s
    if isinstance(value, tuple | list):
        return [item if item.__class__ in PLAIN else to_json(item) for item in value]
    if isinstance(value, Mapping):
        return {str(key): to_json(item) for key, item in value.items()}
    return {field.name: to_json(getattr(value, field.name)) for field in fields(value)}


def from_json(kind: Any, value: Any, now: Instant) -> Any:
    """Return JSON values as what `kind` says; the age of an instant is carried over by the calendar clock.

    Raises DocumentError when they are something else.
    """
    origin, of = get_origin(kind), get_args(kind)
    if origin in (types.UnionType, Union):
        if value is None and type(None) in of:
            return None
        (kind,) = (arm for arm in of if arm is not type(None))
        return from_json(kind, value, now)
    if kind is Any:
        return value
    if kind is Instant:
        age_s = now.utc_s - _checked(value, (int, float))
        return Instant(monotonic_s=now.monotonic_s - age_s, utc_s=now.utc_s - age_s, real_s=now.real_s - age_s)
    if origin is np.ndarray:
        (element,) = get_args(of[1])
        plain = bool if element is np.bool_ else float
        return np.array([from_json(plain, item, now) for item in _checked(value, list)], dtype=element)
    if origin is tuple:
        return tuple(from_json(of[0], item, now) for item in _checked(value, list))
    if origin is not None and issubclass(origin, Mapping):
        items = _checked(value, dict).items()
        try:
            keys = [of[0](key) for key, _ in items]
        except ValueError as error:
            raise DocumentError(str(error)) from None
        return MappingProxyType({key: from_json(of[1], item, now) for key, (_, item) in zip(keys, items, strict=True)})
    if is_dataclass(kind):
        return _record(kind, _checked(value, dict), now)
    return _plain(kind, value)


def _plain(kind: Any, value: Any) -> Any:
    if kind is float:
        return math.nan if value is None else float(_checked(value, (int, float)))
    if issubclass(kind, StrEnum):
        try:
            return kind(value)
        except ValueError as error:
            raise DocumentError(str(error)) from None
    return _checked(value, kind)


def _record(kind: Any, found: dict[str, Any], now: Instant) -> Any:
    values = {}
    for field, of in zip(fields(kind), _annotations(kind), strict=True):
        if field.name in found:
            try:
                values[field.name] = from_json(of, found[field.name], now)
            except DocumentError as error:
                raise DocumentError(f"{field.name}: {error}") from None
        elif field.default is MISSING and field.default_factory is MISSING:
            raise DocumentError(f"{field.name} is missing")
    return kind(**values)


@cache
def _annotations(kind: Any) -> tuple[Any, ...]:
    hints = get_type_hints(kind)
    return tuple(hints[field.name] for field in fields(kind))


def _checked(value: Any, kind: Any) -> Any:
    """Return a value of this type; true and false are no numbers."""
    if not isinstance(value, kind) or (isinstance(value, bool) and kind is not bool):
        raise DocumentError(f"{value!r} is not what is kept here")
    return value
