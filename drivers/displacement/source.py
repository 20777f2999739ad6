"""Follows the files of a logger as they grow."""

import asyncio
import concurrent.futures
import math
import threading
from collections.abc import AsyncIterator, Callable
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

from drivers.clock import Clock
from drivers.contract import LinkError
from drivers.displacement.rows import Logged, RowReader, UnreadableFileError, logged_numbers, start_of
from drivers.displacement.tail import FileFollower, Look
from models.records import DisplacementSample

UNREACHABLE_LOOKS = 24
"""So many looks in a row without a readable file are a lost link."""
PATIENCE_REAL_S = 30.0
"""A share that has not answered for so long is reported; the answer is waited for all the same."""
ROWS_PER_TURN = 50
"""Rows after which other tasks get their turn, about a millisecond."""

Answer = TypeVar("Answer")


class _File:
    """How far the rows of one file have been read."""

    def __init__(self) -> None:
        self.reader: RowReader | None = None
        self.last_utc_s = -math.inf
        self.repeated_until_s = -math.inf
        self.began_anew = False
        self.usable = True
        self.refusal: str | None = None
        """Why it is not usable, where another file or another configuration would help."""
        self.lines = 0


class DisplacementCsvSource:
    """The files of one A/D logger (`drivers.contract.DisplacementSource`), to be used once.

    Each row is given once: rows up to `after_utc_s` are skipped, and so are those that a rewritten file
    repeats. Bad rows are counted in `problems`, reported and skipped. Files are read in threads that nobody waits
    for at shut-down, because a network share may take minutes to answer.
    """

    def __init__(
        self, config: Logged, clock: Clock, *, after_utc_s: float | None = None, in_thread: bool = True
    ) -> None:
        """Prepare; without `in_thread` files are read in the event loop, which a slow share would stop."""
        self.name = "displacements"
        self.problems = 0
        """Rows, fields and files that could not be read."""
        self.last_problem: str | None = None
        self._config = config = logged_numbers(config)
        self._owner = config.owner
        self.caught_up = False
        """What was in the files before has been read: what comes now has been written since."""
        self._clock = clock
        self._after_utc_s = -math.inf if after_utc_s is None else after_utc_s
        self._follower = FileFollower(
            config.file.path,
            config.file.max_line_bytes,
            catch_up=after_utc_s is not None and start_of(config.file) is None,
        )
        self._files: dict[Path, _File] = {}
        self._unreachable = 0
        self._threaded = in_thread
        self._closed = asyncio.Event()
        self._on_problem: Callable[[str], None] = lambda _: None
        self._on_reached: Callable[[], None] = lambda: None

    async def samples(
        self, on_problem: Callable[[str], None] = lambda _: None, on_reached: Callable[[], None] = lambda: None
    ) -> AsyncIterator[DisplacementSample]:
        """Follow the file and yield each new row once, in file order; raises LinkError."""
        self._on_problem, self._on_reached = on_problem, on_reached
        while not self._closed.is_set():
            look, cause = await self._in_thread(self._follower.look) if self._threaded else self._follower.look()
            if look is None:
                self._unreachable_for(cause)
                await self._sleep()
                continue
            file = self._file(look)
            for row, (number, line) in enumerate(look.lines, start=1):
                sample = self._row(file, line, number, look.encoding)
                if sample is not None:
                    yield sample
                if row % ROWS_PER_TURN == 0:
                    await asyncio.sleep(0)
            self.caught_up |= not look.more
            if self._refusal(file) is None:
                self._on_reached()

    async def close(self) -> None:
        """End `samples`. May be called in any state, more than once; never raises. No file is open between looks."""
        self._closed.set()

    def _report(self, problem: str) -> None:
        self.problems += 1
        self.last_problem = problem
        self._on_problem(problem)

    def _unreachable_for(self, cause: str | None) -> None:
        if cause is None and self._files:
            cause = self._refusal(list(self._files.values())[-1])
        if cause is None:
            self.caught_up = True
            self._after_utc_s = -math.inf  # what comes now is new, though a clock that was ahead has stamped later rows
            self._unreachable = 0
            self._on_reached()
            return
        self._unreachable += 1
        if self._unreachable == 1 and cause != self.last_problem:
            self._report(f"{self._owner} {self._config.file.path}: {cause}")
        if self._unreachable >= UNREACHABLE_LOOKS:
            raise LinkError(
                f"{self._owner} {self._config.file.path}: {cause} ({self._unreachable} looks in a row). "
                "Check that the logger runs, that its folder is mounted, and `path` in the configuration"
            )

    def _refusal(self, newest: _File) -> str | None:
        """Return why nothing can be read from the newest file, although it is there."""
        if newest.usable and newest.reader is not None and newest.lines and not newest.reader.has_header:
            return f"none of its {newest.lines} lines starts with the header {self._config.file.header!r}"
        return newest.refusal

    def _file(self, look: Look) -> _File:
        file, begins_after_s = self._files.get(look.path), -math.inf
        if file is None:
            begins_after_s = max((each.last_utc_s for each in self._files.values()), default=-math.inf)
            file = self._files[look.path] = _File()
            if self.caught_up:  # it may be one of the others, which the logger has given another name
                file.repeated_until_s = min(begins_after_s, self._clock.now().utc_s)
        if look.restarted:
            file.began_anew |= file.reader is not None and file.reader.data_rows > 0
            file.repeated_until_s = min(file.last_utc_s, self._clock.now().utc_s)
            file.reader = None
            file.refusal = None
            file.lines = 0
        if file.reader is None:
            file.reader = RowReader(self._config, str(look.path), self._report, begins_after_s)
            file.usable = True
            if self._is_unplaced(file):
                file.usable = False
                self._report(
                    f"{look.path}:1:1: this file began anew, and rows without a time stamp have no time then; "
                    "they are skipped. Set `start` in the configuration to the time of its first row and restart"
                )
        file.lines += len(look.lines)
        for number in look.overlong:
            self._report(
                f"{look.path}:{number}:1: this line is longer than max_line_bytes "
                f"({self._config.file.max_line_bytes}) and is skipped"
            )
        return file

    def _is_unplaced(self, file: _File) -> bool:
        """Whether the rows have no time: `start` is the time of one file's first row, not of the next file's."""
        first = next(iter(self._files.values()))
        return start_of(self._config.file) is not None and (file.began_anew or file is not first)

    def _row(self, file: _File, line: bytes, number: int, encoding: str | None) -> DisplacementSample | None:
        if not file.usable or file.reader is None:
            return None
        try:
            sample = file.reader.read(line, number, encoding)
        except UnreadableFileError as error:
            file.usable = False
            file.refusal = str(error)
            self._report(file.refusal)
            return None
        if sample is None:
            return None
        self._unreachable = 0
        if math.isnan(sample.utc_s):
            return replace(sample, utc_s=self._clock.now().utc_s)
        file.last_utc_s = max(file.last_utc_s, sample.utc_s)
        return sample if sample.utc_s > max(self._after_utc_s, file.repeated_until_s) else None

    async def _sleep(self) -> None:
        """Wait for the next look, or for `close`."""
        waits = {
            asyncio.ensure_future(self._clock.sleep(self._config.file.poll_period_s)),
            asyncio.ensure_future(self._closed.wait()),
        }
        try:
            await asyncio.wait(waits, return_when=asyncio.FIRST_COMPLETED)
        finally:
            for wait in waits:
                wait.cancel()

    async def _in_thread(self, function: Callable[[], Answer]) -> Answer:
        """Run blocking I/O in a thread of its own that does not keep the program from ending."""
        found = concurrent.futures.Future[Answer]()

        def work() -> None:
            found.set_running_or_notify_cancel()  # who gives it up waits no longer, and the thread ends by itself
            try:
                found.set_result(function())
            except Exception as error:
                found.set_exception(error)  # raised again where the answer is awaited

        threading.Thread(target=work, name="displacement-files", daemon=True).start()
        answer = asyncio.wrap_future(found)
        done, _ = await asyncio.wait({answer}, timeout=PATIENCE_REAL_S)
        if not done:
            self._report(f"{self._owner} {self._config.file.path}: no answer for {PATIENCE_REAL_S:g} s")
        return await answer
