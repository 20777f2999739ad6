"""What is said of a file that the schema refuses: where it stands, and what belongs there in a person's words."""

import difflib
import re
from collections.abc import Iterable
from typing import Any

from pydantic import BaseModel, ValidationError

from config.knobs import FORMS, knob_at, section_at
from config.schema.base import KeyProblems
from config.yaml_document import KeyPath, Position, YamlDocument
from config.yaml_refusals import described

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


def refusals(
    error: ValidationError, document: YamlDocument, model: type[BaseModel]
) -> list[tuple[Position, KeyPath, str]]:
    """Return position, key and sentence for everything the schema refused."""
    by_path: dict[KeyPath, list[Any]] = {}
    found: list[tuple[Position, KeyPath, str]] = []
    for detail in error.errors(include_url=False):
        path = _path_in_file(detail["loc"], document.value, detail["type"])
        cause = detail.get("ctx", {}).get("error")
        if isinstance(cause, KeyProblems):
            for below, sentence in cause.problems:
                full = (*path, *below)
                found.append((_nearest(document, full), full, sentence))
        else:
            by_path.setdefault(path, []).append(detail)
    for path, details in by_path.items():
        found.append((_place(document, path, details[0]), path, _sentence(details, path, model)))
    return found


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
    first = details[0]
    if first["type"] == "missing":
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
    hidden = isinstance(first["input"], str) and _beside_a_secret(model, path)
    found = "a text, which is not shown beside a password" if hidden else described(first["input"])
    return f"{subject} must be {' or '.join(str(each) for each in expected)}, not {found}{hint}"


def _beside_a_secret(model: type[BaseModel], path: KeyPath) -> bool:
    """Say whether a key stands where a password or key is named, which may have been typed in its place."""
    section = section_at(model, path[:-1])
    return section is not None and any(re.search("passw|secret|token|_key", name) for name in section.model_fields)


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
    parent = section_at(model, path[:-1])
    known = list(parent.model_fields) if parent else []
    close = difflib.get_close_matches(str(path[-1]), known, n=1, cutoff=0.5)
    if close:
        return f"unknown key; did you mean `{close[0]}`?"
    return f"unknown key; known here: {', '.join(known)}" if known else "unknown key"
