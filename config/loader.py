"""Configuration files: read, checked against the schema, every error with file, line, column and key."""

import json
import re
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError

from config.schema import Configuration
from config.schema.base import ConfigurationError, Problem, Section
from config.schema.cnc import CHECK_MISSING
from config.schema.temperatures import LONGEST_CHAIN, expand_ranges
from config.yaml_document import RENAMED, Fault, KeyPath, Position, YamlDocument, move_renamed_keys, read_yaml

Model = TypeVar("Model", bound=BaseModel)

MAX_FILE_BYTES = 1 << 20
"""More than any description needs; a file of this size takes two seconds to read."""

_SENSORS: KeyPath = ("temperatures", "sensors")
_RANGE = re.compile(r"[0-9]+-[0-9]+")


def load_configuration(path: Path) -> Configuration:
    """Return the daemon's configuration, its relative paths from the file's folder; raises ConfigurationError."""
    return load_with_warnings(path)[0]


def load_with_warnings(path: Path) -> tuple[Configuration, tuple[Problem, ...]]:
    """Return the daemon's configuration, and which of its keys have a new name; raises ConfigurationError."""
    configuration, warnings = _parsed(_read_text(path), Configuration, str(path))
    return with_absolute_paths(configuration, path.resolve().parent), warnings


def load_yaml_model(path: Path, model: type[Model]) -> Model:
    """Return a YAML file as an instance of `model`, paths as they are written; raises ConfigurationError."""
    return parse_yaml_model(_read_text(path), model, str(path))


def parse_yaml_model(text: str, model: type[Model], file: str) -> Model:
    """Return YAML text as an instance of `model`; `file` names the text in errors. Raises ConfigurationError."""
    return _parsed(text, model, file)[0]


def _parsed(text: str, model: type[Model], file: str) -> tuple[Model, tuple[Problem, ...]]:
    """Return YAML text as an instance of `model`, and a warning for every key that has a new name."""
    document = read_yaml(text)
    renamed = move_renamed_keys(document, RENAMED if issubclass(model, Configuration) else {})
    if issubclass(model, Configuration):
        _expand_sensor_ranges(document)
    problems = [_problem(file, fault.position, fault.path, fault.sentence) for fault in document.faults]
    if not problems and document.value is None:
        problems.append(_problem(file, (1, 1), (), f"the file is empty; {_beginning(model)}"))
    elif not problems and not isinstance(document.value, dict):
        from config.yaml_refusals import described  # noqa: PLC0415

        problems.append(_problem(file, (1, 1), (), f"must be keys with values, not {described(document.value)}"))
    if problems and not isinstance(document.value, dict):
        raise ConfigurationError(problems)
    try:
        instance = model.model_validate_json(json.dumps(document.value))
    except ValidationError as error:
        from config.schema_refusals import refusals  # noqa: PLC0415 (only what is wrong with a file needs it)

        refused = refusals(error, document, model)
        complained = {fault.path for fault in document.faults if fault.path} | {f.position for f in document.faults}
        problems += [_problem(file, *refusal) for refusal in refused if not complained & {refusal[0], refusal[1]}]
        raise ConfigurationError(problems) from None
    if problems:
        raise ConfigurationError(problems)
    if isinstance(instance, Configuration) and instance.cnc.macros.check is None:
        at = ("cnc", "macros")
        renamed.append(Fault(document.keys[at], (*at, "check"), CHECK_MISSING))
    return instance, tuple(_problem(file, warning.position, warning.path, warning.sentence) for warning in renamed)


def _beginning(model: type[BaseModel]) -> str:
    """Return what to do about an empty file."""
    if issubclass(model, Configuration):
        return "`toolpoint sample-config` prints a beginning"
    return f"it needs {', '.join(name for name, field in model.model_fields.items() if field.is_required())}"


def with_absolute_paths(section: Model, folder: Path) -> Model:
    """Return a copy of a section in which every relative path starts at `folder`, and shipped names are found."""
    shipped = section.shipped if isinstance(section, Section) else {}
    return section.model_copy(
        update={
            name: _absolute(getattr(section, name), folder, shipped.get(name)) for name in type(section).model_fields
        }
    )


def _absolute(value: Any, folder: Path, shipped: str | None = None) -> Any:
    if isinstance(value, Path):
        return _found(value, folder, shipped)
    if isinstance(value, BaseModel):
        return with_absolute_paths(value, folder)
    if isinstance(value, list):
        return [_absolute(item, folder, shipped) for item in value]
    if isinstance(value, dict):
        return {name: _absolute(item, folder, shipped) for name, item in value.items()}
    return value


def _found(path: Path, folder: Path, shipped: str | None) -> Path:
    """Return a path from `folder`; a bare name that is no file there may be one of a shipped file."""
    beside = folder / path
    if shipped is not None and path.parent == Path() and not beside.exists():
        ours = Path(__file__).parent / shipped / f"{path.name}.yaml"
        if ours.is_file():
            return ours
    return beside


def _read_text(path: Path) -> str:
    try:
        with path.open("rb") as file:
            content = file.read(MAX_FILE_BYTES + 1)
    except OSError as error:
        sentence = f"cannot be read: {error.strerror or error}; check the path and its permissions"
        raise ConfigurationError([_problem(str(path), (0, 0), (), sentence)]) from None
    if len(content) > MAX_FILE_BYTES:
        sentence = f"is larger than {MAX_FILE_BYTES >> 20} MiB, more than any description needs; is it the right file?"
        raise ConfigurationError([_problem(str(path), (0, 0), (), sentence)])
    try:
        return content.decode("utf-8")
    except UnicodeDecodeError as error:
        before = content[: error.start]
        line = before.count(b"\n") + 1
        column = len(before[before.rfind(b"\n") + 1 :].decode("utf-8")) + 1
        sentence = f"the byte 0x{content[error.start]:02X} is not UTF-8; save the file as UTF-8"
        raise ConfigurationError([_problem(str(path), (line, column), (), sentence)]) from None


def _problem(file: str, position: Position, path: KeyPath, sentence: str) -> Problem:
    from config.yaml_refusals import without_credentials as hide  # noqa: PLC0415

    return Problem(file=file, line=position[0], column=position[1], key=hide(key_text(path)), sentence=hide(sentence))


def key_text(path: KeyPath) -> str:
    """Return a path as people write it: `temperatures.lines[0].port`."""
    text = ""
    for step in path:
        text += f"[{step}]" if isinstance(step, int) else f".{step}" if text else step
    return text


def _expand_sensor_ranges(document: YamlDocument) -> None:
    """Put a sensor for each number in the place of one with a range; each keeps the position of where it is written."""
    section = document.value.get(_SENSORS[0]) if isinstance(document.value, dict) else None
    entries = section.get(_SENSORS[1]) if isinstance(section, dict) else None
    if not isinstance(section, dict) or not isinstance(entries, list):
        return
    sensors: list[Any] = []
    written_at: list[int] = []
    for index, entry in enumerate(entries):
        expanded = _expanded(document, index, entry)
        sensors += expanded
        written_at += [index] * len(expanded)
    if len(sensors) > len(entries):
        section[_SENSORS[1]] = sensors
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
        path = (*_SENSORS, index, "id")
        document.faults.append(Fault(document.values[path], path, str(error)))
        return [entry]


def _renumber(places: dict[KeyPath, Position], written_at: list[int]) -> None:
    depth = len(_SENSORS)
    old: dict[Any, dict[KeyPath, Position]] = {}
    for path in [path for path in places if path[:depth] == _SENSORS and len(path) > depth]:
        old.setdefault(path[depth], {})[path[depth + 1 :]] = places.pop(path)
    for index, origin in enumerate(written_at):
        for rest, position in old.get(origin, {}).items():
            places[(*_SENSORS, index, *rest)] = position


__all__ = ["ConfigurationError"]
