"""Text from outside as it may be stored, logged and shown: no control characters, nothing that cannot be encoded."""

from typing import Any


def printable(text: str, *, keep: str = "") -> str:
    r"""Return a text in which every character that is not printable is written as its escape (\x1b, \ud800).

    Control characters would act on the terminal of whoever reads the text, and half a surrogate pair can neither
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
