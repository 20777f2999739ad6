"""Fault scripts: what goes wrong on the simulated machine's wires, and when.

A script is a YAML list; every entry gives `kind` and `at_s`, and by kind `duration_s`, `target` and
`amount`:

    - {kind: noise, at_s: 600, duration_s: 60, target: spindle, amount: 0.02}
    - {kind: drifting_sensor, at_s: 900, target: 17, amount: 1.0}
    - {kind: frozen_cnc, at_s: 1200, duration_s: 30}
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields
from enum import StrEnum
from pathlib import Path
from typing import Any

import yaml

from config.schema import Configuration


class FaultKind(StrEnum):
    """What goes wrong."""

    NOISE = "noise"
    """Bits of a line's bytes flip; amount: share of the bytes hit."""
    LOST_BYTES = "lost_bytes"
    """Bytes of a line vanish; amount: share of the bytes lost."""
    DEAD_LINE = "dead_line"
    """A line breaks behind chain position `amount`: only positions 1..amount still send (0: none)."""
    STUCK_SENSOR = "stuck_sensor"
    """A sensor repeats what it read when the fault began."""
    DRIFTING_SENSOR = "drifting_sensor"
    """A sensor drifts by `amount` [degC/h]."""
    FLIPPED_BIT = "flipped_bit"
    """A bit of a sensor's value is flipped on the way, and the frame keeps its form; amount: which bit."""
    RENUMBERED = "renumbered"
    """The node at chain position `amount` is gone and those behind it have moved up by one ID."""
    RESET_BURST = "reset_burst"
    """All nodes of a line, or one sensor's, have been reset: TMP102 registers read 0."""
    UNPLUGGED = "unplugged"
    """A line's adapter is pulled out: its port vanishes."""
    FROZEN_CNC = "frozen_cnc"
    """The CNC's server answers nothing, though connections stay open."""
    KILLED_CNC = "killed_cnc"
    """The CNC's server closes all connections and refuses new ones."""
    CSV_TRUNCATED = "csv_truncated"
    """The displacement file is cut to `amount` bytes (0: it begins again with its header)."""
    CSV_ROTATED = "csv_rotated"
    """The displacement file is moved away and a new one begun."""
    CSV_HALF_ROW = "csv_half_row"
    """The next row is written in two halves, `duration_s` apart."""


class Target(StrEnum):
    """What a fault's `target` names."""

    NOTHING = "nothing"
    LINE = "line"
    SENSOR = "sensor"
    LINE_OR_SENSOR = "line or sensor"


@dataclass(frozen=True, slots=True, kw_only=True)
class _Rule:
    target: Target
    amount: str | None = None
    """Meaning of the amount; None: the kind has none."""
    default: float | None = None
    """Amount where the script gives none; None: it must."""
    bounds: tuple[float, float] = (-math.inf, math.inf)
    whole: bool = False
    lasting: bool = True
    """A moment has no duration."""


_SHARE = (1e-9, 1.0)
_POSITIVE = (1.0, math.inf)
_RULES = {
    FaultKind.NOISE: _Rule(target=Target.LINE, amount="share of bytes", default=0.01, bounds=_SHARE),
    FaultKind.LOST_BYTES: _Rule(target=Target.LINE, amount="share of bytes", default=0.05, bounds=_SHARE),
    FaultKind.DEAD_LINE: _Rule(
        target=Target.LINE, amount="chain position", default=0.0, bounds=(0.0, math.inf), whole=True
    ),
    FaultKind.STUCK_SENSOR: _Rule(target=Target.SENSOR),
    FaultKind.DRIFTING_SENSOR: _Rule(target=Target.SENSOR, amount="drift [degC/h]"),
    FaultKind.FLIPPED_BIT: _Rule(target=Target.SENSOR, amount="bit", bounds=(0.0, 11.0), whole=True),
    FaultKind.RENUMBERED: _Rule(target=Target.LINE, amount="chain position", default=1.0, bounds=_POSITIVE, whole=True),
    FaultKind.RESET_BURST: _Rule(target=Target.LINE_OR_SENSOR),
    FaultKind.UNPLUGGED: _Rule(target=Target.LINE),
    FaultKind.FROZEN_CNC: _Rule(target=Target.NOTHING),
    FaultKind.KILLED_CNC: _Rule(target=Target.NOTHING),
    FaultKind.CSV_TRUNCATED: _Rule(
        target=Target.NOTHING, amount="bytes", default=0.0, bounds=(0.0, math.inf), whole=True, lasting=False
    ),
    FaultKind.CSV_ROTATED: _Rule(target=Target.NOTHING, lasting=False),
    FaultKind.CSV_HALF_ROW: _Rule(target=Target.NOTHING),
}


class FaultScriptError(ValueError):
    """A fault script that cannot be played; the text names place, key and what is allowed."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Fault:
    """One thing that goes wrong."""

    kind: FaultKind
    at_s: float
    """Simulated seconds since the machine's start."""
    duration_s: float | None = None
    """None: until the end."""
    target: str | int | None = None
    """Name of a line or ID of a sensor."""
    amount: float = 0.0

    def active(self, now_s: float) -> bool:
        """Tell whether the fault is on at a simulated time [s]."""
        return self.at_s <= now_s and not self.over(now_s)

    def over(self, now_s: float) -> bool:
        """Tell whether the fault has ended by a simulated time [s]."""
        return self.duration_s is not None and now_s >= self.at_s + self.duration_s


def of_kind(faults: Iterable[Fault], *kinds: FaultKind) -> tuple[Fault, ...]:
    return tuple(sorted((fault for fault in faults if fault.kind in kinds), key=lambda fault: fault.at_s))


def load_faults(path: Path) -> tuple[Fault, ...]:
    """Read a fault script; raises FaultScriptError with file, line and key."""
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise FaultScriptError(f"{path}: cannot be read: {error}") from error
    return parse_faults(text, str(path))


def parse_faults(text: str, name: str = "faults") -> tuple[Fault, ...]:
    """Read a fault script from text; raises FaultScriptError with name, line and key."""
    try:
        root = yaml.compose(text, Loader=yaml.SafeLoader)
    except yaml.YAMLError as error:
        raise FaultScriptError(f"{name}: not YAML: {error}") from error
    if root is None:
        return ()
    if not isinstance(root, yaml.SequenceNode):
        raise FaultScriptError(f"{_place(name, root)}: a fault script is a list of faults")
    return tuple(_fault(name, node) for node in root.value)


def check_targets(faults: Sequence[Fault], configuration: Configuration) -> None:
    """Raise FaultScriptError for a line, sensor or position that the machine does not have."""
    lines = {line.name: len(line.sensor_ids) for line in configuration.temperatures.lines}
    sensors = set(configuration.temperatures.sensor_ids)
    displacements = configuration.displacements
    for fault in faults:
        place = f"fault {fault.kind} at {fault.at_s:g} s"
        if isinstance(fault.target, str):
            if fault.target not in lines:
                raise FaultScriptError(f"{place}: no line is called {fault.target!r}; there are {', '.join(lines)}")
            if fault.kind is FaultKind.RENUMBERED and fault.amount > lines[fault.target]:
                raise FaultScriptError(f"{place}: line {fault.target} has {lines[fault.target]} chain positions only")
        elif fault.target is not None and fault.target not in sensors:
            raise FaultScriptError(f"{place}: there is no sensor {fault.target}")
        if fault.kind.startswith("csv_") and (displacements is None or displacements.file is None):
            raise FaultScriptError(f"{place}: the configuration has no displacement file")


def _fault(name: str, node: yaml.Node) -> Fault:
    if not isinstance(node, yaml.MappingNode):
        raise FaultScriptError(f"{_place(name, node)}: a fault is a mapping with kind, at_s, ...")
    known = {field.name for field in fields(Fault)}
    values: dict[str, Any] = {}
    places: dict[str, str] = {}
    for key_node, value_node in node.value:
        key, place = key_node.value, _place(name, key_node)
        if key not in known:
            raise FaultScriptError(f"{place}: unknown key {key!r}; known are {', '.join(sorted(known))}")
        if key in values:
            raise FaultScriptError(f"{place}: {key} is given twice")
        values[key] = _plain(value_node)
        places[key] = place
    place = _place(name, node)
    kind = _kind(places.get("kind", place), values.pop("kind", None))
    rule = _RULES[kind]
    fault = Fault(
        kind=kind,
        at_s=_number(places.get("at_s", place), "at_s", values.pop("at_s", None), (0.0, math.inf)),
        duration_s=_duration(places.get("duration_s", place), kind, values.pop("duration_s", None)),
        target=_target(places.get("target", place), kind, values.pop("target", None)),
        amount=_amount(places.get("amount", place), kind, rule, values.pop("amount", None)),
    )
    if kind is FaultKind.CSV_HALF_ROW and fault.duration_s is None:
        raise FaultScriptError(f"{place}: csv_half_row needs duration_s, the time until the second half")
    return fault


def _kind(place: str, value: object) -> FaultKind:
    try:
        return FaultKind(str(value))
    except ValueError:
        raise FaultScriptError(f"{place}: kind is {value!r}, not one of {', '.join(FaultKind)}") from None


def _number(place: str, key: str, value: object, bounds: tuple[float, float]) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise FaultScriptError(f"{place}: {key} must be a number, not {value!r}")
    if not bounds[0] <= value <= bounds[1]:
        raise FaultScriptError(f"{place}: {key} is {value:g}, outside {bounds[0]:g}..{bounds[1]:g}")
    return float(value)


def _duration(place: str, kind: FaultKind, value: object) -> float | None:
    if value is None:
        return None
    if not _RULES[kind].lasting:
        raise FaultScriptError(f"{place}: {kind} happens at one moment and has no duration_s")
    duration_s = _number(place, "duration_s", value, (0.0, math.inf))
    if duration_s == 0.0:
        raise FaultScriptError(f"{place}: duration_s must be positive")
    return duration_s


def _target(place: str, kind: FaultKind, value: object) -> str | int | None:
    wanted = _RULES[kind].target
    fits = {
        Target.NOTHING: value is None,
        Target.LINE: isinstance(value, str),
        Target.SENSOR: isinstance(value, int) and not isinstance(value, bool),
        Target.LINE_OR_SENSOR: isinstance(value, str | int) and not isinstance(value, bool),
    }[wanted]
    if not fits:
        text = {
            Target.NOTHING: "must not be given",
            Target.LINE: "must name a line",
            Target.SENSOR: "must be the ID of a sensor",
            Target.LINE_OR_SENSOR: "must name a line or be the ID of a sensor",
        }[wanted]
        raise FaultScriptError(f"{place}: target of {kind} {text}, got {value!r}")
    return value if isinstance(value, str | int) else None


def _amount(place: str, kind: FaultKind, rule: _Rule, value: object) -> float:
    if rule.amount is None:
        if value is not None:
            raise FaultScriptError(f"{place}: {kind} has no amount")
        return 0.0
    if value is None:
        if rule.default is None:
            raise FaultScriptError(f"{place}: {kind} needs an amount: {rule.amount}")
        return rule.default
    amount = _number(place, f"amount ({rule.amount})", value, rule.bounds)
    if rule.whole and amount != int(amount):
        raise FaultScriptError(f"{place}: amount ({rule.amount}) must be a whole number, not {value!r}")
    return amount


def _plain(node: yaml.Node) -> object:
    """Return a scalar's value; anything else stays a node and fails the type checks."""
    if not isinstance(node, yaml.ScalarNode):
        return node
    return yaml.safe_load(yaml.serialize(node))


def _place(name: str, node: yaml.Node) -> str:
    return f"{name}:{node.start_mark.line + 1}:{node.start_mark.column + 1}"
