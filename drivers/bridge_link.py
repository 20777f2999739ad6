"""A bridge to a control's own library as a child process: one request at a time, each answered with its own number."""

import asyncio
import contextlib
import json
import os
import signal
from typing import Any

from drivers.contract import LinkError

END_PATIENCE_S = 1.0
"""The bridge may take so long to end when its input has ended; then it is killed."""
LONGEST_LINE = 65_536


class BridgeError(ValueError):
    """A line that is no answer to what was asked."""


class BridgeLink:
    """A running bridge; a request that was given up ends it, so that no answer comes late."""

    def __init__(self, process: asyncio.subprocess.Process, name: str, when_it_ends: str) -> None:
        self._process, self._name, self._when_it_ends = process, name, when_it_ends
        self._asked = 0
        self.lost: str | None = None
        """Why the link is lost; None while it stands."""

    @classmethod
    async def start(cls, command: list[str], text: str, name: str, when_it_ends: str) -> "BridgeLink":
        """Start the bridge, whose program is `text`; raises OSError. `when_it_ends`: what to do about that."""
        process = await asyncio.create_subprocess_exec(
            *command,
            "-c",
            text,
            stdin=asyncio.subprocess.PIPE,
            stdout=asyncio.subprocess.PIPE,
            stderr=asyncio.subprocess.DEVNULL,
            limit=LONGEST_LINE,
            start_new_session=True,
            env={"PATH": "/usr/bin:/bin:/usr/sbin:/sbin", "LC_ALL": "C.UTF-8"},
        )
        return cls(process, name, when_it_ends)

    async def ask(self, **request: Any) -> dict[str, Any]:
        """Send a request and return its answer; raises LinkError and BridgeError."""
        if self.lost is not None:
            raise LinkError(self.lost)
        assert self._process.stdin is not None and self._process.stdout is not None
        self._asked += 1
        try:
            self._process.stdin.write(json.dumps({"id": self._asked, **request}).encode() + b"\n")
            line = await self._process.stdout.readline()
        except asyncio.CancelledError:
            self.abort(f"{self._name}: an answer was given up")
            raise
        if not line:
            self.abort(f"{self._name}: the bridge has ended; {self._when_it_ends}")
            raise LinkError(self.lost or "")
        try:
            answer = json.loads(line)
            if not isinstance(answer, dict) or answer.get("id") != self._asked:
                raise BridgeError(f"{line[:80]!r} does not answer request {self._asked}")
        except json.JSONDecodeError as error:
            raise BridgeError(f"{line[:80]!r} is no answer") from error
        if "error" in answer:
            self.abort(f"{self._name}: {answer['error']}")
            raise LinkError(self.lost or "")
        return answer

    def abort(self, reason: str) -> None:
        self.lost = self.lost or reason
        if self._process.stdin is not None:
            self._process.stdin.close()

    async def ended(self) -> None:
        """Wait until the bridge has ended; call after `abort`."""
        try:
            async with asyncio.timeout(END_PATIENCE_S):
                await self._process.wait()
        except TimeoutError:
            with contextlib.suppress(
                ProcessLookupError, PermissionError
            ):  # by sudo it is another user's: it ends itself
                os.killpg(self._process.pid, signal.SIGKILL)
                await self._process.wait()
