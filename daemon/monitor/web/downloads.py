"""Downloads: a process of its own makes the file, and its pieces are passed on as fast as the other side takes them."""

import asyncio
import contextlib
import json
import sys
from collections.abc import Mapping
from typing import Any

from starlette.responses import Response
from starlette.types import Receive, Scope, Send

from daemon.monitor.web.live import when_gone
from daemon.monitor.web.problems import ProblemError

EXPORTER = (sys.executable, "-P", "-m", "daemon.model_release.exporting")
MOST_DOWNLOADS = 2
"""So many are made at a time."""
PIECE = 65536
FIRST_PIECE_S = 120.0
"""The process must have begun within this [s]."""
LONGEST_SENTENCE = 2000


class Downloads:
    """Makes files, few at a time."""

    def __init__(self) -> None:
        self._under_way = 0

    async def begin(self, request: Mapping[str, Any], name: str, media_type: str) -> Response:
        """Return the answer that carries the file; raises ProblemError when there is none."""
        if self._under_way >= MOST_DOWNLOADS:
            raise ProblemError(503, f"{MOST_DOWNLOADS} downloads are being made; try again", {"retry-after": "10"})
        self._under_way += 1
        process: asyncio.subprocess.Process | None = None
        try:
            process = await asyncio.create_subprocess_exec(
                *EXPORTER, stdin=asyncio.subprocess.PIPE, stdout=asyncio.subprocess.PIPE, stderr=asyncio.subprocess.PIPE
            )
            assert process.stdin is not None
            assert process.stdout is not None
            assert process.stderr is not None
            process.stdin.write(json.dumps(request).encode())
            process.stdin.close()
            async with asyncio.timeout(FIRST_PIECE_S):
                first = await process.stdout.read(PIECE)
                if not first:
                    words = (await process.stderr.read(LONGEST_SENTENCE)).decode("utf-8", "replace").strip()
                    raise ProblemError(404, words.splitlines()[-1] if words else "the file could not be made")
        except BaseException as error:
            await self._end(process)
            if isinstance(error, TimeoutError):
                raise ProblemError(503, "the file was not begun in time; ask for less time") from error
            raise
        headers = {"content-disposition": f'attachment; filename="{name}"'}
        return _Download(self, process, first, headers, media_type)

    async def _end(self, process: asyncio.subprocess.Process | None) -> None:
        self._under_way -= 1
        if process is not None:
            with contextlib.suppress(ProcessLookupError):
                process.kill()
            await process.wait()

    async def end(self, process: asyncio.subprocess.Process) -> None:
        """End a download, whatever became of it."""
        await self._end(process)


class _Download(Response):
    """Passes on what the process writes; a file that is broken off ends the connection."""

    def __init__(
        self,
        downloads: Downloads,
        process: asyncio.subprocess.Process,
        first: bytes,
        headers: Mapping[str, str],
        media_type: str,
    ) -> None:
        super().__init__(headers=headers, media_type=media_type)
        del self.headers["content-length"]
        self._downloads, self._process, self._first = downloads, process, first

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        gone = asyncio.create_task(when_gone(receive))
        try:
            await send({"type": "http.response.start", "status": self.status_code, "headers": self.raw_headers})
            piece = self._first
            assert self._process.stdout is not None
            while piece and not gone.done():
                await send({"type": "http.response.body", "body": piece, "more_body": True})
                reading = asyncio.create_task(self._process.stdout.read(PIECE))
                await asyncio.wait([gone, reading], return_when=asyncio.FIRST_COMPLETED)
                if not reading.done():
                    reading.cancel()
                    return
                piece = reading.result()
            if gone.done():
                return
            if await self._process.wait() != 0:
                raise OSError("the process that makes a download has failed")  # the connection ends: no whole file
            await send({"type": "http.response.body", "body": b""})
        finally:
            gone.cancel()
            await self._downloads.end(self._process)
