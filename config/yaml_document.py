"""YAML text -> plain values with the position of every key and value.

A careful subset of YAML 1.1, so that nothing means something else than it seems to: `yes`, `no`, `on` and `off` are
refused as truth values, as are numbers with a leading zero, an underscore, a colon or a base, NaN, infinity and tags.
`1e-6` is a number. Dates are text. Keys are always text and may stand only once in a mapping.
"""

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import yaml

KeyPath = tuple[str | int, ...]
Position = tuple[int, int]

MAX_VALUES = 200_000
"""More values than any machine's description holds; aliases of aliases reach it quickly."""
MAX_NUMBER_LENGTH = 40
MAX_TEXT_LENGTH = 10_000
"""Characters of one key or value."""

_TRUTH = {"true": True, "True": True, "TRUE": True, "false": False, "False": False, "FALSE": False}
_NULL = {"", "~", "null", "Null", "NULL"}
_TRUTH_LIKE = re.compile(r"(?:yes|no|on|off)", re.IGNORECASE)
_INTEGER = re.compile(r"[-+]?(?:0|[1-9][0-9]*)")
_FLOAT = re.compile(r"[-+]?(?:\.[0-9]+|[0-9]+(?:\.[0-9]*)?)(?:[eE][-+]?[0-9]+)?")
_NOT_FINITE = re.compile(r"[-+]?\.(?:inf|nan)", re.IGNORECASE)
_SURPRISING_NUMBER = re.compile(
    r"[-+]?(?:0[0-9_]+|0[xX][0-9a-fA-F_]+|0[oO][0-7_]+|0[bB][01_]+|[0-9][0-9_]*_[0-9_]*(?:\.[0-9_]*)?"
    r"|[0-9]+(?::[0-5]?[0-9])+(?:\.[0-9]*)?)"
)
_NO_CHARACTER = re.compile("[\x00-\x08\x0b-\x1f\x7f\ud800-\udfff]")
_MERGE_TAG = "tag:yaml.org,2002:merge"


@dataclass(frozen=True, slots=True)
class Fault:
    """Something that the text says and this reader refuses."""

    position: Position
    path: KeyPath
    sentence: str


@dataclass(slots=True)
class YamlDocument:
    """The content of one YAML file and where everything in it stands (lines and columns from 1)."""

    value: Any = None
    keys: dict[KeyPath, Position] = field(default_factory=dict)
    """Where the key (or the list item) stands that a path names."""
    values: dict[KeyPath, Position] = field(default_factory=dict)
    faults: list[Fault] = field(default_factory=list)


def read_yaml(text: str) -> YamlDocument:
    """Return the content of a YAML text; what is wrong with it is in `faults`, never raised."""
    document = YamlDocument()
    try:
        loader = _TagWatchingLoader(text)
        root = loader.get_single_node()
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        position = (mark.line + 1, mark.column + 1) if mark else (1, 1)
        from config.yaml_refusals import sentence_of  # noqa: PLC0415

        document.faults.append(Fault(position, (), sentence_of(error)))
        return document
    except yaml.reader.ReaderError as error:
        line = text.count("\n", 0, error.position) + 1
        column = error.position - (text.rfind("\n", 0, error.position) + 1) + 1
        sentence = f"the character U+{ord(text[error.position]):04X} may not stand in YAML; remove it"
        document.faults.append(Fault((line, column), (), sentence))
        return document
    except RecursionError:
        document.faults.append(Fault((1, 1), (), "lists or mappings are nested too deeply to be a configuration"))
        return document
    for mark, tag in loader.tagged:
        short = tag.replace("tag:yaml.org,2002:", "!!")
        sentence = f"the tag {short} is refused; write the plain value, in quotes if it is text"
        document.faults.append(Fault((mark.line + 1, mark.column + 1), (), sentence))
    if root is not None:
        document.value = _Reader(document).read(root, ())
    return document


class _TagWatchingLoader(yaml.SafeLoader):
    """Composes nodes and records where a tag was written."""

    def __init__(self, text: str) -> None:
        super().__init__(text)
        self.tagged: list[tuple[yaml.Mark, str]] = []

    def compose_node(self, parent: yaml.Node | None, index: int) -> yaml.Node | None:
        event = self.peek_event()  # type: ignore[no-untyped-call]
        tag = getattr(event, "tag", None)
        if tag is not None:
            self.tagged.append((event.start_mark, str(tag)))
        return super().compose_node(parent, index)


class _Reader:
    """Turns nodes into plain values and records positions and faults in a document."""

    def __init__(self, document: YamlDocument) -> None:
        self.document = document
        self.open_nodes: list[yaml.Node] = []
        self.count = 0

    def fault(self, node: yaml.Node, path: KeyPath, sentence: str) -> None:
        self.document.faults.append(Fault(_position(node), path, sentence))

    def read(self, node: yaml.Node, path: KeyPath) -> Any:
        self.document.values[path] = _position(node)
        self.document.keys.setdefault(path, _position(node))
        self.count += 1
        if self.count > MAX_VALUES:
            if self.count == MAX_VALUES + 1:
                self.fault(node, path, f"more than {MAX_VALUES} values; do aliases repeat each other?")
            return None
        if isinstance(node, yaml.ScalarNode):
            return self.scalar(node, path)
        if node in self.open_nodes:
            self.fault(node, path, "the alias contains itself; write the value out")
            return None
        self.open_nodes.append(node)
        try:
            if isinstance(node, yaml.SequenceNode):
                return [self.read(item, (*path, index)) for index, item in enumerate(node.value)]
            assert isinstance(node, yaml.MappingNode)
            return self.mapping(node, path)
        finally:
            self.open_nodes.pop()

    def mapping(self, node: yaml.MappingNode, path: KeyPath) -> dict[str, Any]:
        """Return a mapping: merged keys first, overridden by its own."""
        own: dict[str, tuple[yaml.Node, yaml.Node]] = {}
        merged: dict[str, Any] = {}
        for key_node, value_node in node.value:
            if not isinstance(key_node, yaml.ScalarNode):
                self.fault(key_node, path, "a key must be a word, not a list or a mapping")
            elif key_node.tag == _MERGE_TAG and key_node.style is None:
                merged = {**self.merge(value_node, path), **merged}
            elif refused := _unfit(name := key_node.value):
                self.fault(key_node, path, f"a key {refused}")
            elif name in own:
                line = _position(own[name][0])[0]
                self.fault(key_node, (*path, name), f"this key stands already in line {line}; keep one of them")
            else:
                own[name] = (key_node, value_node)
        result = dict(merged)
        for name, (key_node, value_node) in own.items():
            self.document.keys[(*path, name)] = _position(key_node)
            result[name] = self.read(value_node, (*path, name))
        return result

    def merge(self, node: yaml.Node, path: KeyPath) -> dict[str, Any]:
        """Return what `<<: *anchor` or `<<: [*first, *second]` brings; the first of a list wins."""
        sources = node.value if isinstance(node, yaml.SequenceNode) else [node]
        result: dict[str, Any] = {}
        for source in sources:
            if not isinstance(source, yaml.MappingNode):
                self.fault(source, path, "`<<` takes a mapping (an alias such as *name) or a list of them")
                continue
            value = self.read(source, path)
            result = {**(value or {}), **result}
        return result

    def scalar(self, node: yaml.ScalarNode, path: KeyPath) -> Any:
        """Return text, a number, a truth value or None."""
        text = str(node.value)
        if refused := _unfit(text):
            self.fault(node, path, f"the text {refused}")
            return ""
        if node.style is not None:
            return text
        if text in _NULL:
            return None
        if text in _TRUTH:
            return _TRUTH[text]
        sentence = _refusal(text)
        if sentence:
            self.fault(node, path, sentence)
            return None
        if _INTEGER.fullmatch(text):
            return int(text)
        if _FLOAT.fullmatch(text):
            return float(text)
        return text


def _unfit(text: str) -> str:
    """Return why a key or value is no text that a path, a wire or a terminal takes, '' when it is."""
    if len(text) > MAX_TEXT_LENGTH:
        return f"has {len(text)} characters; at most {MAX_TEXT_LENGTH} are read"
    found = _NO_CHARACTER.search(text)
    return f"holds U+{ord(found[0]):04X}, which is no character of a text; remove the escape" if found else ""


def _refusal(text: str) -> str | None:
    """Return why a plain scalar is refused, None when it is not."""
    if _TRUTH_LIKE.fullmatch(text):
        return f"`{text}` could be a word or a truth value; write true or false, or put the word in quotes"
    if _NOT_FINITE.fullmatch(text):
        return f"`{text}` is not a number that can be used; write a finite number"
    if _SURPRISING_NUMBER.fullmatch(text):
        return f"`{text}` can be read as more than one number; write it as a plain decimal, or in quotes if it is text"
    if _INTEGER.fullmatch(text) or _FLOAT.fullmatch(text):
        if len(text) > MAX_NUMBER_LENGTH:
            return f"a number of {len(text)} characters is refused; write it shorter, or in quotes if it is text"
        if not math.isfinite(float(text)):
            return f"`{text}` is too large for a number"
    return None


def _position(node: yaml.Node) -> Position:
    return (node.start_mark.line + 1, node.start_mark.column + 1)


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
