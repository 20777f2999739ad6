"""Numbers in the fields of a JSON object. No I/O."""

import math
import re
from collections.abc import Mapping
from typing import Any, TypeVar

from drivers.readings import NoReading
from models.quality import Reason

QUOTED = 40
T = TypeVar("T")
BLANK = " \t\r\n\0"
"""Stands around a number that a device writes as text; some fill a field of fixed length with zeros."""
_NUMBER = re.compile(r"[+-]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][+-]?[0-9]+)?")


def readings_in(content: Any, fields: Mapping[int | str, str]) -> dict[int | str, float | NoReading]:
    """Return the numbers of a JSON value by the input's key; a field that is absent or null is left out.

    `a.b` is b within a; the empty field is the value itself.
    """
    found: dict[int | str, float | NoReading] = {}
    for key, field in fields.items():
        value = content
        for step in field.split(".") if field else ():
            value = value.get(step) if isinstance(value, dict) else None
        if value is not None:
            found[key] = number_of(value)
    return found


def number_in(text: str, otherwise: T) -> float | T:
    """Return the number that a whole text is, with a decimal point and without a unit; `otherwise` where it is none."""
    text = text.strip(BLANK)
    return float(text) if _NUMBER.fullmatch(text) else otherwise


def number_of(value: Any, key: str = "field") -> float | NoReading:
    """Return a JSON value, or the text of a number, as a number; a truth value is none.

    `key` of the configuration says where it is.
    """
    if isinstance(value, str):
        value = number_in(value, value)
    if isinstance(value, int | float) and not isinstance(value, bool):
        try:
            return float(value)
        except OverflowError:
            return math.inf
    return NoReading(reason=Reason.UNREADABLE, why=f"holds no number but {str(value)[:QUOTED]!r}: correct `{key}`")
