"""A real terminal (pty) with somebody in front of it who reads what is asked and then types."""

import os
import pty
import select
import subprocess
from collections.abc import Sequence
from types import TracebackType
from typing import Self


class Terminal:
    """Both ends of a terminal; `inside` is what a program has as its standard input and output."""

    def __init__(self) -> None:
        self._outside, self.inside = pty.openpty()
        self.shown = ""
        """Everything that has been shown so far."""
        self._looked_at = 0

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        os.close(self._outside)
        os.close(self.inside)

    def run(self, command: Sequence[object]) -> "subprocess.Popen[bytes]":
        """Start a command on this terminal."""
        return subprocess.Popen(
            [str(word) for word in command], stdin=self.inside, stdout=self.inside, stderr=self.inside
        )

    def type(self, text: str) -> None:
        """Type, whether anything was asked or not."""
        os.write(self._outside, text.encode())

    def type_ahead(self, text: str) -> None:
        """Type what nobody has asked for, and wait until the terminal has taken and shown it."""
        self.type(text)
        self.until(text.replace("\n", "\r\n"), 30.0)

    def until(self, words: str, timeout_s: float) -> str:
        """Return what is shown from where the last look ended up to these words."""
        while words not in self.shown[self._looked_at :]:
            ready, _, _ = select.select([self._outside], [], [], timeout_s)
            assert ready, f"{words!r} was not shown: {self.shown}"
            self.shown += os.read(self._outside, 4096).decode("utf-8", "replace")
        begin, self._looked_at = self._looked_at, self.shown.index(words, self._looked_at) + len(words)
        return self.shown[begin : self._looked_at]

    def answer(self, question: str, line: str, timeout_s: float) -> None:
        """Wait until these words of a question are shown, then type a line."""
        self.until(question, timeout_s)
        self.type(line + "\n")
