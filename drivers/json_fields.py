"""Numbers in the fields of a JSON object. No I/O."""

import math
from collections.abc import Mapping
from typing import Any

from drivers.readings import NoReading
from models.json_values import number_in
from models.quality import Reason

QUOTED = 40


def readings_in(content: Any, fields: Mapping[int | str, str]) -> dict[int | str, float | NoReading]:
    """Return the numbers of a JSON value by the input's key: `a.b` is b within a, `a.0` its first, '' the value."""
    found: dict[int | str, float | NoReading] = {}
    for key, field in fields.items():
        value = content
        whole = isinstance(content, dict) and field in content  # a key may have a dot in it
        for step in [field] if whole else field.split(".") if field else ():
            if isinstance(value, list) and step.isdecimal():
                value = dict(enumerate(value)).get(int(step[:9]))
            else:
                value = value.get(step) if isinstance(value, dict) else None
        if value is not None:
            found[key] = number_of(value)
    return found


def number_of(value: Any, key: str = "field") -> float | NoReading:
    """Return a JSON value, or the text of a number, as a number; a truth value is none."""
    value = number_in(value)
    if isinstance(value, int | float) and not isinstance(value, bool):
        try:
            return float(value)
        except OverflowError:
            return math.inf
    return NoReading(reason=Reason.UNREADABLE, why=f"holds no number but {str(value)[:QUOTED]!r}: correct `{key}`")
