"""Reads several recordings alike: one map for all, the same columns in the same order, or which of them differ."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import Any

from config.recordings.map_proposal import JAPANESE, MapProposal, propose_map
from config.recordings.recording_map import ColumnError, RecordingMap, matching_names, units_and_names, usual_map
from drivers.files.recording_csv import read_recording
from drivers.files.recording_lines import EncodingError, RecordingFileError, read_beginning
from models.recordings.dataset import DatasetError, Recording
from models.thermal.training.inputs import with_sensors

Progress = Callable[[str, int, int], None]
LOOKED_AT = 200
"""So many rows of a recording tell how its fields are written."""
ENCODINGS = ("utf-8", "utf-16", "cp932", "cp1252")
"""Tried one after the other; anything may be read as one of the last two, so cp932 has to show words."""
KINDS = ("temperatures", "axis_positions", "displacements")
MOST_NAMED = 12


def read_alike(
    paths: Sequence[Path], recording_map: RecordingMap | None, progress: Progress, *, common: bool = False
) -> list[Recording]:
    """Return recordings with the same, or only the `common`, columns in the same order; raises DatasetError."""
    if common:
        recording_map = common_map(paths, recording_map)
    else:
        _require_alike(paths, recording_map)
    recordings: list[Recording] = []
    for number, (path, name) in enumerate(zip(paths, names_of(paths), strict=True), start=1):
        recordings.append(_in_order(replace(read_recording(path, recording_map), name=name), recordings))
        progress("reading", number, len(paths))
    return recordings


def names_of(paths: Sequence[Path]) -> list[str]:
    """Return what recordings are called: each as its file, with so much of its folder as tells it from the others."""
    whole = [path.parts for path in paths]
    longest = max(map(len, whole), default=1)
    found = []
    for parts in whole:
        ends = (parts[-count:] for count in range(1, longest + 1))
        alone = (end for end in ends if sum(other[-len(end) :] == end for other in whole) == 1)
        found.append(str(Path(*next(alone, parts))))
    return found


def _in_order(recording: Recording, before: Sequence[Recording]) -> Recording:
    """Return a recording with its columns in the order of the first one; names tell them, not places."""
    if not before:
        return recording
    first = before[0]
    if set(first.temperature_names) == set(recording.temperature_names):
        recording = with_sensors(recording, first.temperature_names)
    if set(first.displacement_names) == set(recording.displacement_names):
        recording = recording.with_channels(first.displacement_names)
    return recording


def common_map(paths: Sequence[Path], recording_map: RecordingMap | None) -> RecordingMap:
    """Return the map of those columns that all recordings have; raises DatasetError where there are none of a kind."""
    one, found, headers = _columns(paths, recording_map)
    keys = one.model_dump(exclude_unset=True, exclude_none=True)
    for kind in KINDS:
        if kind not in keys:
            continue
        names = _shared([columns[kind] for columns in found])
        if not names and kind == "axis_positions":
            del keys[kind]
            continue
        if not names:
            raise DatasetError(
                f"{kind}: there is no column that all {len(paths)} recordings have; {_differing(paths, found, headers)}"
            )
        keys[kind] = names
    keys |= units_and_names(one, [*keys["temperatures"], *keys["displacements"]])
    if one.speed is not None and not all(columns["speed"] for columns in found):
        del keys["speed"]
    return RecordingMap.model_validate(keys)


def columns_left_out(paths: Sequence[Path], recording_map: RecordingMap | None) -> list[str]:
    _, found, _ = _columns(paths, recording_map)
    every = dict.fromkeys(name for columns in found for names in columns.values() for name in names)
    return [name for name in every if not all(name in chain(*columns.values()) for columns in found)]


def _require_alike(paths: Sequence[Path], recording_map: RecordingMap | None) -> None:
    if len(paths) < 2:
        return
    try:
        one, found, headers = _columns(paths, recording_map)
    except ColumnError:
        return  # the reader says which column of which file
    if all(
        {kind: set(names) for kind, names in columns.items()} == {k: set(v) for k, v in found[0].items()}
        for columns in found
    ):
        return
    offered = [
        f"{kind}: [{', '.join(map(_quoted, names))}]" for kind in KINDS if (names := _shared([c[kind] for c in found]))
    ]
    without = "; take `speed` out of the map" if one.speed and not all(c["speed"] for c in found) else ""
    raise DatasetError(
        f"the recordings have different columns: {_differing(paths, found, headers)}. Record all of them alike, or use "
        f"what all of them have: give --common-columns, or put this into the map{without}:\n  " + "\n  ".join(offered)
    )


def _columns(
    paths: Sequence[Path], recording_map: RecordingMap | None
) -> tuple[RecordingMap, list[dict[str, list[str]]], list[list[str]]]:
    """Return the map, and of each recording the names of the columns of each kind, and of all columns."""
    headers = [
        read_beginning(path, 0, "utf-8" if recording_map is None else recording_map.encoding)[0] for path in paths
    ]
    one = usual_map(headers[0]) if recording_map is None else recording_map
    return one, [matching_names(one, header) for header in headers], headers


def _shared(lists: Sequence[Sequence[str]]) -> list[str]:
    return [name for name in lists[0] if all(name in names for names in lists)]


def _differing(paths: Sequence[Path], found: Sequence[dict[str, list[str]]], headers: Sequence[Sequence[str]]) -> str:
    every = {name for columns in found for names in columns.values() for name in names}
    sentences = []
    for name, columns, header in zip(names_of(paths), found, headers, strict=True):
        held = {name for names in columns.values() for name in names}
        if lacking := sorted(every - held):
            rest = f" and {len(lacking) - MOST_NAMED} more" if len(lacking) > MOST_NAMED else ""
            own = [column for column in header if column and sum(column in other for other in headers) == 1]
            called = f" and alone has {', '.join(own[:MOST_NAMED])} (the same under another name?)" if own else ""
            sentences.append(f"{name} lacks {', '.join(lacking[:MOST_NAMED])}{rest}{called}")
    return "; ".join(sentences)


def _quoted(name: str) -> str:
    return f"'{name}'" if name.isalnum() else '"' + name.replace("\\", "\\\\").replace('"', '\\"') + '"'


def proposal(path: Path) -> tuple[MapProposal, list[str] | None]:
    """Return what the columns of a recording seem to be, and which of them are not read without a map (None: all)."""
    for encoding in ENCODINGS:
        try:
            header, rows = read_beginning(path, LOOKED_AT, encoding)
            if encoding != "cp932" or any(word in name for name in header for word in JAPANESE):
                break
        except EncodingError:
            if encoding == ENCODINGS[-1]:
                raise
    if not rows:
        raise RecordingFileError(f"{path}: holds no rows after its header")
    found = propose_map(header, rows, encoding)
    try:
        usual = usual_map(header)
        columns = {kind: names for kind, names in matching_names(usual, header).items() if kind in KINDS and names}
    except ColumnError:
        return found, None
    if found.keys.get("unit_row") or (usual.time_unit != "iso" and _is_of_text(found)):
        return found, None
    keys = usual.model_dump(exclude_unset=True, exclude_none=True) | columns
    unread = []
    for kind in ("speed", *KINDS):
        named = found.keys.get(kind) or []
        new = [name for name in ([named] if isinstance(named, str) else named) if name not in _all_of(keys)]
        if kind == "speed" and new and kind not in keys:
            keys |= {key: found.keys[key] for key in ("speed", "speed_unit") if key in found.keys}
        elif kind != "speed":
            keys |= {kind: [*keys.get(kind, ()), *new]} if new else {}
        unread += new
    said = ("temperature_units", "displacement_units", "missing", "encoding")
    keys |= {key: found.keys[key] for key in said if key in found.keys}
    return MapProposal(keys=keys, left_out=(), lacking=(), notes=()), unread


def _is_of_text(found: MapProposal) -> bool:
    """Return whether the times are dates or times of day, which no usual name but utc holds."""
    return "time_format" in found.keys or found.keys.get("time_unit") == "iso"


def _all_of(keys: Mapping[str, Any]) -> set[str]:
    """Return the columns that a map names."""
    return {keys["time"], keys.get("speed", ""), *(name for kind in KINDS for name in keys.get(kind, ()))}
