"""The monitor's application: pages, API, metrics; every route states what it takes and answers."""

from collections.abc import Awaitable, Callable, Collection
from dataclasses import dataclass
from importlib.metadata import version
from typing import Any

from fastapi import APIRouter, Depends, FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.routing import APIRoute
from prometheus_client import CollectorRegistry, generate_latest
from prometheus_client.exposition import CONTENT_TYPE_LATEST
from starlette.exceptions import HTTPException
from starlette.responses import JSONResponse, PlainTextResponse, Response
from starlette.types import ASGIApp

from config.schema import Configuration
from daemon.monitor.accounts import Accounts
from daemon.monitor.commands import CommandDesk
from daemon.monitor.web import api_actions, api_history, api_now
from daemon.monitor.web.access import Access, Report, asked_here
from daemon.monitor.web.documents import Documents
from daemon.monitor.web.downloads import Downloads
from daemon.monitor.web.gate import Gate
from daemon.monitor.web.live import Live
from daemon.monitor.web.pages import Pages
from daemon.monitor.web.problems import PROBLEM_TYPE, Problem, ProblemError, invalid_in_words, problem_response
from daemon.monitor.web.recorded import Recorded
from daemon.snapshots import SnapshotBoard
from drivers.clock import Clock

Look = Callable[[], Awaitable[dict[str, Any]]]
API, PREFIX = (api_now, api_history, api_actions), "/api/v1"


@dataclass(frozen=True, slots=True, kw_only=True)
class MonitorParts:
    """What the daemon hands to the monitor."""

    configuration: Configuration
    clock: Clock
    board: SnapshotBoard
    desk: CommandDesk
    registry: CollectorRegistry
    documents: Documents
    live: Live
    report: Report
    """Puts an event into the audit: kind, text, person."""
    models: Look
    """Models in force, candidates, scores."""


PROBLEMS: dict[int | str, dict[str, Any]] = {
    status: {"model": Problem, "description": text}
    for status, text in (
        (401, "nobody is logged in"),
        (403, "host, origin, token or role do not allow it"),
        (408, "the body has not arrived in time"),
        (413, "the body is too long"),
        (422, "the request is not as described here"),
        (429, "too many wrong passwords"),
        (503, "not now"),
    )
}


def monitor_application(parts: MonitorParts, names: Callable[[], Collection[str]] = tuple) -> ASGIApp:
    """Return the application; `names` tells those by which it is reached."""
    service = parts.configuration.service
    app = FastAPI(
        title="Toolpoint monitor",
        version=version("toolpoint"),
        description="State, error, delay and reason of the compensation. Times are UTC seconds; errors are problem "
        "details (RFC 9457) with one sentence.",
        openapi_url=None,
        docs_url=None,
        redoc_url=None,
        redirect_slashes=False,
    )
    app.state.access = Access(
        accounts=None if service.users is None else Accounts(service.users),
        session_s=service.session_hours * 3600.0,
        secure=service.tls_certificate is not None,
        report=parts.report,
    )
    app.state.parts, app.state.documents = parts, parts.documents
    app.state.live = parts.live
    app.state.recorded = Recorded(parts.configuration)
    app.state.pages, app.state.downloads = Pages(), Downloads()
    routed(app).include_router(_outside)
    app.state.methods = _methods()
    _take_refusals(app)
    return Gate(app, names)


def routed(app: FastAPI) -> FastAPI:
    for part in API:
        app.include_router(part.router, prefix=PREFIX, responses=PROBLEMS, dependencies=[Depends(_only_known)])
    return app


def _methods() -> dict[str, str]:
    taken: dict[str, set[str]] = {}
    for part in API:
        for route in part.router.routes:
            assert isinstance(route, APIRoute)
            taken.setdefault(f"{PREFIX}{route.path}", set()).update(route.methods or ())
    return {path: ", ".join(sorted(methods)) for path, methods in taken.items()}


async def _only_known(request: Request) -> None:
    """Raise ProblemError for a query parameter that the route does not take: a mistyped one is not passed over."""
    known = {each.alias for each in request.scope["route"].dependant.query_params}
    if unknown := next((name for name in request.query_params if name not in known), None):
        takes = f"it takes {', '.join(sorted(known))}" if known else "it takes none"
        raise ProblemError(422, f"query parameter {unknown[:80]!r} is not known to {request.url.path}; {takes}")


def _take_refusals(app: FastAPI) -> None:
    """Make every refusal problem details."""

    async def refused(request: Request, error: Exception) -> Response:
        assert isinstance(error, ProblemError)
        return problem_response(error.status, error.detail, error.headers)

    async def invalid(request: Request, error: Exception) -> Response:
        assert isinstance(error, RequestValidationError)
        return problem_response(422, invalid_in_words(error))

    async def other(request: Request, error: Exception) -> Response:
        assert isinstance(error, HTTPException)
        if error.status_code == 400:  # FastAPI could not read the body
            return problem_response(422, "body: this is no JSON text in UTF-8; /openapi.json says what it holds")
        detail = {
            404: f"there is nothing at {request.url.path}; the pages begin at /, the API is described in /openapi.json",
            405: f"{request.url.path} does not take {request.method}; /openapi.json says what it takes",
        }.get(error.status_code, str(error.detail))
        return problem_response(error.status_code, detail, dict(error.headers or {}))

    async def defect(request: Request, error: Exception) -> Response:
        text = "the monitor has a defect here; the daemon's log has the details. The control goes on without it"
        return problem_response(500, text)

    app.add_exception_handler(Exception, defect)
    app.add_exception_handler(ProblemError, refused)
    app.add_exception_handler(RequestValidationError, invalid)
    app.add_exception_handler(HTTPException, other)


def openapi_document(app: FastAPI) -> dict[str, Any]:
    """Return the OpenAPI document, in which every error is problem details; making it takes 0.1 s and 3 MiB."""
    document = app.openapi()
    for path in document["paths"].values():
        for operation in path.values():
            for status, answer in operation["responses"].items():
                if status >= "400" and (content := answer.get("content", {}).pop("application/json", None)):
                    answer["content"][PROBLEM_TYPE] = content
    document.get("components", {}).get("schemas", {}).pop("HTTPValidationError", None)
    document.get("components", {}).get("schemas", {}).pop("ValidationError", None)
    return document


_outside = APIRouter(include_in_schema=False)


@_outside.get("/metrics")
async def _metrics(request: Request) -> Response:
    if not (request.app.state.parts.configuration.service.http_is_local and asked_here(request)):
        await request.app.state.access.viewer(request)
    text = await request.app.state.recorded.beside(lambda: generate_latest(request.app.state.parts.registry))
    return Response(text, media_type=CONTENT_TYPE_LATEST)


@_outside.get("/healthz")
async def _healthz() -> Response:
    return PlainTextResponse("running\n")


@_outside.get("/openapi.json")
async def _openapi(request: Request) -> Response:
    answer: Response = await request.app.state.recorded.beside(lambda: JSONResponse(openapi_document(request.app)))
    return answer


@_outside.api_route("/{path:path}", methods=["GET", "HEAD"])
async def _page(request: Request, path: str) -> Response:
    if path.startswith("api/"):
        allowed = request.app.state.methods.get(f"/{path}")
        raise HTTPException(404) if allowed is None else HTTPException(405, headers={"allow": allowed})
    answer = request.app.state.pages.answer(request, path)
    if answer is None:
        raise HTTPException(404)
    assert isinstance(answer, Response)
    return answer
