"""The API of actions: logging in and out, references, switching on and off; the same handlers as the local socket."""

from typing import Any

from fastapi import APIRouter, Request
from starlette.responses import JSONResponse, Response

from daemon.monitor.accounts import Role
from daemon.monitor.control_socket import RequestError
from daemon.monitor.web import schemas
from daemon.monitor.web.access import Operator, access_of, address_of
from daemon.monitor.web.api_now import who
from daemon.monitor.web.problems import Problem, ProblemError

router = APIRouter(tags=["actions"])
REFUSED: dict[int | str, dict[str, Any]] = {409: {"model": Problem, "description": "refused; the sentence says why"}}


async def _act(request: Request, person: Operator, command: dict[str, Any]) -> Response:
    """Hand a command to the desk that serves the local socket too."""
    try:
        outcome = await request.app.state.parts.desk.handle(command, person.in_audit)
    except RequestError as error:
        raise ProblemError(409, str(error)) from error
    known = ("decided", "state", "reason", "alarm")
    return JSONResponse({key: outcome[key] for key in known if key in outcome})


@router.post("/reference", response_model=schemas.Decided, responses=REFUSED)
async def reference(request: Request, person: Operator) -> Response:
    """Set the reference now, as after work positioning."""
    return await _act(request, person, {"command": "reference"})


@router.post("/enable", response_model=schemas.Decided, responses=REFUSED)
async def enable(request: Request, person: Operator, what: schemas.Enable) -> Response:
    """Switch compensation on; the tuning of the spindle speed takes the role engineer."""
    if what.spindle_speed and not person.role.covers(Role.ENGINEER):
        raise ProblemError(403, f"{person.name} is {person.role}; the tuning of the spindle speed takes an engineer")
    return await _act(request, person, {"command": "enable", **_given(what)})


@router.post("/disable", response_model=schemas.Decided, responses=REFUSED)
async def disable(request: Request, person: Operator, what: schemas.Disable) -> Response:
    """Switch compensation off; the offset retreats."""
    return await _act(request, person, {"command": "disable", **_given(what)})


@router.post("/acknowledge", response_model=schemas.Decided, responses=REFUSED)
async def acknowledge(request: Request, person: Operator, what: schemas.Acknowledge) -> Response:
    """Clear a latched FAULT after its cause is gone."""
    return await _act(request, person, {"command": "acknowledge", **_given(what)})


def _given(what: schemas.Enable | schemas.Acknowledge) -> dict[str, Any]:
    return what.model_dump(exclude_defaults=True)


@router.get("/session", response_model=schemas.Who)
async def session(request: Request) -> Response:
    """Say who is logged in, and hand out the token that actions carry."""
    access = access_of(request)
    person = await access.viewer(request) if access.accounts is None else access.by_session(request)
    return JSONResponse(who(access, person))


@router.post("/session", response_model=schemas.Who)
async def login(request: Request, given: schemas.Login) -> Response:
    """Log in: sets the session's cookie."""
    access = access_of(request)
    token, person = await access.login(given.name, given.password, address_of(request))
    answer = JSONResponse(who(access, person))
    answer.set_cookie(
        access.cookie, token, max_age=int(access.session_s), secure=access.secure, httponly=True, samesite="strict"
    )
    return answer


@router.delete("/session", response_model=schemas.Who)
async def logout(request: Request) -> Response:
    """Log out."""
    access = access_of(request)
    access.logout(request)
    answer = JSONResponse(who(access, await access.viewer(request) if access.accounts is None else None))
    answer.delete_cookie(access.cookie, secure=access.secure, httponly=True, samesite="strict")
    return answer
