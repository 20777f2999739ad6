"""One TCP connection to a control that speaks FOCAS2: one request at a time, and an answer to nothing ends it."""

from drivers.focas.codec import FocasFormatError, Frame, FrameBuffer, encode_frame
from drivers.linked_cnc import AnsweredLink


class FocasLink(AnsweredLink[Frame]):
    """The protocol numbers nothing, so order is all there is: whatever comes unasked, late or twice ends the link."""

    def __init__(self, name: str) -> None:
        super().__init__(name)
        self._buffer = FrameBuffer()

    def data_received(self, data: bytes) -> None:
        """Hand the answer to who waits for it."""
        try:
            for frame in self._buffer.feed(data):
                if self._waiting is None or not self._waits:
                    self.abort(f"{self._name} sent an answer that nothing was asked for")
                    return
                self._waiting.set_result(frame)
        except FocasFormatError as error:
            self.abort(f"{self._name} does not speak FOCAS2: {error}")
            return
        if self._buffer.unfinished and not self._waits:
            self.abort(f"{self._name} sent bytes that nothing was asked for")

    async def exchange(self, request: Frame) -> Frame:
        """Send a request and return the frame that comes next; given up, it ends the link. Raises LinkError."""
        return await self._answer_to(encode_frame(request))
