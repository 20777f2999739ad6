"""The monitor over real HTTP on a control task in this process, with accounts and certificates where a test wants."""

import asyncio
import contextlib
import http.client
import json
import ssl
from collections.abc import AsyncIterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from control_rig import HandClock, Rig, machine, record_for, running
from memory_cnc import MemoryNc

from config.schema import Configuration
from daemon.monitor.accounts import Account, Role, hashed, write_accounts
from daemon.monitor.web.application import MonitorParts
from daemon.monitor.web.documents import Documents
from daemon.monitor.web.live import Live
from daemon.monitor.web.metrics import PresentMetrics
from daemon.monitor.web.serving import serve_monitor
from daemon.monitoring import ModelsOnDisk
from daemon.simulation.processes import free_port

PASSWORD = "long enough a password"
PATIENCE_S = 60.0


def accounts_file(directory: Path, **roles: str) -> Path:
    """Accounts with one password for all."""
    path = directory / "users"
    password_hash = hashed(PASSWORD)
    write_accounts(
        path, {name: Account(name=name, role=Role(role), password_hash=password_hash) for name, role in roles.items()}
    )
    return path


@dataclass
class Answer:
    """What came back."""

    status: int
    headers: dict[str, str]
    body: bytes

    @property
    def json(self) -> Any:
        return json.loads(self.body)

    @property
    def detail(self) -> str:
        assert self.headers["content-type"] == "application/problem+json", self.body[:200]
        assert self.json["status"] == self.status and self.json["title"]
        return str(self.json["detail"])


@dataclass
class Browser:
    """A client that keeps its cookies and sends what a browser sends."""

    port: int
    tls: ssl.SSLContext | None = None
    cookies: dict[str, str] = field(default_factory=dict)
    csrf: str = ""

    def ask_now(self, method: str, path: str, body: Any = None, headers: dict[str, str] | None = None) -> Answer:
        connection: http.client.HTTPConnection
        if self.tls is not None:
            connection = http.client.HTTPSConnection("localhost", self.port, timeout=PATIENCE_S, context=self.tls)
        else:
            connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=PATIENCE_S)
        sent = {"cookie": "; ".join(f"{key}={value}" for key, value in self.cookies.items())} if self.cookies else {}
        if body is not None:
            sent["content-type"] = "application/json"
        if self.csrf and method not in ("GET", "HEAD"):
            sent["x-csrf-token"] = self.csrf
        with contextlib.closing(connection):
            content = None if body is None else body if isinstance(body, bytes) else json.dumps(body)
            connection.request(method, path, content, sent | (headers or {}))
            answer = connection.getresponse()
            found = {key.lower(): value for key, value in answer.getheaders()}
            if (cookie := found.get("set-cookie")) is not None:
                name, _, value = cookie.partition(";")[0].partition("=")
                self.cookies[name] = value.strip('"')
            return Answer(answer.status, found, answer.read())

    async def ask(self, method: str, path: str, body: Any = None, headers: dict[str, str] | None = None) -> Answer:
        return await asyncio.to_thread(self.ask_now, method, path, body, headers)

    async def get(self, path: str, **headers: str) -> Answer:
        return await self.ask("GET", path, headers=headers)

    async def login(self, name: str, password: str = PASSWORD) -> Answer:
        answer = await self.ask("POST", "/api/v1/session", {"name": name, "password": password})
        if answer.status == 200:
            self.csrf = answer.json["csrf"]
        return answer


@dataclass
class MonitorBench:
    """A running monitor."""

    configuration: Configuration
    rig: Rig
    port: int
    parts: MonitorParts
    tls: ssl.SSLContext | None = None
    task: "asyncio.Task[None] | None" = None
    """What serves it; whoever cancels it stops the daemon for its viewers."""

    @property
    def live(self) -> Live:
        return self.parts.live

    def browser(self) -> Browser:
        return Browser(self.port, self.tls)

    def events(self) -> list[tuple[str, str | None]]:
        """Text and person of what the audit holds of the monitor."""
        from daemon.history.reader import HistoryReader

        with HistoryReader(self.configuration.history.path) as reader:
            return [(each.text, each.person) for each in reader.events(0.0, 1e11) if each.kind == "access"]


def parts_of(rig: Rig, configuration: Configuration) -> MonitorParts:
    documents = Documents(configuration, rig.clock, rig.snapshots, rig.telemetry)
    rig.telemetry.registry.register(PresentMetrics(configuration, rig.snapshots, documents))
    return MonitorParts(
        configuration=configuration,
        clock=rig.clock,
        board=rig.snapshots,
        desk=rig.desk(),
        registry=rig.telemetry.registry,
        documents=documents,
        live=Live(documents, rig.snapshots),
        report=rig.history.event,
        models=ModelsOnDisk(configuration, rig.snapshots).document,
    )


@contextlib.asynccontextmanager
async def monitor(directory: Path, tls: ssl.SSLContext | None = None, **service: Any) -> AsyncIterator[MonitorBench]:
    """Serve the monitor of a rig; `service` changes that section of the configuration."""
    port = free_port()
    configuration = machine(directory)
    configuration = configuration.model_copy(
        update={"service": configuration.service.model_copy(update={"http_port": port} | service)}
    )
    clock = HandClock()
    rig = Rig(configuration, MemoryNc(configuration, clock), clock, record=record_for(configuration))
    async with running(rig):
        serving = asyncio.Event()
        parts = parts_of(rig, configuration)
        task = asyncio.create_task(serve_monitor(parts, serving.set))
        waiting = asyncio.create_task(serving.wait())
        await asyncio.wait([task, waiting], return_when=asyncio.FIRST_COMPLETED)
        if task.done():
            task.result()
        try:
            yield MonitorBench(configuration, rig, port, parts, tls, task)
        finally:
            task.cancel()
            await asyncio.gather(task, return_exceptions=True)
