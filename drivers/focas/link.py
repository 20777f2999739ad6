"""One TCP connection to a control that speaks FOCAS2: one request at a time, and an answer to nothing ends it."""

import asyncio

from drivers.contract import LinkError
from drivers.focas.codec import FocasFormatError, Frame, FrameBuffer, encode_frame


class FocasLink(asyncio.Protocol):
    """The protocol numbers nothing, so order is all there is: whatever comes unasked, late or twice ends the link."""

    def __init__(self, name: str) -> None:
        self._name = name
        self._buffer = FrameBuffer()
        self._waiting: asyncio.Future[Frame] | None = None
        self._transport: asyncio.Transport | None = None
        self._closed = asyncio.get_running_loop().create_future()
        self.lost: str | None = None
        """Why the link is lost; None while it stands."""

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Take the connection."""
        assert isinstance(transport, asyncio.Transport)
        self._transport = transport

    def data_received(self, data: bytes) -> None:
        """Hand the answer to who waits for it."""
        try:
            for frame in self._buffer.feed(data):
                if self._waiting is None or self._waiting.done():
                    self.abort(f"{self._name} sent an answer that nothing was asked for")
                    return
                self._waiting.set_result(frame)
        except FocasFormatError as error:
            self.abort(f"{self._name} does not speak FOCAS2: {error}")
            return
        if self._buffer.unfinished and (self._waiting is None or self._waiting.done()):
            self.abort(f"{self._name} sent bytes that nothing was asked for")

    def connection_lost(self, error: Exception | None) -> None:
        """Tell who waits that the connection has ended."""
        self.abort(f"{self._name} ended the connection" + (f": {error}" if error else ""))
        if not self._closed.done():
            self._closed.set_result(None)

    async def exchange(self, request: Frame) -> Frame:
        """Send a request and return the frame that comes next; given up, it ends the link. Raises LinkError."""
        if self.lost is not None or self._transport is None:
            raise LinkError(self.lost or f"{self._name}: never connected")
        waiting: asyncio.Future[Frame] = asyncio.get_running_loop().create_future()
        self._waiting = waiting
        try:
            self._transport.write(encode_frame(request))
            frame = await waiting
        except asyncio.CancelledError:
            self.abort(f"{self._name}: an answer was given up")
            raise
        finally:
            self._waiting = None
        if self.lost is not None:
            raise LinkError(self.lost)
        return frame

    def abort(self, reason: str) -> None:
        """End the connection at once; who waits gets a LinkError with the first reason."""
        self.lost = self.lost or reason
        if self._transport is not None:
            self._transport.abort()
        if self._waiting is not None and not self._waiting.done():
            self._waiting.set_exception(LinkError(self.lost))

    async def ended(self) -> None:
        """Wait until the socket is closed; call after `abort`."""
        if self._transport is not None:
            await self._closed
