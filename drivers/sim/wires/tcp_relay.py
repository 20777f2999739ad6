"""A TCP relay in front of the simulated CNC's server that can freeze, as a hung control does, or die."""

import asyncio

HOST = "127.0.0.1"


class TcpRelay:
    """Forwards connections of a port to another port of this computer."""

    def __init__(self, *, port: int, target_port: int) -> None:
        """Prepare a relay that listens on `port` (0: any free one)."""
        self.port = port
        self._target_port = target_port
        self._server: asyncio.Server | None = None
        self._ends: set[_End] = set()
        self._reaching: set[asyncio.Task[None]] = set()
        self._frozen = False

    @property
    def frozen(self) -> bool:
        """Nothing is forwarded, though connections stay open and new ones are accepted."""
        return self._frozen

    @property
    def listening(self) -> bool:
        """Connections are accepted."""
        return self._server is not None

    async def start(self) -> None:
        """Listen (again). Does nothing while listening."""
        if self._server is None:
            loop = asyncio.get_running_loop()
            self._server = await loop.create_server(lambda: _End(self), HOST, self.port)
            self.port = self._server.sockets[0].getsockname()[1]

    async def stop(self) -> None:
        """Reset all connections and refuse new ones. Does nothing while not listening."""
        server, self._server = self._server, None
        if server is None:
            return
        server.close()
        for end in list(self._ends):
            end.abort()
        for task in self._reaching:
            task.cancel()
        await asyncio.gather(*self._reaching, return_exceptions=True)
        await server.wait_closed()
        await asyncio.sleep(0)

    def freeze(self) -> None:
        """Stop forwarding in both directions."""
        self._frozen = True
        for end in self._ends:
            end.pause()

    def thaw(self) -> None:
        """Forward again, what has waited first."""
        self._frozen = False
        for end in self._ends:
            end.resume()

    def abandon(self) -> None:
        """Leave the present connections open and silent for ever, as of a peer that vanished; new ones are served."""
        for end in self._ends:
            end.abandon()

    def joined(self, end: "_End") -> None:
        """Take note of a new end of a connection."""
        self._ends.add(end)
        if self._frozen:
            end.pause()

    def left(self, end: "_End") -> None:
        """Forget an end that is closed."""
        self._ends.discard(end)

    def reach_target(self, near: "_End") -> None:
        """Connect an accepted connection to the server behind."""
        task = asyncio.create_task(self._reach_target(near))
        self._reaching.add(task)
        task.add_done_callback(self._reaching.discard)

    async def _reach_target(self, near: "_End") -> None:
        try:
            await asyncio.get_running_loop().create_connection(lambda: _End(self, near), HOST, self._target_port)
        except OSError:
            near.abort()


class _End(asyncio.Protocol):
    """One end of a forwarded connection: the accepted one, or the one to the server."""

    def __init__(self, relay: TcpRelay, peer: "_End | None" = None) -> None:
        self._relay = relay
        self._peer = peer
        self._transport: asyncio.Transport | None = None
        self._waiting: list[bytes] = []
        self._abandoned = False

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        assert isinstance(transport, asyncio.Transport)
        self._transport = transport
        self._relay.joined(self)
        if self._peer is None:
            self._relay.reach_target(self)
        else:
            self._peer.meet(self)

    def meet(self, peer: "_End") -> None:
        """Take the connection to the server, and send it what has arrived meanwhile."""
        self._peer = peer
        if self._transport is None:
            peer.abort()
        for data in self._waiting:
            peer.send(data)
        self._waiting.clear()

    def data_received(self, data: bytes) -> None:
        if self._peer is None:
            self._waiting.append(data)
        else:
            self._peer.send(data)

    def connection_lost(self, error: Exception | None) -> None:
        self._transport = None
        self._relay.left(self)
        if self._peer is not None:
            self._peer.finish()

    def send(self, data: bytes) -> None:
        """Pass data on to this end's socket."""
        if self._transport is not None:
            self._transport.write(data)

    def finish(self) -> None:
        """Close after what is still to be sent."""
        if self._transport is not None:
            self._transport.close()

    def abort(self) -> None:
        """Reset the connection."""
        if self._transport is not None:
            self._transport.abort()

    def abandon(self) -> None:
        """Stop reading for ever."""
        self.pause()
        self._abandoned = True

    def pause(self) -> None:
        if self._transport is not None and self._transport.is_reading():
            self._transport.pause_reading()

    def resume(self) -> None:
        """Read again."""
        if self._transport is not None and not self._abandoned and not self._transport.is_closing():
            self._transport.resume_reading()
