"""Sensors that share a description: `id: 5-24` stands for twenty sensors, 5, 6 .. 24."""

import re
from typing import Any

from config.schema.temperatures import LONGEST_CHAIN, expand_ranges
from config.yaml_document import Fault, KeyPath, Position, YamlDocument

SENSORS: KeyPath = ("temperatures", "sensors")
_RANGE = re.compile(r"[0-9]+-[0-9]+")


def expand_sensor_ranges(document: YamlDocument) -> None:
    """Put a sensor for each number in the place of one with a range; each keeps the position of where it is written."""
    section = document.value.get(SENSORS[0]) if isinstance(document.value, dict) else None
    entries = section.get(SENSORS[1]) if isinstance(section, dict) else None
    if not isinstance(section, dict) or not isinstance(entries, list):
        return
    sensors: list[Any] = []
    written_at: list[int] = []
    for index, entry in enumerate(entries):
        expanded = _expanded(document, index, entry)
        sensors += expanded
        written_at += [index] * len(expanded)
    if len(sensors) > len(entries):
        section[SENSORS[1]] = sensors
        for places in (document.keys, document.values):
            _renumber(places, written_at)


def _expanded(document: YamlDocument, index: int, entry: Any) -> list[Any]:
    given = entry.get("id") if isinstance(entry, dict) else None
    if not isinstance(given, str) or not _RANGE.fullmatch(given):
        return [entry]
    try:
        numbers = expand_ranges([given])
        if len(numbers) > LONGEST_CHAIN:
            raise ValueError(f"the range {given} holds more than the {LONGEST_CHAIN} sensors of a line")
        return [{**entry, "id": number} for number in numbers]
    except ValueError as error:
        path = (*SENSORS, index, "id")
        document.faults.append(Fault(document.values[path], path, str(error)))
        return [entry]


def _renumber(places: dict[KeyPath, Position], written_at: list[int]) -> None:
    depth = len(SENSORS)
    old: dict[Any, dict[KeyPath, Position]] = {}
    for path in [path for path in places if path[:depth] == SENSORS and len(path) > depth]:
        old.setdefault(path[depth], {})[path[depth + 1 :]] = places.pop(path)
    for index, origin in enumerate(written_at):
        for rest, position in old.get(origin, {}).items():
            places[(*SENSORS, index, *rest)] = position
