"""What people have asked for and nobody has decided on yet."""

import asyncio

from models.output import NO_REQUEST, OperatorRequest


class Requests:
    """A queue of people's requests, and a way to wait until they are decided on; owned by the control task."""

    def __init__(self) -> None:
        self._waiting: list[tuple[OperatorRequest, str]] = []
        self._acted = asyncio.Event()

    def __bool__(self) -> bool:
        return bool(self._waiting)

    def put(self, request: OperatorRequest, person: str) -> None:
        """Queue a request."""
        self._waiting.append((request, person))

    def take(self) -> tuple[OperatorRequest, str]:
        """Return the oldest request and who made it; an empty one and '' when there is none."""
        return self._waiting.pop(0) if self._waiting else (NO_REQUEST, "")

    def decided(self) -> None:
        """Say that the output has decided on everything that was taken."""
        self._acted.set()

    async def carried_out(self) -> None:
        """Wait until everything that was queued before has been decided on."""
        while True:
            self._acted.clear()
            await self._acted.wait()
            if not self._waiting:
                return
