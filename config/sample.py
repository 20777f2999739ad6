"""A commented sample of the configuration, made from the schema alone."""

import textwrap
from pathlib import Path
from typing import Any

import yaml
from pydantic import BaseModel

from config.knobs import Knob, Shape, knobs
from config.schema import Configuration

WIDTH = 100
INDENT = "  "
HEAD = """\
Configuration of Toolpoint. It is valid as it stands; what it names is made up.

Every key is here. A key marked `required` must be given; the others show their defaults and may
be left out. A line that begins with `#` and no blank after it is a key that is not in use: remove
the `#` (of the whole block, if it is one). Unknown keys are refused. Units stand in the names.
Relative paths start at the folder of this file. `toolpoint check` reads a configuration, says
what is wrong with line and column, and asks the devices whether they are there."""


def sample_configuration() -> str:
    """Return a commented configuration in YAML that is valid as it stands."""
    lines = [f"# {line}".rstrip() for line in HEAD.splitlines()]
    return "\n".join([*lines, "", *_section(Configuration, {}, spaced=True)]) + "\n"


def _section(section: type[BaseModel], given: dict[str, Any], *, spaced: bool = False) -> list[str]:
    """Return the lines of a section, not indented; `given` holds values that an example wants."""
    lines: list[str] = []
    for knob in knobs(section):
        if spaced and lines:
            lines.append("")
        lines += _comment(knob)
        if _in_use(knob, given):
            lines += _entry(knob, given.get(knob.name))
        else:
            lines += [f"#{line}" for line in _entry(knob, None)]
    return lines


def _in_use(knob: Knob, given: dict[str, Any]) -> bool:
    return knob.required or knob.name in given or knob.default is not None


def _entry(knob: Knob, given: Any) -> list[str]:
    """Return the key with its value: what is given, else the default, else the schema's example."""
    example = knob.examples[0] if knob.examples else None
    if knob.section is None:
        value = next((value for value in (given, knob.default, example) if value is not None), None)
        return [f"{knob.name}: {_yaml(value)}"]
    if knob.shape is Shape.SECTION:
        return [f"{knob.name}:", *_indented(_section(knob.section, given or example or {}))]
    if knob.shape is Shape.SECTIONS:
        first, *rest = given or example or [{}]
        item = _section(knob.section, first)
        body = _bulleted(item) + [f"- {_yaml(other)}" for other in rest]
        return [f"{knob.name}:", *_indented(body)]
    names: dict[str, Any] = given or example or {}
    first_name, *other_names = names
    body = [f"{first_name}:", *_indented(_section(knob.section, names[first_name]))]
    body += [f"{name}: {_yaml(names[name])}" for name in other_names]
    return [f"{knob.name}:", *_indented(body)]


def _bulleted(item: list[str]) -> list[str]:
    """Return the lines of a list item: the dash before the first key, comments above it."""
    first_key = next(index for index, line in enumerate(item) if not line.startswith("#"))
    return [*item[:first_key], f"- {item[first_key]}", *_indented(item[first_key + 1 :])]


def _indented(lines: list[str]) -> list[str]:
    return [INDENT + line if line else line for line in lines]


def _comment(knob: Knob) -> list[str]:
    words = knob.description
    facts = "" if knob.section else ", ".join(filter(None, [knob.kind, knob.bounds]))
    if knob.required:
        facts = f"{facts}; required" if facts else "required"
    text = f"{words} ({facts})" if facts else words
    return [f"# {line}" for line in textwrap.wrap(text, WIDTH - 2, break_long_words=False, break_on_hyphens=False)]


def _yaml(value: Any) -> str:
    text = yaml.safe_dump(_plain(value), default_flow_style=True, width=10_000, sort_keys=False)
    return text.removesuffix("\n").removesuffix("\n...")


def _plain(value: Any) -> Any:
    return str(value) if isinstance(value, Path) else value


def configuration_json_schema() -> dict[str, Any]:
    """Return the configuration's JSON Schema (draft 2020-12)."""
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        **Configuration.model_json_schema(),
        "title": "Toolpoint configuration",
    }
