"""Points and lengths of time, and lists of sensors, as people write them on a command line."""

import re
import time
from datetime import UTC, datetime

import click

from config.schema.temperatures import expand_ranges

_UNITS_S = {"s": 1.0, "m": 60.0, "min": 60.0, "h": 3600.0, "d": 86_400.0, "w": 604_800.0}
_DURATION = re.compile(r"(\d+(?:\.\d+)?)\s*(s|min|m|h|d|w)")
_SENSORS = re.compile(r"\d+(-\d+)?(,\d+(-\d+)?)*")


def duration_s(text: str) -> float | None:
    """Return '90s', '5m', '1.5h', '2d' or '1w' as seconds; None when it is none of these."""
    match = _DURATION.fullmatch(text.strip())
    return float(match[1]) * _UNITS_S[match[2]] if match else None


def duration(_context: click.Context, _parameter: click.Parameter, text: str) -> float:
    """Return a length of time [s]; a callback of click."""
    seconds = duration_s(text)
    if not seconds:
        raise click.BadParameter(f"{text!r} is no length of time; write 90s, 5m, 1h, 2d or 1w")
    return seconds


def moment(_context: click.Context, _parameter: click.Parameter, text: str) -> float:
    """Return a point in time [s since 1970]: ISO 8601 (UTC without an offset), 'now', or -24h; a callback of click."""
    if text == "now":
        return time.time()
    if text.startswith("-") and (seconds := duration_s(text[1:])) is not None:
        return time.time() - seconds
    try:
        parsed = datetime.fromisoformat(text)
    except ValueError:
        raise click.BadParameter(
            f"{text!r} is no time; write 2026-03-01T08:00, 2026-03-01T08:00+01:00, now, or -24h"
        ) from None
    return (parsed if parsed.tzinfo else parsed.replace(tzinfo=UTC)).timestamp()


def sensor_list(_context: click.Context, _parameter: click.Parameter, text: str | None) -> tuple[int, ...] | None:
    """Return sensor IDs such as 1-5,7, each once; a callback of click."""
    if text is None:
        return None
    compact = text.replace(" ", "")
    if not _SENSORS.fullmatch(compact):
        raise click.BadParameter(f"{text!r} is no list of sensors; write 1-5,7")
    try:
        ids = expand_ranges([part if "-" in part else int(part) for part in compact.split(",")])
    except ValueError as error:
        raise click.BadParameter(f"{text!r}: {error}") from error
    return tuple(dict.fromkeys(ids))


def iso(utc_s: float) -> str:
    """Return a point in time as ISO 8601 to the second, in UTC."""
    return datetime.fromtimestamp(utc_s, UTC).strftime("%Y-%m-%dT%H:%M:%SZ")
