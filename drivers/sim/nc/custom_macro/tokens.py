"""The words of custom macro text."""

import re
from dataclasses import dataclass
from typing import Literal

from drivers.sim.nc.blocks import NcError

TokenKind = Literal["comment", "number", "word", "mark"]

WORDS = (
    *("WHILE", "ROUND", "GOTO", "THEN", "SQRT", "ABS", "FIX", "FUP", "MOD", "AND", "XOR", "END"),
    *("IF", "DO", "OR", "EQ", "NE", "GT", "GE", "LT", "LE"),
)
"""Words of more than one letter, the longer ones first; every other letter is an address."""
_PATTERN = re.compile(
    rf"\((?P<comment>[^()]*)\)|(?P<number>\d+\.?\d*|\.\d+)"
    rf"|(?P<word>{'|'.join(WORDS)}|[A-Z])|(?P<mark>[#\[\]=+\-*/])"
)


@dataclass(frozen=True, slots=True)
class Token:
    """One word, number, mark or comment of a block."""

    kind: TokenKind
    text: str


def tokens_of(line: str) -> list[Token]:
    """Return the tokens of one block; raises NcError for a character that a control does not take."""
    found: list[Token] = []
    position = 0
    while position < len(line):
        if line[position] == " ":
            position += 1
            continue
        match = _PATTERN.match(line, position)
        if match is None:
            raise NcError(f"{line[position]!r} in {line!r} is no character of custom macro text")
        kind = match.lastgroup
        assert kind is not None
        found.append(Token(kind, match[kind]))  # type: ignore[arg-type]
        position = match.end()
    return found


class Reader:
    """Tokens of one block, taken one after the other; comments are kept apart."""

    def __init__(self, line: str) -> None:
        self.line = line
        found = tokens_of(line)
        self.comments = [token.text for token in found if token.kind == "comment"]
        self._tokens = [token for token in found if token.kind != "comment"]
        self._next = 0

    @property
    def done(self) -> bool:
        """No token is left."""
        return self._next >= len(self._tokens)

    def peek(self) -> str:
        """Return the next token's text, '' at the end."""
        return "" if self.done else self._tokens[self._next].text

    def peek_kind(self) -> str:
        """Return the next token's kind, '' at the end."""
        return "" if self.done else self._tokens[self._next].kind

    def take(self, expected: str = "") -> str:
        """Return the next token's text; raises NcError when it is not the expected one."""
        text = self.peek()
        if not text or (expected and text != expected):
            wanted = repr(expected) if expected else "more"
            raise NcError(f"{wanted} is expected {f'before {text!r}' if text else 'at the end'} of {self.line!r}")
        self._next += 1
        return text

    def accept(self, text: str) -> bool:
        """Take the next token if it is this one."""
        if self.peek() != text:
            return False
        self._next += 1
        return True

    def whole(self) -> int:
        text = self.take()
        if not text.isdigit():
            raise NcError(f"a whole number is expected instead of {text!r} in {self.line!r}")
        return int(text)

    def finish(self) -> None:
        """Raise NcError when anything is left."""
        if not self.done:
            raise NcError(f"{self.peek()!r} is not expected in {self.line!r}")
