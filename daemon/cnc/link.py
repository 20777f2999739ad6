"""Keeps a session with the CNC: a new client for every attempt, closed fully when it is lost."""

import asyncio
from collections.abc import Callable

from daemon.cnc.session import CncSession
from daemon.supervisor import LinkHealth
from drivers.contract import Cnc, LinkError


class CncLink:
    """Holds the present session; the control task uses it and says when it is lost."""

    def __init__(
        self, open_cnc: Callable[[], Cnc], open_session: Callable[[Cnc, CncSession | None], CncSession]
    ) -> None:
        self._open_cnc = open_cnc
        self._open_session = open_session
        self._lost: asyncio.Future[LinkError] | None = None
        self._last: CncSession | None = None
        self.session: CncSession | None = None
        self.health = LinkHealth("cnc")

    async def attempt(self) -> None:
        """Connect, offer the session until it is lost, close. Raises what ended it."""
        cnc = self._open_cnc()
        try:
            await cnc.connect()
            self._lost = asyncio.get_running_loop().create_future()
            self.session = self._last = self._open_session(cnc, self._last)
            self.health.came_up(identity=cnc.identity, security=cnc.security)
            raise await self._lost
        finally:
            self.session = None
            await cnc.close()

    def lost(self, error: LinkError) -> None:
        """End the present session; the supervisor opens the next one."""
        self.session = None
        if self._lost is not None and not self._lost.done():
            self._lost.set_result(error)
