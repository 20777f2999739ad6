"""The dialogue with the person at the machine."""

import asyncio
import contextlib
import math
import os
import select
import termios
from typing import Protocol

import click

from daemon.commissioning.initialising import CommissioningRefusedError

LOOK_S = 0.05
"""Pause between two looks at the keyboard; the heartbeat to the CNC runs in it [s of the wall clock]."""
MOST_READS = 256
"""So many reads throw away what a person has typed; more comes from a program."""
YES = ("y", "yes")
NO = ("", "n", "no")


class Dialogue(Protocol):
    interactive: bool
    """Questions reach a person; otherwise only what options have answered is known."""

    def say(self, text: str) -> None:
        """Show a sentence."""

    async def confirm(self, question: str) -> bool:
        """Ask for a yes before something happens."""

    async def confirm_expressly(self, question: str) -> bool:
        """Ask for a yes that no general consent covers."""

    async def number(self, question: str) -> float | None:
        """Ask for a number, None when the person has none."""

    async def text(self, question: str) -> str:
        """Ask for a line of text."""


class TerminalDialogue:
    """Asks on the terminal, without a waiting thread; what was typed before a question is no answer to it."""

    def __init__(self, *, consent: bool, descriptor: int = 0) -> None:
        """`consent` says yes to every step beforehand, and asks for nothing."""
        self.interactive = not consent
        self._descriptor = descriptor

    def say(self, text: str) -> None:
        """Print a line; a terminal that is gone must not stop the way back to zero."""
        with contextlib.suppress(OSError):
            click.echo(text)

    async def confirm(self, question: str) -> bool:
        """Ask for a yes; a general consent counts."""
        if not self.interactive:
            self.say(f"{question} yes (--yes)")
            return True
        return await self.confirm_expressly(question)

    async def confirm_expressly(self, question: str) -> bool:
        """Ask for a yes on the terminal; without one the answer is no."""
        if not self.interactive:
            self.say(f"{question} no: --yes does not cover this")
            return False
        while True:
            answer = (await self._ask(f"{question} [y/N] ")).lower()
            if answer in YES or answer in NO:
                return answer in YES
            self.say("answer y or n")

    async def number(self, question: str) -> float | None:
        """Ask until a finite number or an empty line comes."""
        if not self.interactive:
            return None
        while True:
            answer = await self._ask(f"{question} ")
            if not answer:
                return None
            try:
                number = float(answer.replace(",", "."))
            except ValueError:
                number = math.nan
            if math.isfinite(number):
                return number
            self.say(f"{answer!r} is no number; write micrometres, such as 4.8 or -0.2")

    async def text(self, question: str) -> str:
        """Ask for a line; empty with a general consent."""
        return await self._ask(f"{question} ") if self.interactive else ""

    async def _ask(self, prompt: str) -> str:
        if self._discard():
            self.say("What was typed before this question does not count.")
        with contextlib.suppress(OSError):
            click.echo(prompt, nl=False)
        line = b""
        while b"\n" not in line:
            if not self._ready():
                await asyncio.sleep(LOOK_S)
                continue
            data = self._read()
            if not data:
                raise CommissioningRefusedError(
                    f"nobody answered {prompt.strip()!r}: standard input has ended. Answer on a terminal, or with "
                    "--yes, --person, --instrument and --channel; what is there before it is asked for does not count"
                )
            line += data
        return line.partition(b"\n")[0].decode("utf-8", "replace").strip()

    def _discard(self) -> bool:
        """Throw away what has been typed so far, half a line too; return whether there was any."""
        typed = False
        if os.isatty(self._descriptor):
            typed = self._ready()
            with contextlib.suppress(termios.error):  # the terminal is gone
                termios.tcflush(self._descriptor, termios.TCIFLUSH)
        for _ in range(MOST_READS):
            if not (self._ready() and self._read()):
                return typed
            typed = True
        raise CommissioningRefusedError("standard input does not end: answer on a terminal, question by question")

    def _ready(self) -> bool:
        return bool(select.select([self._descriptor], [], [], 0)[0])

    def _read(self) -> bytes:
        try:
            return os.read(self._descriptor, 4096)
        except OSError:
            return b""  # the terminal is gone
