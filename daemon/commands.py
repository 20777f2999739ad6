"""What a person may ask of the running daemon over its local socket."""

from collections.abc import Sequence
from typing import Any

from daemon.control import ControlTask
from daemon.control_socket import RequestError
from daemon.status import StatusBoard
from models.compensation import OperatorRequest


class CommandDesk:
    """Turns requests from the socket into requests to the tasks."""

    def __init__(self, board: StatusBoard, control: ControlTask, axes: Sequence[str]) -> None:
        self._board = board
        self._control = control
        self._axes = tuple(axes)

    async def handle(self, request: dict[str, Any], person: str) -> dict[str, Any]:
        """Answer one request; raises RequestError with the reason for a refusal."""
        match request.get("command"):
            case "status":
                return self._board.picture()
            case "enable":
                self._submit(OperatorRequest(enable=self._named(request)), person)
            case "disable":
                zero = request.get("zero", False)
                self._submit(OperatorRequest(disable=self._named(request), zero=bool(zero)), person)
            case "acknowledge":
                self._submit(OperatorRequest(acknowledge=True), person)
            case "reference":
                if refusal := self._control.request_reference(person):
                    raise RequestError(refusal)
            case other:
                raise RequestError(f"there is no command {other!r}")
        return {}

    def _submit(self, request: OperatorRequest, person: str) -> None:
        if refusal := self._control.request(request, person):
            raise RequestError(refusal)

    def _named(self, request: dict[str, Any]) -> frozenset[str]:
        axes = request.get("axes")
        if axes is None:
            return frozenset(self._control.modelled if request["command"] == "enable" else self._axes)
        if not isinstance(axes, list) or not all(isinstance(axis, str) for axis in axes):
            raise RequestError("axes must be a list of axis names")
        return frozenset(axes)
