"""Configuration files: read, checked against the schema, every error with file, line, column and key."""

import difflib
import json
import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError

from config.schema import Configuration
from config.schema.base import FORMS, ConfigurationError, KeyProblems, Problem, Section
from config.schema.cnc import CHECK_MISSING
from config.schema.temperatures import LONGEST_CHAIN, expand_ranges
from config.yaml_document import RENAMED, Fault, KeyPath, Position, YamlDocument, move_renamed_keys, read_yaml

Model = TypeVar("Model", bound=BaseModel)

MAX_FILE_BYTES = 1 << 20
"""More than any description needs; a file of this size takes two seconds to read."""

_SENSORS: KeyPath = ("temperatures", "sensors")
_RANGE = re.compile(r"[0-9]+-[0-9]+")
_TYPES = {
    "string_type": "text",
    "path_type": "text that names a file",
    "int_type": "a whole number",
    "int_from_float": "a whole number",
    "float_type": "a number",
    "bool_type": "true or false",
    "list_type": "a list",
    "tuple_type": "a list",
    "dict_type": "a mapping (keys with values)",
    "model_type": "a section (keys with values)",
    "model_attributes_type": "a section (keys with values)",
}
_BOUNDS = {
    "greater_than": ("gt", "above"),
    "greater_than_equal": ("ge", "at least"),
    "less_than": ("lt", "below"),
    "less_than_equal": ("le", "at most"),
}


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
        refused = _refusals(error, document, model)
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


def _refusals(
    error: ValidationError, document: YamlDocument, model: type[BaseModel]
) -> list[tuple[Position, KeyPath, str]]:
    """Return position, key and sentence for everything the schema refused."""
    by_path: dict[KeyPath, list[Any]] = {}
    refusals: list[tuple[Position, KeyPath, str]] = []
    for detail in error.errors(include_url=False):
        path = _path_in_file(detail["loc"], document.value, detail["type"])
        cause = detail.get("ctx", {}).get("error")
        if isinstance(cause, KeyProblems):
            for below, sentence in cause.problems:
                full = (*path, *below)
                refusals.append((_nearest(document, full), full, sentence))
        else:
            by_path.setdefault(path, []).append(detail)
    for path, details in by_path.items():
        refusals.append((_place(document, path, details[0]), path, _sentence(details, path, model)))
    return refusals


def _path_in_file(location: Iterable[int | str], value: Any, kind: str) -> KeyPath:
    """Return pydantic's location without the steps that are no keys (arms of unions, `[key]`)."""
    steps = list(location)
    path: list[int | str] = []
    for index, step in enumerate(steps):
        last = index == len(steps) - 1
        if isinstance(value, dict) and isinstance(step, str) and (step in value or (last and kind == "missing")):
            value = value.get(step)
        elif isinstance(value, list) and isinstance(step, int) and step < len(value):
            value = value[step]
        else:
            continue
        path.append(step)
    return tuple(path)


def _nearest(document: YamlDocument, path: KeyPath) -> Position:
    """Return where the key stands, or the nearest key above it."""
    while path and path not in document.keys:
        path = path[:-1]
    return document.keys.get(path, (1, 1)) if path else (1, 1)


def _place(document: YamlDocument, path: KeyPath, detail: Any) -> Position:
    """Return the position that a refusal points at: the value if it is one, else the key."""
    if detail["type"] in ("missing", "extra_forbidden") or "[key]" in detail["loc"]:
        return _nearest(document, path)
    if isinstance(detail["input"], dict | list):
        return _nearest(document, path)
    return document.values.get(path) or _nearest(document, path)


def _sentence(details: list[Any], path: KeyPath, model: type[BaseModel]) -> str:
    """Return one sentence for all that was refused about one key."""
    from config.yaml_refusals import described  # noqa: PLC0415

    first = details[0]
    if first["type"] == "missing":
        from config.knobs import knob_at  # noqa: PLC0415 (only what is wrong with a file needs it)

        knob = knob_at(model, path)
        words = f": {knob.description}" if knob and knob.description else ""
        return f"this key is required and missing{words}"
    if first["type"] == "extra_forbidden":
        return _unknown_key(path, model)
    beyond_type = [detail for detail in details if detail["type"] not in _TYPES]
    expected = list(dict.fromkeys(_expected(detail) for detail in beyond_type or details))
    if any(each is None for each in expected):
        return "; ".join(str(detail["msg"]).removeprefix("Value error, ") for detail in beyond_type)
    subject = "the name" if "[key]" in first["loc"] else "this"
    comma = first["type"] == "float_type" and re.fullmatch(r"[-+]?\d+,\d+", str(given := first["input"]))
    hint = f": write it with a point, {given.replace(',', '.')}" if comma else ""
    return f"{subject} must be {' or '.join(str(each) for each in expected)}, not {described(first['input'])}{hint}"


def _expected(detail: Any) -> str | None:
    """Return what the schema wants there, None when its own message says it."""
    kind, context = detail["type"], detail.get("ctx", {})
    if kind in _TYPES:
        return _TYPES[kind]
    if kind in _BOUNDS:
        name, word = _BOUNDS[kind]
        return f"{word} {context[name]:.8g}"
    if kind == "literal_error":
        return f"one of {context['expected'].replace(' or ', ', ')}{_suggestion(detail['input'], context['expected'])}"
    if kind == "string_pattern_mismatch":
        return FORMS.get(context["pattern"], f"text of the form {context['pattern']}")
    if kind == "string_too_long":
        return f"at most {context['max_length']} characters long"
    if kind == "too_long":
        return f"at most {context['max_length']} long"
    if kind in ("too_short", "string_too_short"):
        return "filled in" if context["min_length"] == 1 else f"at least {context['min_length']} long"
    return None


def _suggestion(given: Any, expected: str) -> str:
    choices = expected.replace(" or ", ", ").replace("'", "").split(", ")
    close = difflib.get_close_matches(str(given), choices, n=1)
    return f" (did you mean '{close[0]}'?)" if close else ""


def _unknown_key(path: KeyPath, model: type[BaseModel]) -> str:
    from config.knobs import section_at  # noqa: PLC0415 (only what is wrong with a file needs it)

    parent = section_at(model, path[:-1])
    known = list(parent.model_fields) if parent else []
    close = difflib.get_close_matches(str(path[-1]), known, n=1, cutoff=0.5)
    if close:
        return f"unknown key; did you mean `{close[0]}`?"
    return f"unknown key; known here: {', '.join(known)}" if known else "unknown key"


__all__ = ["ConfigurationError"]


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
