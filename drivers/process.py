"""What a program that the daemon starts writes: one JSON object with numbers a line."""

import asyncio
import contextlib
import json
import os
import signal
from collections import deque

from config.schema.source_drivers import SourceEntry
from config.schema.source_sections import Program
from drivers.clock import Clock
from drivers.contract import FatalDriverError, LinkError
from drivers.json_fields import readings_in
from drivers.pushing import PushedSource
from models.json_values import printable

LAST_WORDS = 5
"""So many lines of what it last wrote to its standard error are told when the program ends."""
QUOTED = 200
END_PATIENCE_S = 2.0
"""The program may take so long to end when it is told to; then it is killed."""


class ProcessSource(PushedSource):
    """Starts the program, in a process group of its own, and ends it with the source."""

    def __init__(self, source: SourceEntry, clock: Clock) -> None:
        super().__init__(source, clock)
        assert isinstance(source.connection, Program)
        self._config = source.connection
        self._said: deque[str] = deque(maxlen=LAST_WORDS)

    async def follow(self) -> None:
        """Run the program and take its lines; raises LinkError when it ends."""
        program = await self._start()
        errors = asyncio.create_task(self._listen(program))
        try:
            await self._lines(program)
            status = await program.wait()
            await errors
            said = f"; it last said: {' / '.join(self._said)}" if self._said else ""
            raise LinkError(f"source {self.name}: {self._config.command[0]} ended with status {status}{said}")
        finally:
            errors.cancel()
            await _end(program)

    async def _start(self) -> asyncio.subprocess.Process:
        command = self._config.command
        try:
            return await asyncio.create_subprocess_exec(
                *command,
                stdin=asyncio.subprocess.DEVNULL,
                stdout=asyncio.subprocess.PIPE,
                stderr=asyncio.subprocess.PIPE,
                limit=self._config.max_line_bytes,
                start_new_session=True,
            )
        except (FileNotFoundError, PermissionError) as error:
            words = f"source {self.name}: {command[0]} cannot be started: {error.strerror}; correct `process.command`"
            raise FatalDriverError(words) from error
        except (OSError, ValueError) as error:
            raise LinkError(f"source {self.name}: {command[0]} cannot be started: {error}") from error

    async def _lines(self, program: asyncio.subprocess.Process) -> None:
        assert program.stdout is not None
        number = 0
        while True:
            try:
                line = await program.stdout.readuntil(b"\n")
            except asyncio.IncompleteReadError:
                return  # what it wrote without a line end may have been cut
            except asyncio.LimitOverrunError as error:
                await program.stdout.read(max(error.consumed, 1))
                longest = self._config.max_line_bytes
                self.report(f"source {self.name}: a line is longer than max_line_bytes ({longest}) and is skipped")
                continue
            number += 1
            self._take(line, number)
            await asyncio.sleep(0)  # other tasks get their turn: lines that are there already do not wait

    def _take(self, line: bytes, number: int) -> None:
        try:
            content = json.loads(line)
        except (ValueError, RecursionError):
            text = line[:QUOTED].decode("utf-8", errors="replace").strip()
            self.report(f"source {self.name}: line {number} is no JSON and is skipped: {text!r}")
            return
        fields = {each.key: each.field for each in self._config.every_input}
        if readings := readings_in(content, fields):
            self.put_set(readings)
        else:
            self.report(f"source {self.name}: line {number} has none of the configured fields; correct `field`")

    async def _listen(self, program: asyncio.subprocess.Process) -> None:
        assert program.stderr is not None
        while data := await program.stderr.read(4096):
            lines = data.decode("utf-8", errors="replace").splitlines()
            self._said.extend(printable(line[:QUOTED]) for line in lines[-LAST_WORDS:] if line.strip())

    def silent(self) -> str:
        """Return what to check when no line comes."""
        return (
            f"{self._config.command[0]} has written nothing for three cycle periods ({self._source.cycle_period_s:g} s "
            "each): check what it reads, and that it writes every line at once (flush)"
        )


async def _end(program: asyncio.subprocess.Process) -> None:
    """End the program and what it started, and let go of its pipes."""
    for kind in (signal.SIGTERM, signal.SIGKILL):
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(program.pid, kind)
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(END_PATIENCE_S):
                await program.wait()
                break
    program._transport.close()  # type: ignore[attr-defined]  # else a pipe that is not read to its end stays open
