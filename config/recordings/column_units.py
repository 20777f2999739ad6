"""The unit that a recording's column claims, by its name or by the row of units; whether it can be right."""

import math
import re

_SPELLINGS = {
    "ms": r"ms|msecs?|milliseconds?|millisekunden",
    "s": r"s|secs?|seconds?|sek|sekunden?",
    "min": r"mins?|minutes?|minuten?",
    "h": r"h|hrs?|hours?|stunden?|std",
    "d": r"d|days?|tage?",
    "um": r"[µμ]m|um|microns?|micromet(?:er|re)s?",
    "mm": r"mm|millimet(?:er|re)s?",
    "nm": r"nm",
    "in": r"in|inch|inches",
    "degC": r"°\s*c|℃|deg\s*_?c|c|celsius|grad c",
    "degF": r"°\s*f|℉|deg\s*_?f|f|fahrenheit",
    "K": r"k|kelvin",
    "1/min": r"rpm|1/min|min-1|min\^-1|[ur]/min",
    "krpm": r"krpm|x?\s*(?:1000|10\^?3|10³)\s*(?:[ur]?/\s*min|rpm|1/min)",
    "1/s": r"1/s|rps|rev/s|hz",
    "rad/s": r"rad/s",
    "%": r"%|percent|prozent",
}
_UNITS = {unit: re.compile(spelling) for unit, spelling in _SPELLINGS.items()}
_AT_THE_END = re.compile(r"[\[(]\s*([^\[\]()]+?)\s*[\])]\s*$|(?:^|[\s_/,])([^\s_/,]+)\s*$")
RPM_PER_UNIT = {"1/min": 1.0, "krpm": 1000.0, "1/s": 60.0, "rad/s": 30.0 / math.pi}
_OF_A_MAP = {
    "time": ("ms", "s", "min", "h", "d"),
    "speed": tuple(RPM_PER_UNIT),
    "displacements": ("um", "mm", "in"),
    "temperatures": ("degC", "degF"),
}
"""Units that a map can say, and a name may contradict; K is not among them, as rises in K are rises in degC."""
_THOUSANDS = r"\d{1,3}(?:['\u2019\s]\d{3})+(?:[.,]\d*)?|\d{1,3}(?:\.\d{3})+,\d*|\d{1,3}(?:,\d{3})+\.\d*"
_WITH_THOUSANDS = re.compile(rf"[+-]?(?:{_THOUSANDS}|\d{{1,3}}([.,])\d{{3}}(?:\1\d{{3}})+)")
"""A number with one mark before each three digits: twice, or beside the decimal mark."""
_CLEAR_UNIT = re.compile(r"[\[(][^\[\]()]*[\])]\s*$|°|℉|℃|deg|fahrenheit|celsius", re.IGNORECASE)
"""A temperature's name tells its unit so: `T_F` may be in front."""
TIMES = _OF_A_MAP["time"]
_OF_A_ROW = {
    "time": TIMES,
    "speed": (*RPM_PER_UNIT, "%"),
    "displacements": ("um", "mm", "nm", "in", "degC", "degF"),
    "temperatures": ("um", "mm", "degC", "degF"),
    "axis_positions": ("um", "in"),
}
_KEYS = {
    "time": "time_unit: {unit}",
    "speed": "speed_unit: {unit}",
    "displacements": "displacement_units: {{{name!r}: {unit}}}",
    "temperatures": "temperature_units: {{{name!r}: {unit}}}",
}


def has_thousands(text: str) -> bool:
    """Return whether a text is a number with marks that separate thousands, and with nothing else."""
    return _WITH_THOUSANDS.fullmatch(text) is not None


def unit_of(text: str) -> str | None:
    """Return the unit that a text is, with or without brackets around it; None where it is none of these."""
    bare = text.strip().strip("[](){}").strip().lower()
    return next((unit for unit, spelling in _UNITS.items() if spelling.fullmatch(bare)), None)


def unit_in(name: str) -> str | None:
    """Return the unit that the name of a column ends with, such as `Zeit [min]`, `t_min` or `dz (mm)`."""
    found = _AT_THE_END.search(name)
    return None if found is None else unit_of(found[1] or found[2])


def contradiction(kind: str, name: str, meant: str, row: str | None = None) -> str | None:
    """Return what to say where a column claims another unit than it is read in, by `row` or its name; else None."""
    found = unit_in(name) if row is None else unit_of(row)
    if row is None and kind == "temperatures" and _CLEAR_UNIT.search(name) is None:
        return None
    known = _OF_A_ROW if row is not None or kind == "speed" else _OF_A_MAP
    if found is None or found == meant or found not in known.get(kind, ()):
        return None
    by = "by its name" if row is None else "by the row of units"
    advice = f"convert it to {meant}, or take it out of the map"
    if found in _OF_A_MAP.get(kind, ()):
        advice = f"say {_KEYS[kind].format(name=name, unit=found)} in the map"
        if row is None:
            advice += f", or {_KEYS[kind].format(name=name, unit=meant)} where the name is wrong"
        else:
            advice += " (of one recording alone: convert its column)"
    return f"column {name!r} is in {found}, {by}, and is read in {meant}: {advice}"
