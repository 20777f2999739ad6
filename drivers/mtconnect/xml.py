"""Reads the XML of an agent: of bounded size and depth, without document types and entities."""

import asyncio
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Self
from xml.parsers import expat

LONGEST_DOCUMENT = 2 << 20
"""A longer document of an agent is refused [byte]."""
DEEPEST = 40
MOST_ELEMENTS = 20_000
PIECE = 16_384
"""After so much the event loop turns to other work [byte]."""


class XmlError(ValueError):
    """The answer is no XML that is read here; the text says why."""


@dataclass(slots=True)
class Element:
    """One element; its name is without the namespace."""

    name: str
    attributes: dict[str, str]
    children: list[Self] = field(default_factory=list)
    text: str = ""

    def below(self, name: str) -> Iterator[Self]:
        for child in self.children:
            if child.name == name:
                yield child
            yield from child.below(name)

    def first(self, name: str) -> Self | None:
        return next(self.below(name), None)


class _Builder:
    def __init__(self) -> None:
        self._open: list[Element] = []
        self._count = 0
        self.root: Element | None = None

    def start(self, name: str, attributes: dict[str, str]) -> None:
        self._count += 1
        if len(self._open) >= DEEPEST or self._count > MOST_ELEMENTS:
            raise XmlError(f"it has more than {MOST_ELEMENTS} elements, or more than {DEEPEST} inside each other")
        element = Element(name.rpartition(" ")[2], {key.rpartition(" ")[2]: value for key, value in attributes.items()})
        if self._open:
            self._open[-1].children.append(element)
        else:
            self.root = element
        self._open.append(element)

    def end(self, _: str) -> None:
        self._open.pop()

    def text(self, text: str) -> None:
        self._open[-1].text += text

    def refuse(self, *_: object) -> None:
        raise XmlError("it declares a document type or an entity, which no agent needs")


async def parsed(content: bytes) -> Element:
    """Return the document's element, piece by piece between other work; raises XmlError."""
    content = content.lstrip(b" \t\r\n")  # some write an empty line first
    if len(content) > LONGEST_DOCUMENT:
        raise XmlError(f"it is longer than {LONGEST_DOCUMENT} byte")
    builder = _Builder()
    parser = expat.ParserCreate(namespace_separator=" ")
    parser.buffer_text = True
    parser.StartElementHandler, parser.EndElementHandler = builder.start, builder.end
    parser.CharacterDataHandler = builder.text
    parser.StartDoctypeDeclHandler = parser.EntityDeclHandler = builder.refuse
    try:
        for at in range(0, len(content), PIECE):
            parser.Parse(content[at : at + PIECE], False)
            await asyncio.sleep(0)
        parser.Parse(b"", True)
    except (expat.ExpatError, UnicodeError, LookupError) as error:
        raise XmlError(f"it is no XML ({error})") from error
    assert builder.root is not None
    return builder.root
