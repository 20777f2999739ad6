"""Serves the commands that people send to the running daemon over its local socket."""

import asyncio
from collections.abc import Callable, Mapping
from dataclasses import asdict
from typing import Any

from config.schema.compensation import AxisConfig
from daemon.messages import OutputActions
from daemon.monitor.control_socket import RequestError
from daemon.monitor.status import StatusBoard
from daemon.snapshots import SnapshotBoard
from models.control.state import OperatorRequest

DECISION_S = 3.0
"""A request is answered after this long at the latest [s]; the control task decides with its next tick."""
MOST_AXES = 500
"""Their names take no more room in a request: a refusal is kept, shown and told to everybody [characters]."""
KEYS = {"acknowledge": {"fault"}, "enable": {"axes", "spindle_speed"}, "disable": {"axes", "zero", "spindle_speed"}}
"""What a command takes beside its name; the others take nothing."""


class CommandDesk:
    """Turns requests from the socket into requests to the output; what came of them is read from the snapshots."""

    def __init__(
        self, status: StatusBoard, snapshots: SnapshotBoard, actions: OutputActions, axes: Mapping[str, AxisConfig]
    ) -> None:
        self._status = status
        self._snapshots = snapshots
        self._actions = actions
        self._axes = frozenset(axes)
        self._modelled = frozenset(name for name, axis in axes.items() if axis.estimate is not None)

    async def handle(self, request: dict[str, Any], person: str) -> dict[str, Any]:
        """Answer one request; raises RequestError with the reason for a refusal."""
        _check_keys(request)
        if _of_spindle_speed(request):
            return await self._turn_spindle_speed(on=request["command"] == "enable", person=person)
        match request.get("command"):
            case "status":
                return self._status.picture()
            case "enable":
                self._submit(OperatorRequest(enable=self._named(request)), person)
            case "disable":
                self._submit(OperatorRequest(disable=self._named(request), zero=_zero(request)), person)
            case "acknowledge":
                self._submit(OperatorRequest(acknowledge=_fault(request)), person)
            case "reference":
                return await self._reference_by_hand(person)
            case other:
                raise RequestError(f"there is no command {other!r}")
        return await self._outcome()

    async def _reference_by_hand(self, person: str) -> dict[str, Any]:
        """Return where the output stands with this reference; raises RequestError with the reason for a refusal."""
        decided: list[str] = []
        if refusal := self._actions.request_reference(person, decided.append):
            raise self._refusal("reference", refusal, person)
        outcome = await self._outcome(lambda: bool(decided))
        if any(decided):
            raise RequestError(decided[0])
        return outcome

    async def _turn_spindle_speed(self, *, on: bool, person: str) -> dict[str, Any]:
        """Switch the tuning of the spindle speed; what is switched off is waited for until the NC cannot take it."""
        what = "enable" if on else "disable"
        if refusal := self._actions.switch_spindle_speed(on, person):
            raise self._refusal(f"{what} the tuning of the spindle speed", refusal, person)
        try:
            async with asyncio.timeout(DECISION_S):
                while not (on or self._speed_stands_off()):
                    await self._actions.carried_out()
        except TimeoutError:
            return {"decided": False}
        speed = self._snapshots.spindle_speed
        picture = asdict(speed) if speed is not None else {}
        return {"decided": True, **{key: picture.get(key, "") for key in ("state", "reason", "alarm")}}

    def _speed_stands_off(self) -> bool:
        speed = self._snapshots.spindle_speed
        return speed is None or speed.stands_off

    def _refusal(self, what: str, why: str, person: str) -> RequestError:
        """Record a refusal of the desk itself; the control task records its own."""
        self._actions.record_refusal(f"{what}: {why}", person)
        return RequestError(why)

    async def _outcome(self, decided: Callable[[], bool] = lambda: True) -> dict[str, Any]:
        """Return where the output stands when the request has been decided on, or that it has not been yet."""
        try:
            async with asyncio.timeout(DECISION_S):
                await self._actions.carried_out()
                while not decided():
                    await self._actions.carried_out()
        except TimeoutError:
            return {"decided": False}
        control = self._snapshots.control
        return {"decided": True, "state": control.state.value, "reason": control.reason, "alarm": control.alarm}

    def _submit(self, request: OperatorRequest, person: str) -> None:
        if refusal := self._actions.request(request, person):
            raise RequestError(refusal)

    def _named(self, request: dict[str, Any]) -> frozenset[str]:
        axes = request.get("axes")
        if axes is None:
            return self._modelled if request["command"] == "enable" else self._axes
        if not isinstance(axes, list) or not all(isinstance(axis, str) for axis in axes) or len(str(axes)) > MOST_AXES:
            raise RequestError("axes must be a list of axis names")
        if not axes:
            raise RequestError("axes is an empty list; name axes, or leave it out to mean all of them")
        return frozenset(axes)


def _check_keys(request: dict[str, Any]) -> None:
    command = request.get("command")
    known = KEYS.get(command, set()) if isinstance(command, str) else set()
    if unknown := sorted(set(request) - known - {"command"}):
        takes = ", ".join(sorted(known)) or "nothing else"
        raise RequestError(f"the command {command!r} does not know {', '.join(unknown)}; it takes {takes}")


def _fault(request: dict[str, Any]) -> int:
    fault = request.get("fault")
    if not isinstance(fault, int) or isinstance(fault, bool) or not 0 < fault < 2**31:
        raise RequestError("fault must be the number of the FAULT that is acknowledged, as the status tells it")
    return fault


def _zero(request: dict[str, Any]) -> bool:
    zero = request.get("zero", False)
    if not isinstance(zero, bool):
        raise RequestError(f"zero must be true or false, not {zero!r}")
    if zero and request.get("axes") is not None:
        raise RequestError("zero retreats every axis; name no axes with it")
    return zero


def _of_spindle_speed(request: dict[str, Any]) -> bool:
    speed = request.get("spindle_speed", False)
    if not isinstance(speed, bool):
        raise RequestError(f"spindle_speed must be true or false, not {speed!r}")
    if speed and (request.get("axes") is not None or request.get("zero", False)):
        raise RequestError("spindle_speed switches the tuning of the speed alone; name neither axes nor zero with it")
    return speed
