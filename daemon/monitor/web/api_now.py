"""The API of the present: status, events, sensors, estimate, delays, models, dynamics, health."""

from typing import Annotated, Any

from fastapi import APIRouter, Query, Request
from starlette.responses import JSONResponse, Response

from daemon.monitor.web import schemas
from daemon.monitor.web.access import Access, Person, Viewer, access_of
from daemon.monitor.web.documents import Documents
from daemon.monitor.web.live import EventStream, Live
from daemon.monitor.web.problems import Problem, ProblemError
from daemon.snapshots import SnapshotBoard
from drivers.clock import Clock
from models.json_values import plain

router = APIRouter(tags=["now"])


def dynamics_document(board: SnapshotBoard, clock: Clock) -> dict[str, Any] | None:
    """Return what the operation under way was planned from; None where the tuning is not configured."""
    speed, cnc, now = board.spindle_speed, board.control.cnc, clock.now()
    if speed is None:
        return None
    diagram = speed.diagram
    actual_rpm = cnc.sample.spindle_speed_rpm if cnc is not None else None
    document: dict[str, object] = {
        "operation": speed.operation,
        "state": speed.state,
        "why": speed.alarm or speed.reason,
        "working_point": {
            "speed_rpm": speed.applied_rpm or speed.programmed_rpm or actual_rpm,
            "target_rpm": speed.target_rpm,
            "depth_mm": diagram.demanded_depth_mm if diagram is not None else None,
            "limiting_depth_mm": speed.limiting_depth_mm,
        },
    }
    if diagram is not None:
        shift_s = now.utc_ahead_s
        document["lobes"] = {"speed_rpm": diagram.speed_rpm, "limiting_depth_mm": diagram.limiting_depth_mm}
        document["response"] = {"frequency_hz": diagram.frequency_hz, "magnitude_um_per_n": diagram.receptance_um_per_n}
        document["resonance"] = {"t": [shift_s + each for each in diagram.resonance_time_s], "hz": diagram.resonance_hz}
    return plain(document)


def documents_of(request: Request) -> Documents:
    found = request.app.state.documents
    assert isinstance(found, Documents)
    return found


def who(access: Access, person: Person | None) -> dict[str, Any]:
    return {
        "name": (person.name or None) if person is not None else None,
        "role": person.role if person is not None else None,
        "csrf": (person.csrf or None) if person is not None else None,
        "expires": person.expires_utc_s if person is not None else None,
        "accounts": access.accounts is not None,
    }


@router.get("/status", response_model=schemas.Status)
async def status(request: Request, person: Viewer) -> Response:
    """Return everything that the overview shows."""
    return JSONResponse(documents_of(request).status() | {"user": who(access_of(request), person)})


class _Stream(Response):
    """A response that hands its connection to an event stream."""

    def __init__(self, stream: EventStream) -> None:
        super().__init__()
        self._stream = stream

    async def __call__(self, scope: Any, receive: Any, send: Any) -> None:
        await self._stream(scope, receive, send)


@router.get(
    "/events",
    response_class=Response,
    responses={200: {"content": {"text/event-stream": {"schema": {"type": "string"}}}, "description": "events"}},
)
async def events(
    request: Request,
    person: Viewer,
    temperatures: Annotated[bool, Query(description="send `cycle` events too")] = False,
) -> Response:
    """Follow the machine: `status` when it changes and at least each second, `cycle` with every new temperatures."""
    live, access = request.app.state.live, access_of(request)
    assert isinstance(live, Live)
    live.check_room()

    def account() -> Any:
        return None if access.accounts is None else access.accounts.now().get(person.name)

    begun_by = account()

    def allowed() -> bool:
        return account() == begun_by and (not person.csrf or access.by_session(request) is not None)

    return _Stream(EventStream(live, cycles=temperatures, allowed=allowed))


@router.get("/sensors", response_model=schemas.Sensors)
async def sensors(request: Request, person: Viewer) -> Response:
    """Return every sensor's newest temperature, its quality and the reason."""
    return JSONResponse(documents_of(request).sensors())


@router.get("/latency", response_model=schemas.Latency)
async def latency(request: Request, person: Viewer) -> Response:
    """Return the delay of every stage beside the published one."""
    return JSONResponse(documents_of(request).latency())


@router.get("/models", response_model=schemas.Models)
async def models(request: Request, person: Viewer) -> Response:
    """Return models in force and candidates; releasing stays on the command line."""
    return JSONResponse(await request.app.state.parts.models())


@router.get(
    "/dynamics",
    response_model=schemas.Dynamics,
    responses={404: {"model": Problem, "description": "not configured; the sentence says how to get it"}},
)
async def dynamics(request: Request, person: Viewer) -> Response:
    """Return the tool point's response, resonance over time, lobes and the working point."""
    parts = request.app.state.parts
    if (found := dynamics_document(parts.board, parts.clock)) is not None:
        return JSONResponse(found)
    raise ProblemError(
        404,
        "the spindle's dynamics are not configured: make a spindle model (docs/how-to/"
        "from-impact-test-to-spindle-model.md) and add the section spindle_speed to the configuration "
        "(docs/how-to/tune-the-spindle-speed.md)",
    )


@router.get(
    "/health",
    response_model=schemas.Health,
    responses={503: {"model": schemas.Health, "description": "the output is in FAULT, or a link is down"}},
)
async def health(request: Request, person: Viewer) -> Response:
    """Answer 503 with the reason while the output is in FAULT or a link is down."""
    reason = documents_of(request).unhealthy()
    state = request.app.state.parts.board.control.state
    document = {"healthy": not reason, "state": state, "reason": reason}
    return JSONResponse(document, 503 if reason else 200)
