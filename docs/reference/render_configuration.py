"""The reference page of all configuration keys, made from the schema by `make docs`."""

from pathlib import Path
from typing import Any

from pydantic import BaseModel

from config.knobs import Knob, Shape, knobs
from config.schema import Configuration

HEAD = """\
# Configuration keys

<!-- Made from the schema by `make docs`; edit the descriptions in config/schema/, not here. -->

The daemon reads one YAML file. [Configure the daemon](../how-to/configure.md) shows how to write
one; `toolpoint sample-config` prints one with every key; `toolpoint config-schema` prints the
schema as JSON Schema for editors. This page lists every key.

- Unknown keys, keys that stand twice, and values of another type are refused. Every refusal names
  file, line, column and key; all of them are shown at once.
- Units stand in the names: `_s` seconds, `_um` micrometres, `_mm` millimetres, `_degc` degrees
  Celsius, `_days` days, `_um_per_min` micrometres per minute.
- `yes`, `no`, `on`, `off`, numbers with a leading zero, underscore, colon or base prefix, NaN,
  infinity and tags are refused, because YAML readers do not agree on them. `1e-6` is a number.
  Dates are text. Anchors, aliases and merge keys (`<<`) work.
- Relative paths start at the folder of the configuration file.
- In the tables `[]` stands for an item of a list and `<name>` for a name that you choose.
"""


def configuration_reference() -> str:
    """Return the reference page in Markdown."""
    lines = HEAD.splitlines()
    _append(lines, Configuration, "")
    return "\n".join(lines) + "\n"


def section_tables(section: type[BaseModel]) -> list[str]:
    """Return the lines of the tables of a section and of those below it, for a file of its own."""
    lines: list[str] = []
    _append(lines, section, "")
    return lines


def _append(lines: list[str], section: type[BaseModel], path: str) -> None:
    """Append the table of a section, then those of the sections below it."""
    summary = (section.__doc__ or "").strip().splitlines()[0]
    lines += ["", f"## `{path}`" if path else "## Top level", "", _escaped(summary), ""]
    lines += ["| key | type | default | meaning |", "|---|---|---|---|"]
    listed = knobs(section)
    lines += [_row(knob) for knob in listed]
    for knob in listed:
        if knob.section is not None:
            item = {Shape.SECTIONS: "[]", Shape.NAMED_SECTIONS: ".<name>"}.get(knob.shape, "")
            _append(lines, knob.section, f"{path}.{knob.name}{item}" if path else f"{knob.name}{item}")


def _row(knob: Knob) -> str:
    kind = str(knob.shape) if knob.section else ", ".join(filter(None, [knob.kind, knob.bounds]))
    cells = (f"`{knob.name}`", _escaped(kind), _default(knob), _escaped(knob.description))
    return f"| {' | '.join(cells)} |"


def _default(knob: Knob) -> str:
    if knob.required:
        return "**required**"
    if knob.default is None:
        return "not in use"
    if knob.section is not None:
        return "its defaults"
    return f"`{_escaped(_shown(knob.default))}`"


def _shown(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str | Path):
        return str(value) or '""'
    if isinstance(value, list):
        return "[" + ", ".join(_shown(item) for item in value) + "]"
    return str(value)


def _escaped(text: str) -> str:
    return text.replace("|", "\\|").replace("<", "&lt;").replace("*", "\\*")


if __name__ == "__main__":
    print(configuration_reference(), end="")
