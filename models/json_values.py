"""Values and text as they may be stored, sent, logged and shown: no NaN, no number of NumPy, no control characters."""

import math
import re
from collections.abc import Mapping
from typing import Any, overload

_NUMBER = re.compile(r"[+-]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][+-]?[0-9]+)?")


def finite_or_none(value: float | None, decimals: int | None = None) -> float | None:
    """Return a number, rounded where decimals are given; None for NaN, infinity and None."""
    if value is None or not math.isfinite(value):
        return None
    return float(value) if decimals is None else round(float(value), decimals)


@overload
def plain(value: Mapping[str, Any]) -> dict[str, Any]: ...
@overload
def plain(value: Any) -> Any: ...
def plain(value: Any) -> Any:
    """Return nested mappings, sequences, arrays and numbers as JSON can carry them; NaN and infinity as None."""
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if isinstance(value, float):
        return finite_or_none(value)
    return plain(value.tolist()) if hasattr(value, "tolist") else value


def printable(text: str, *, keep: str = "") -> str:
    r"""Return a text in which every character that is not printable is written as its escape (\x1b, \ud800).

    Control characters would act on the terminal on which the text is read, and half a surrogate pair can neither
    be stored nor printed. Characters in `keep` stay as they are.
    """
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() or c in keep else c.encode("unicode_escape").decode("ascii") for c in text)


def all_printable(value: Any, *, keep: str = "") -> Any:
    """Return a JSON value with every text in it printable, keys included."""
    if isinstance(value, str):
        return printable(value, keep=keep)
    if isinstance(value, dict):
        return {all_printable(key, keep=keep): all_printable(item, keep=keep) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [all_printable(item, keep=keep) for item in value]
    return value


def number_in(value: Any) -> Any:
    """Return the number that a text is, whole, with a decimal point and without a unit; anything else as it is.

    Devices write blanks around it, and fill a field of fixed length with zeros.
    """
    text = value.strip(" \t\r\n\0") if isinstance(value, str) else ""
    return float(text) if _NUMBER.fullmatch(text) else value
