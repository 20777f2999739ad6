"""What every request passes: host, origin, headers of the answer, times within which both sides must go on."""

import asyncio
from collections.abc import Awaitable, Callable, Collection
from contextlib import suppress
from typing import Any
from urllib.parse import urlsplit

import structlog
from starlette.datastructures import Headers, MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from daemon.monitor.web.access import is_local_name
from daemon.monitor.web.problems import ProblemError, problem_response
from daemon.rate_limit import RateLimit

log = structlog.get_logger(__name__)

RECEIVE_S = 10.0
"""A request's body must have arrived within this [s]."""
SEND_S = 10.0
"""Each piece of an answer must have been taken within this [s]."""
MOST_BODY = 65536
"""A longer body is refused, and the connection ended: the rest of it is not read [byte]."""
CLOSE = {"connection": "close"}
SAFE_METHODS = frozenset({"GET", "HEAD", "OPTIONS"})
HEADERS = {
    "content-security-policy": "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; "
    "font-src 'self'; connect-src 'self'; manifest-src 'self'; base-uri 'none'; form-action 'self'; "
    "frame-ancestors 'none'",
    "x-content-type-options": "nosniff",
    "x-frame-options": "DENY",
    "referrer-policy": "no-referrer",
    "cross-origin-opener-policy": "same-origin",
    "cross-origin-resource-policy": "same-origin",
    "permissions-policy": "camera=(), geolocation=(), microphone=()",
    "cache-control": "no-store",
}


class TooSlowError(Exception):
    """The other side did not go on in time; its connection is ended."""


class Gate:
    """Passes a request on when its host and origin are ours; bounds how long either side may take."""

    def __init__(self, app: ASGIApp, names: Callable[[], Collection[str]]) -> None:
        """`names`: by which the monitor is reached now, beside those of this computer itself."""
        self._app, self._names = app, names
        self._turn = asyncio.Lock()
        self._defect = RateLimit[tuple[str, Exception]](_log_defect)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            return
        complete = False

        async def timed_send(message: Message) -> None:
            nonlocal complete
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                for name, value in HEADERS.items():
                    headers.setdefault(name, value)
            await within(SEND_S, send(message))
            complete = message["type"] == "http.response.body" and not message.get("more_body", False)

        try:
            refused = self._refused(scope)
            if refused:
                await problem_response(403, refused)(scope, receive, timed_send)
                return
            body = await _body(receive)
            async with self._turn:  # one request in a turn of the loop: between two of them the control has its own
                await asyncio.sleep(0)
            await self._app(scope, _of(body, receive), timed_send)
        except ProblemError as error:
            with suppress(TooSlowError):
                await problem_response(error.status, error.detail, error.headers)(scope, receive, timed_send)
        except TooSlowError:
            _abort(scope)
        except Exception as error:  # a defect in an answer: it is logged, this connection ends, the server goes on
            self._defect((scope["path"], error))
            if not complete:
                _abort(scope)

    def _refused(self, scope: Scope) -> str:
        """Return why a request is none of ours, '' when it is."""
        headers = Headers(scope=scope)
        if "content-length" in headers and "transfer-encoding" in headers:  # a proxy may have ended it elsewhere
            raise ProblemError(400, "content-length and transfer-encoding contradict each other; send one", CLOSE)
        host, name = headers.get("host", ""), ""
        with suppress(ValueError):  # of half an IPv6 address, which is no name of ours
            name = urlsplit(f"//{host}").hostname or ""
        if not (is_local_name(name) or {name, f"*.{name.partition('.')[2]}"} & set(self._names())):
            return (
                f"this monitor is not called {name[:80]!r}; use localhost, an address or a name of its certificate "
                "(service.tls_certificate)"
            )
        site = headers.get("sec-fetch-site", "same-origin")
        if site in ("cross-site", "same-site") and headers.get("sec-fetch-mode") != "navigate":
            return "another web site has sent this request; open the monitor itself"
        if scope["method"] in SAFE_METHODS:
            return ""
        origin = headers.get("origin")
        if origin is not None and origin != f"{scope['scheme']}://{host}":
            return f"a page of {origin[:80]} has sent this request; only the monitor's own pages may act"
        return ""


def _log_defect(defect: tuple[str, Exception], left_out: int) -> None:
    path, error = defect
    log.error("request.defect", path=path, exc_info=error, **({"left_out": left_out} if left_out else {}))


def _abort(scope: Scope) -> None:
    abort: Callable[[], Any] = scope.get("state", {}).get("abort", lambda: None)
    abort()


async def within(seconds: float, work: Awaitable[None]) -> None:
    """Wait for what the other side must do in time; raises TooSlowError when it does not."""
    try:
        async with asyncio.timeout(seconds):
            await work
    except TimeoutError:
        raise TooSlowError from None


async def _body(receive: Receive) -> bytes:
    """Return the whole body of a request; raises ProblemError when it is too long, or does not arrive in time."""
    body, more = b"", True
    try:
        async with asyncio.timeout(RECEIVE_S):
            while more:
                message = await receive()
                if message["type"] == "http.disconnect":
                    raise TooSlowError
                body += message.get("body", b"")
                more = message.get("more_body", False)
                if len(body) > MOST_BODY:
                    raise ProblemError(
                        413, f"the body is longer than {MOST_BODY} byte; no request of this API is", CLOSE
                    )
    except TimeoutError:
        raise ProblemError(408, f"the body has not arrived within {RECEIVE_S:g} s; send it again", CLOSE) from None
    return body


def _of(body: bytes, receive: Receive) -> Receive:
    """Return a `receive` that hands over a body that is here, and then waits for the end of the connection."""
    handed = False

    async def receive_body() -> Message:
        nonlocal handed
        if handed:
            return await receive()
        handed = True
        return {"type": "http.request", "body": body, "more_body": False}

    return receive_body
