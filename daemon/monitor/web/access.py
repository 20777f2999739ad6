"""Who may look and who may act: accounts, logins, sessions, and the checks of every request."""

import base64
import hashlib
import hmac
import ipaddress
import secrets
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Annotated, Any

from fastapi import Depends, Request

from daemon.monitor.accounts import Accounts, Role
from daemon.monitor.passwords import MOST_NAME, Passwords, TooManyWrongError, WrongPasswordError, wrong_passwords
from daemon.monitor.web.problems import ProblemError

IDLE_S = 1800.0
"""A session that nobody used for so long ends; an open page uses it [s]."""
MOST_SESSIONS = 256
"""So many sessions are kept; the one that was not used longest makes room."""
CSRF_HEADER = "x-csrf-token"
Report = Callable[[str, str, str | None], object]
"""Takes the kind of an event, its text and the person."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Person:
    """Who asks."""

    name: str
    """'' for anybody, where no account is needed to look."""
    role: Role
    address: str
    csrf: str = ""
    expires_utc_s: float | None = None

    @property
    def in_audit(self) -> str:
        return f"{self.name} ({self.role}, monitor, {self.address})"


@dataclass(slots=True, kw_only=True)
class Session:
    name: str
    password_hash: str
    csrf: str
    ends_s: float
    ends_utc_s: float
    used_s: float


@dataclass(kw_only=True)
class Access:
    """Decides for every request who asks and what they may."""

    accounts: Accounts | None
    """None: whoever reaches the monitor may look, nobody may act."""
    session_s: float
    secure: bool
    """Reached by TLS alone."""
    report: Report
    now_s: Callable[[], float] = time.monotonic
    _sessions: dict[str, Session] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Prepare the check of passwords."""
        self._passwords, self._wrong = Passwords(self.now_s), wrong_passwords(self.report)

    @property
    def cookie(self) -> str:
        return "__Host-toolpoint" if self.secure else "toolpoint"

    async def login(self, name: str, password: str, address: str) -> tuple[str, Person]:
        """Return a new session's token and who it is; raises ProblemError."""
        await self._check_password(name, password, address)
        accounts = self._known()
        account, now_s = accounts[name], self.now_s()
        token = secrets.token_urlsafe(32)
        session = Session(
            name=name,
            password_hash=account.password_hash,
            csrf=secrets.token_urlsafe(32),
            ends_s=now_s + self.session_s,
            ends_utc_s=time.time() + self.session_s,
            used_s=now_s,
        )
        self._sessions[_digest(token)] = session
        while len(self._sessions) > MOST_SESSIONS:
            del self._sessions[min(self._sessions, key=lambda key: self._sessions[key].used_s)]
        person = self._person(session, account.role, address)
        self.report("access", "logged in to the monitor", person.in_audit)
        return token, person

    async def _check_password(self, name: str, password: str, address: str) -> None:
        """Raise ProblemError unless this is the account's password."""
        accounts = self._known()
        try:
            await self._passwords.check(accounts, name, password, address)
        except TooManyWrongError as error:
            retry = {"retry-after": str(int(error.wait_s) + 1)}
            raise ProblemError(429, str(error), retry) from error
        except WrongPasswordError as error:
            self._wrong((f"wrong name or password for the monitor ({name[:MOST_NAME]!r})", address))
            raise ProblemError(401, str(error)) from error

    def _known(self) -> Any:
        if self.accounts is None:
            raise ProblemError(
                403,
                "this monitor has no accounts, so nobody can log in and act: make one with `toolpoint users add`, name "
                "its file in service.users, or use the commands of `toolpoint` on the computer itself",
            )
        accounts = self.accounts.now()
        if self.accounts.problem:
            raise ProblemError(503, self.accounts.problem)
        return accounts

    def logout(self, request: Request) -> None:
        session = self._sessions.pop(_digest(request.cookies.get(self.cookie, "")), None)
        if session is not None:
            self.report("access", "logged out of the monitor", f"{session.name} (monitor, {address_of(request)})")

    def by_session(self, request: Request) -> Person | None:
        """Return who is logged in, None where nobody is."""
        token = request.cookies.get(self.cookie)
        if token is None or self.accounts is None:
            return None
        key, now_s = _digest(token), self.now_s()
        session = self._sessions.get(key)
        if session is None:
            return None
        account = self.accounts.now().get(session.name)
        ended = now_s >= session.ends_s or now_s - session.used_s >= IDLE_S
        if ended or account is None or account.password_hash != session.password_hash:
            del self._sessions[key]
            return None
        session.used_s = now_s
        return self._person(session, account.role, address_of(request))

    def _person(self, session: Session, role: Role, address: str) -> Person:
        return Person(
            name=session.name, role=role, address=address, csrf=session.csrf, expires_utc_s=session.ends_utc_s
        )

    async def viewer(self, request: Request) -> Person:
        """Return who looks; raises ProblemError when they must log in first."""
        if self.accounts is None:
            return Person(name="", role=Role.VIEWER, address=address_of(request))
        if (person := self.by_session(request)) is not None:
            return person
        if (given := _basic(request)) is not None:
            await self._check_password(*given, address_of(request))
            return Person(name=given[0], role=self._known()[given[0]].role, address=address_of(request))
        raise ProblemError(401, "log in first: POST /api/v1/session, or HTTP Basic for reading alone")

    async def actor(self, request: Request, needed: Role) -> Person:
        """Return who acts; raises ProblemError unless they are logged in and may."""
        self._known()
        person = self.by_session(request)
        if person is None:
            raise ProblemError(401, "log in first: POST /api/v1/session")
        if not hmac.compare_digest(request.headers.get(CSRF_HEADER, "").encode(), person.csrf.encode()):
            raise ProblemError(403, f"the header {CSRF_HEADER} does not hold this session's token; load the page again")
        if not person.role.covers(needed):
            self.report("access", f"refused: {request.url.path} takes the role {needed}", person.in_audit)
            raise ProblemError(403, f"{person.name} is {person.role}; this takes the role {needed}")
        return person


def _digest(token: str) -> str:
    return hashlib.sha256(token.encode()).hexdigest()


def _basic(request: Request) -> tuple[str, str] | None:
    """Return name and password of HTTP Basic, None without."""
    scheme, _, value = request.headers.get("authorization", "").partition(" ")
    if scheme.lower() != "basic":
        return None
    try:
        name, _, password = base64.b64decode(value, validate=True).decode().partition(":")
    except ValueError as error:
        raise ProblemError(401, "the header Authorization is no HTTP Basic") from error
    return name, password


def address_of(request: Request) -> str:
    return request.client.host if request.client is not None else "unknown"


def asked_here(request: Request) -> bool:
    """Return whether a program of this computer asks for itself: a proxy passes on who asks, or by which name."""
    return is_local_name(address_of(request)) and is_local_name(request.url.hostname or "")


def is_local_name(name: str) -> bool:
    """Return whether a host name means this computer for every browser."""
    if name == "localhost":
        return True
    try:
        return ipaddress.ip_address(name.strip("[]")).is_loopback
    except ValueError:
        return False


def access_of(request: Request) -> Access:
    found = request.app.state.access
    assert isinstance(found, Access)
    return found


async def _viewer(request: Request) -> Person:
    return await access_of(request).viewer(request)


async def _operator(request: Request) -> Person:
    return await access_of(request).actor(request, Role.OPERATOR)


Viewer = Annotated[Person, Depends(_viewer)]
Operator = Annotated[Person, Depends(_operator)]
