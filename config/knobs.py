"""Lists the keys of the schema, for the sample, the reference page and the loader's messages."""

import re
import types
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from annotated_types import Ge, Gt, Le, Len, Lt, MaxLen, MinLen
from pydantic import BaseModel, IPvAnyAddress
from pydantic.fields import FieldInfo
from pydantic_core import PydanticUndefined

from config.schema.base import (
    AGENT_PATTERN,
    AXIS_PATTERN,
    CHANNEL_PATTERN,
    ENDPOINT_PATTERN,
    FOLDER_OR_BUCKET_PATTERN,
    HOST_PATTERN,
    MAIL_ADDRESS_PATTERN,
    NAME_PATTERN,
    NUMBER_OR_RANGE_PATTERN,
    RANGE_PATTERN,
    READ_AHEAD_STOP_PATTERN,
    SERVER_PATTERN,
    TOPIC_LEVEL_PATTERN,
    TOPIC_PATTERN,
    WEBHOOK_PATTERN,
)


class Shape(StrEnum):
    """What stands behind a key."""

    VALUE = "value"
    VALUES = "list of values"
    MAPPING = "mapping of values"
    SECTION = "section"
    SECTIONS = "list of sections"
    NAMED_SECTIONS = "mapping of sections"


@dataclass(frozen=True, slots=True, kw_only=True)
class Knob:
    """One key of the configuration."""

    name: str
    description: str
    shape: Shape
    section: type[BaseModel] | None
    """The section behind the key, or behind each of its items."""
    required: bool
    default: Any
    """The default, None when there is none."""
    optional: bool
    """The key may be left out to say that there is no such thing."""
    kind: str
    """Type in words."""
    bounds: str
    """Bounds in words, empty without any."""
    examples: tuple[Any, ...]


FORMS = {
    NAME_PATTERN: "letters from A to Z, digits and underscores, a letter first",
    AXIS_PATTERN: "the letter of an axis, such as Z, or a letter and a digit",
    CHANNEL_PATTERN: "text on one line, without a blank at either end",
    RANGE_PATTERN: "a range such as 7-12",
    NUMBER_OR_RANGE_PATTERN: "a number or a range, such as 120 or 500-549",
    READ_AHEAD_STOP_PATTERN: "G53, or an M code such as M150",
    TOPIC_PATTERN: "a topic without the wildcards + and #",
    TOPIC_LEVEL_PATTERN: "one level of a topic, without / + #",
    AGENT_PATTERN: "an address such as http://192.0.2.10:5000",
    HOST_PATTERN: "a name or an address, without a port, brackets and blanks",
    SERVER_PATTERN: "a name or an address, without a port, brackets and blanks, or the folder of a socket from /",
    WEBHOOK_PATTERN: "an address such as https://chat.plant.example/hooks/42, without blanks, and no @ in its host",
    MAIL_ADDRESS_PATTERN: "an address such as maintenance@plant.example, of ASCII characters",
    FOLDER_OR_BUCKET_PATTERN: "a folder from / such as /srv/plant/history, or s3://plant/history",
    ENDPOINT_PATTERN: "an address such as opc.tcp://192.0.2.10:4840/path",
}
"""What the patterns ask for, in words."""

_KINDS: dict[Any, str] = {str: "text", int: "whole number", float: "number", bool: "true or false", Path: "path"}
_KINDS[IPvAnyAddress] = "IP address"
_UNIONS = (Union, types.UnionType)


def knobs(section: type[BaseModel]) -> tuple[Knob, ...]:
    """Return the keys of a section in the order of the schema."""
    return tuple(_knob(name, field) for name, field in section.model_fields.items())


def section_at(section: type[BaseModel], path: tuple[str | int, ...]) -> type[BaseModel] | None:
    """Return the section that a path of keys and list indices leads to, None when it leads elsewhere."""
    current = section
    rest = list(path)
    while rest:
        step = rest.pop(0)
        field = current.model_fields.get(step) if isinstance(step, str) else None
        if field is None:
            return None
        knob = _knob(str(step), field)
        if knob.section is None:
            return None
        if knob.shape is not Shape.SECTION:
            if not rest:
                return None
            rest.pop(0)
        current = knob.section
    return current


def knob_at(section: type[BaseModel], path: tuple[str | int, ...]) -> Knob | None:
    """Return the knob that a path names, None when the path ends in a list item or a free name."""
    if not path or not isinstance(path[-1], str):
        return None
    parent = section_at(section, path[:-1])
    field = parent.model_fields.get(path[-1]) if parent else None
    return _knob(path[-1], field) if field else None


def _knob(name: str, field: FieldInfo) -> Knob:
    annotation, optional = _without_none(field.annotation)
    shape, section = _shape(annotation)
    default = None if field.is_required() else field.get_default(call_default_factory=True)
    return Knob(
        name=name,
        description=field.description or "",
        shape=shape,
        section=section,
        required=field.is_required(),
        default=None if default is PydanticUndefined else default,
        optional=optional,
        kind=_kind(annotation),
        bounds=_bounds([*_metadata(field.annotation), *field.metadata]),
        examples=tuple(field.examples or ()),
    )


def _without_none(annotation: Any) -> tuple[Any, bool]:
    """Return the annotation without None and whether None was in it."""
    if get_origin(annotation) in _UNIONS:
        arms = [arm for arm in get_args(annotation) if arm is not type(None)]
        if len(arms) < len(get_args(annotation)):
            return (arms[0] if len(arms) == 1 else Union[tuple(arms)]), True  # noqa: UP007 - built at run time
    return annotation, False


def _plain(annotation: Any) -> Any:
    return get_args(annotation)[0] if get_origin(annotation) is Annotated else annotation


def _metadata(annotation: Any) -> list[Any]:
    """Return the constraints that stand in the annotation itself."""
    bare, _ = _without_none(annotation)
    return list(get_args(bare)[1:]) if get_origin(bare) is Annotated else []


def _as_section(annotation: Any) -> type[BaseModel] | None:
    plain = _plain(annotation)
    return plain if isinstance(plain, type) and issubclass(plain, BaseModel) else None


def _shape(annotation: Any) -> tuple[Shape, type[BaseModel] | None]:
    plain = _plain(annotation)
    if section := _as_section(plain):
        return Shape.SECTION, section
    if get_origin(plain) in (list, tuple):
        section = _as_section(get_args(plain)[0])
        return (Shape.SECTIONS if section else Shape.VALUES), section
    if get_origin(plain) is dict:
        section = _as_section(get_args(plain)[1])
        return (Shape.NAMED_SECTIONS if section else Shape.MAPPING), section
    return Shape.VALUE, None


def _kind(annotation: Any) -> str:
    plain = _plain(annotation)
    origin, arguments = get_origin(plain), get_args(plain)
    if origin is Literal:
        choices = ", ".join(_quote(choice) for choice in arguments)
        return f"one of {choices}" if len(arguments) > 1 else f"only {choices}"
    if origin in _UNIONS:
        return " or ".join(_kind(arm) for arm in arguments if arm is not type(None))
    if origin in (list, tuple):
        return f"list of {_kind(arguments[0])}"
    if origin is dict:
        return f"mapping of name to {_kind(arguments[1])}"
    if _as_section(plain):
        return "section"
    return _KINDS.get(plain, getattr(plain, "__name__", str(plain)))


def _quote(choice: Any) -> str:
    text = str(choice).replace("\t", "\\t")
    return text if re.fullmatch(r"[\w-]+", text) else f'"{text}"'


def _bounds(metadata: list[Any]) -> str:
    words: list[str] = []
    for item in metadata:
        found: Any = None
        for kind, word in _BOUND_WORDS.items():
            if isinstance(item, kind):
                found = getattr(item, kind.__name__.lower())
                words.append(f"{word} {found:.8g}")
        if isinstance(item, MinLen | Len) and item.min_length:
            words.append("not empty" if item.min_length == 1 else f"at least {item.min_length}")
        if isinstance(item, MaxLen | Len) and item.max_length is not None:
            words.append(f"at most {item.max_length} long")
        if pattern := getattr(item, "pattern", None):
            words.append(FORMS.get(pattern, f"matches {pattern}"))
        if isinstance(item, FieldInfo):
            words.extend(filter(None, [_bounds(list(item.metadata))]))
    return ", ".join(words)


_BOUND_WORDS: dict[Any, str] = {Gt: "above", Ge: "at least", Lt: "below", Le: "at most"}
