"""Keys of the configuration that the version before called something else: they still work, with a warning."""

from collections.abc import Mapping
from typing import Any

from config.yaml_document import Fault, KeyPath, Position, YamlDocument

RENAMED: Mapping[str, str] = {
    "cnc.opcua.allow_insecure_writes": "cnc.allow_insecure_writes",
    "cnc.guard.look_ahead_s": "cnc.guard.max_validity_s",
    "spindle_speed.within_percent": "spindle_speed.max_change_percent",
    "spindle_speed.second_look": "spindle_speed.verify_with_sdm",
}
"""Old dotted key -> new one, through sections only; an entry stays for one version."""


def move_renamed_keys(document: YamlDocument, renamed: Mapping[str, str]) -> list[Fault]:
    """Move what stands under old keys to the new ones, positions too; return a warning for each.

    Where both are given, the old one becomes a fault of the document.
    """
    warnings: list[Fault] = []
    for old_key, new_key in renamed.items():
        old, new = tuple(old_key.split(".")), tuple(new_key.split("."))
        old_section, new_section = _section(document.value, old[:-1]), _section(document.value, new[:-1])
        if old_section is None or old[-1] not in old_section or new_section is None:
            continue
        position = document.keys[old]
        value = old_section.pop(old[-1])
        if new[-1] in new_section:
            sentence = f"the old name of `{new_key}`, which stands in line {document.keys[new][0]} too: remove this one"
            document.faults.append(Fault(position, old, sentence))
            continue
        new_section[new[-1]] = value
        for places in (document.keys, document.values):
            _move(places, old, new)
        warnings.append(Fault(position, old, f"write `{new_key}`; the old name works in this version only"))
    return warnings


def _section(value: Any, path: KeyPath) -> dict[str, Any] | None:
    """Return the mapping at a path, None where there is none."""
    for step in path:
        value = value.get(step) if isinstance(value, dict) else None
    return value if isinstance(value, dict) else None


def _move(places: dict[KeyPath, Position], old: KeyPath, new: KeyPath) -> None:
    for path in [path for path in places if path[: len(old)] == old]:
        places[(*new, *path[len(old) :])] = places.pop(path)
