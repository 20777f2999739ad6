"""`toolpoint fleet simulate`: starts the processes of a simulated fleet, restarts those that die, and counts."""

import contextlib
import math
import multiprocessing
import os
import re
import threading
import time
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any, Self, TypeVar
from urllib.parse import unquote, urlsplit

import numpy as np
import psycopg
from psycopg.conninfo import conninfo_to_dict
from psycopg.pq import Conninfo
from pydantic import BaseModel, ValidationError

from config.schema.plant_store import PlantStoreConfig, SubscriptionConfig
from config.schema.sinks import MqttSinkConfig, PostgresqlConfig, SinkConfig
from daemon.history.cursors import Cursor, Position, cursor_path
from daemon.history.layout import MachineLayout
from daemon.simulation import SimulationError
from daemon.simulation.fleet.counting import ArrivalWatch, Rows, count_rows, stored_rows
from daemon.simulation.fleet.machines import FleetPlan, Recorded, fleet_configuration, run_machines
from daemon.simulation.fleet.senders import run_senders, run_store
from daemon.sinks.broker import Broker, Message
from daemon.sinks.contract import SinkError
from daemon.sinks.database import Database
from daemon.sinks.outbox import STREAMS, Outbox

SINK = "plant"
TOPIC = "toolpoint-simulated"
"""Apart from the topics of real machines."""
BROKER_PASSWORD = "TOOLPOINT_BROKER_PASSWORD"
"""Of the environment: what stands in a command line is seen by every account of the computer."""
SENDERS = 2
"""Processes that send; each has its share of the machines."""
ALL_TAKEN_WITHIN_S = 300.0
"""What waits before the machines go on, and when they have ended, must be taken within this time."""
NOTHING_MORE_S = 30.0
"""After so long without a row none is on its way any more."""
WATCH_PERIOD_S = 0.2
STOP_WITHIN_S = 30.0
SPAWN = multiprocessing.get_context("spawn")
Body = tuple[Callable[..., None], tuple[Any, ...]]
"""What a process runs, and its arguments."""
Say = Callable[[str], None]
Made = TypeVar("Made", bound=BaseModel)


@dataclass(frozen=True, slots=True, kw_only=True)
class Route:
    """How the histories go to a database."""

    dsn: str
    sink: SinkConfig
    store: PlantStoreConfig | None = None
    """What takes them from a broker, where they go over one."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FleetResult:
    """What became of the histories of a fleet."""

    plan: FleetPlan
    rows: Rows
    recorded: int
    """Rows that the machines gave to their stores."""
    dropped: int
    behind_s: float
    lags_s: list[float]
    cpu_s: Mapping[str, float]
    """Processor time by kind of process."""
    restarts: Mapping[str, int]
    """Processes that died and were started again, by kind."""
    waiting: int
    """Rows that no sink had acknowledged when patience ended."""

    @property
    def complete(self) -> bool:
        """Everything that was recorded stands in the database, once."""
        rows = self.rows
        return not (rows.lost or rows.duplicates or self.waiting or self.dropped) and rows.stored == self.recorded

    def as_json(self) -> dict[str, Any]:
        """Return it as `--json` writes it."""
        p50, p99 = (round(float(x), 3) for x in np.percentile(self.lags_s, (50, 99))) if self.lags_s else (None, None)
        return {
            "machines": self.plan.machines,
            "minutes": self.plan.minutes,
            "speed": self.plan.speed,
            "start_utc_s": self.plan.start_utc_s,
            "rows": {"recorded": self.recorded, **asdict(self.rows), "waiting": self.waiting},
            "lag_s": {"p50": p50, "p99": p99, "max": round(max(self.lags_s), 3) if self.lags_s else None},
            "behind_s": round(self.behind_s, 3),
            "cpu_s": round(sum(self.cpu_s.values()), 2),
            "cpu_of_s": {name: round(value, 2) for name, value in self.cpu_s.items()},
            "restarts": dict(self.restarts),
        }


class Keeper:
    """Processes that are started again when they are killed; a name is a kind and a number."""

    def __init__(self, bodies: Mapping[str, Body]) -> None:
        self._bodies = bodies
        self._processes: dict[str, BaseProcess] = {}
        self._used_s: dict[int, float] = {}
        self._kind_of: dict[int, str] = {}
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="keeper", daemon=True)
        self.restarts: Counter[str] = Counter()
        self.broken = ""
        """A process that ended with an error of its own, which no restart helps."""

    @property
    def names(self) -> tuple[str, ...]:
        """Every process that is kept."""
        return tuple(self._bodies)

    def pid(self, name: str) -> int | None:
        """Return the number of the process that runs under a name."""
        return self._processes[name].pid

    def check(self) -> None:
        """Raise SimulationError when a process ended by itself."""
        if self.broken:
            raise SimulationError(f"the process of the {self.broken} ended early; what it said stands above")

    def cpu_s(self) -> dict[str, float]:
        """Return the processor time of all processes so far, those that died with them, by kind [s]."""
        found: Counter[str] = Counter()
        for pid, used_s in self._used_s.items():
            found[self._kind_of[pid]] += used_s  # type: ignore[assignment]
        return dict(found)

    def __enter__(self) -> Self:
        for name in self._bodies:
            self._start(name)
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()
        self._measure()
        for process in self._processes.values():
            process.terminate()
        for process in self._processes.values():
            process.join(STOP_WITHIN_S)
            process.kill()
            process.join()

    def _start(self, name: str) -> None:
        target, arguments = self._bodies[name]
        process = SPAWN.Process(target=target, args=arguments, name=name, daemon=True)
        process.start()
        self._processes[name] = process
        assert process.pid is not None
        self._kind_of[process.pid] = name.partition(" ")[0]

    def _run(self) -> None:
        while not self._stop.wait(WATCH_PERIOD_S):
            self._measure()
            for name, process in list(self._processes.items()):
                if process.exitcode is not None and process.exitcode > 0:
                    self.broken = name
                    return
                if process.exitcode is not None:
                    self.restarts[name.partition(" ")[0]] += 1
                    self._start(name)

    def _measure(self) -> None:
        for process in self._processes.values():
            if process.pid is not None and (used_s := processor_s(process.pid)) is not None:
                self._used_s[process.pid] = used_s


def processor_s(pid: int) -> float | None:
    """Return the processor time of a process so far [s]; None when it is gone."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text("ascii").rpartition(")")[2].split()
    except OSError:
        return None
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def plan_of(folder: Path, machines: int, minutes: float, speed: float, dsn: str) -> FleetPlan:
    """Return a run that ends about now in simulated time, but begins after what the database has of these machines."""
    start_s = math.floor(time.time() - 60.0 * minutes * (1.0 - 1.0 / speed))
    plan = FleetPlan(folder=folder, machines=machines, minutes=minutes, speed=speed, start_utc_s=float(start_s))
    try:
        with psycopg.connect(dsn, connect_timeout=10) as connection:
            found = connection.execute("SELECT to_regclass('toolpoint.deliveries')").fetchone()
            if found is None or found[0] is None:
                return plan
            newest = connection.execute(
                "SELECT extract(epoch FROM max(newest))::float8 FROM toolpoint.deliveries WHERE machine = ANY(%s)",
                (list(plan.names),),
            ).fetchone()
            # Their new stores need not wait for those of the last run, whose senders have ended.
            connection.execute(
                "UPDATE toolpoint.deliveries SET delivered = delivered - interval '1 minute' WHERE machine = ANY(%s)",
                (list(plan.names),),
            )
    except psycopg.Error as error:
        raise SimulationError(f"--postgres: {' '.join(str(error).split())}") from error
    if newest is not None and newest[0] is not None and newest[0] >= start_s:
        return replace(plan, start_utc_s=math.floor(newest[0]) + 60.0)
    return plan


def database_of(dsn: str, folder: Path) -> PostgresqlConfig:
    """Return the section of a database; its password goes into a file of the folder."""
    try:
        known = _of_environment() | conninfo_to_dict(dsn)
    except psycopg.Error as error:
        # what it quotes may be the password, or a part of it
        problem = re.sub(r'".*"', "…", " ".join(str(error).split()))
        raise SimulationError(f"--postgres: {problem}: give a DSN such as postgresql://user@host/database") from error
    if "@" in f"{known.get('host')}"[1:] + f"{known.get('dbname')}":  # a socket's name may begin with it
        raise SimulationError(
            "--postgres: write / @ : of a password as %2F %40 %3A, in postgresql://user@host/database"
        )
    if (mode := known.get("sslmode", "disable")) not in ("disable", "verify-full"):
        raise SimulationError(f"--postgres: sslmode={mode} is not what a sink does: give disable or verify-full")
    there: dict[str, Any] = {"host": known.get("host", "localhost"), "tls": mode == "verify-full"}
    names = {"dbname": "database", "user": "user_name"}
    there |= {key: known[name] for name, key in names.items() if name in known}
    if not (port := str(known.get("port", 5432))).isdecimal():
        raise SimulationError(f"--postgres: port={port}: give the port of one server")
    there |= {"port": int(port)}
    if "sslrootcert" in known:
        there["ca_certificate"] = Path(str(known["sslrootcert"]))
    if "password" in known:
        there["password_file"] = _secret(folder / "database-password", str(known["password"]))
    return _made("--postgres", PostgresqlConfig, there)


def _of_environment() -> dict[str, Any]:
    """Return what PGHOST and its like say of a server, as the library does where the DSN does not."""
    found = {each.keyword.decode(): each.val for each in Conninfo.get_defaults()}
    names = ("host", "port", "dbname", "user", "password")
    return {name: value.decode() for name in names if (value := found.get(name)) is not None}


def _made(option: str, section: type[Made], there: Mapping[str, Any]) -> Made:
    """Return a section of what an option says; raises SimulationError."""
    try:
        return section.model_validate(there)
    except ValidationError as error:
        wrong = error.errors(include_url=False)[0]
        raise SimulationError(f"{option}: {' '.join(map(str, wrong['loc']))}: {wrong['msg']}") from None


def broker_of(url: str, folder: Path) -> dict[str, Any]:
    """Return the keys of a broker; its password goes into a file of the folder."""
    try:
        parts = urlsplit(url)
        port = parts.port
    except ValueError as error:
        raise SimulationError(f"--mqtt: {error}") from None
    if parts.scheme not in ("mqtt", "mqtts") or not parts.hostname:
        raise SimulationError("--mqtt: give mqtt://host:port, or mqtts:// for TLS")
    there: dict[str, Any] = {"host": parts.hostname, "port": port, "tls": parts.scheme == "mqtts", "topic": TOPIC}
    if parts.username is not None:
        there["user_name"] = unquote(parts.username)
    password = os.environ.get(BROKER_PASSWORD) if parts.password is None else unquote(parts.password)
    if password is not None and parts.username is not None:
        there["password_file"] = _secret(folder / "mqtt-password", password)
    return there


def check_route(route: Route) -> None:
    """Connect once as the sinks and the store will; raises SimulationError, with what to do."""
    there = route.sink.postgresql if route.store is None else route.store.postgresql
    assert there is not None
    database = Database(there, "--postgres", "toolpoint fleet simulate")
    try:
        database.open()
    except SinkError as error:
        raise SimulationError(f"{error}; host, port, dbname, user and password must stand in the DSN") from None
    finally:
        database.close()
    if route.sink.mqtt is None:
        return
    broker = Broker(route.sink.mqtt, "--mqtt", f"{TOPIC}-look")
    try:
        broker.connect(Message(topic=f"{TOPIC}/look/status", payload=b"offline"))
    except SinkError as error:
        raise SimulationError(str(error)) from None
    finally:
        broker.close()


def _secret(path: Path, text: str) -> Path:
    path.touch(mode=0o600)
    path.write_text(text, encoding="utf-8")
    return path


def route_of(dsn: str, mqtt: str | None, folder: Path, period_s: float, resend_s: float = 10.0) -> Route:
    """Return how the histories go to a database: by a sink of its own, or through a broker."""
    database = database_of(dsn, folder)
    sink: dict[str, Any] = {"name": SINK, "period_s": period_s}
    if mqtt is None:
        return Route(dsn=dsn, sink=SinkConfig(driver="postgresql", postgresql=database, **sink))
    broker = broker_of(mqtt, folder)
    section = _made("--mqtt", MqttSinkConfig, broker | {"discovery": None, "resend_s": resend_s})
    subscription = _made("--mqtt", SubscriptionConfig, broker | {"client_id": f"{TOPIC}-store"})
    return Route(
        dsn=dsn,
        sink=SinkConfig(driver="mqtt", mqtt=section, **sink),
        store=PlantStoreConfig(mqtt=subscription, postgresql=database),
    )


def simulate_fleet(
    plan: FleetPlan,
    route: Route,
    *,
    say: Say = lambda _sentence: None,
    began: Callable[[Keeper], None] = lambda _keeper: None,
) -> FleetResult:
    """Run a fleet to its end and count; `began` gets what keeps the senders up when everything runs."""
    machines = [(name, plan.store(number)) for number, name in enumerate(plan.names)]
    here, there = SPAWN.Pipe()
    recording = SPAWN.Process(target=run_machines, args=(plan, there), name="machines", daemon=True)
    recording.start()
    there.close()
    _received(here, recording)
    base = fleet_configuration()
    bodies: dict[str, Body] = {
        f"senders {turn + 1}": (run_senders, (base, machines[turn::SENDERS], route.sink))
        for turn in range(min(SENDERS, plan.machines))
    }
    if route.store is not None:
        bodies = {"store": (run_store, (route.store,)), **bodies}  # before it subscribes nothing is taken
    lines = tuple(MachineLayout.from_configuration(base).lines)
    with ArrivalWatch(route.dsn, plan.names, lines) as arrivals, Keeper(bodies) as keeper:
        _all_taken(plan, keeper)  # every sender is at work, and the tables are there
        here.send(None)
        who = "1 machine records" if plan.machines == 1 else f"{plan.machines} machines record"
        say(f"{who} {plan.minutes:g} min at {plan.speed:g} times real time")
        began(keeper)
        try:
            recorded: Recorded = _received(here, recording, keeper)
        finally:
            recording.terminate()
            recording.join()
        say(f"{recorded.rows} rows recorded; waiting for the senders")
        waiting = _all_taken(plan, keeper)
        _all_stored(plan, route, recorded.rows)
    return FleetResult(
        plan=plan,
        rows=_counted(plan, route.dsn),
        recorded=recorded.rows,
        dropped=recorded.dropped,
        behind_s=recorded.behind_s,
        lags_s=arrivals.lags_s(plan, recorded.commits),
        cpu_s={"machines": recorded.cpu_s, **keeper.cpu_s()},
        restarts=keeper.restarts,
        waiting=waiting,
    )


def _received(connection: Connection, process: BaseProcess, keeper: Keeper | None = None) -> Any:
    while keeper is not None and not connection.poll(WATCH_PERIOD_S):
        keeper.check()
    try:
        return connection.recv()
    except EOFError:
        process.join()
        raise SimulationError("the process of the machines ended early; what it said stands above") from None


def _counted(plan: FleetPlan, dsn: str) -> Rows:
    try:
        with psycopg.connect(dsn, autocommit=True, connect_timeout=10) as connection:
            return count_rows(plan, connection, SINK)
    except psycopg.Error as error:
        why = " ".join(str(error).split())
        raise SimulationError(f"--postgres: what arrived cannot be counted: {why}") from error


def _all_taken(plan: FleetPlan, keeper: Keeper) -> int:
    """Wait until the sinks have acknowledged everything; return how many rows still wait when patience ends."""
    deadline_s = time.monotonic() + ALL_TAKEN_WITHIN_S
    while True:
        waiting = sum(_waiting(plan.store(number)) for number in range(plan.machines))
        if waiting == 0 or time.monotonic() > deadline_s:
            return waiting
        keeper.check()
        time.sleep(WATCH_PERIOD_S)


def _all_stored(plan: FleetPlan, route: Route, rows: int) -> None:
    """Wait until so many rows are in the database, or for a while none has come: what was taken may be on its way."""
    if route.store is None:
        return
    before, since_s = -1, time.monotonic()
    while before < rows and time.monotonic() - since_s < NOTHING_MORE_S:
        time.sleep(WATCH_PERIOD_S)
        with contextlib.suppress(psycopg.Error), psycopg.connect(route.dsn, connect_timeout=5) as connection:
            if (now := stored_rows(plan, connection)) != before:
                before, since_s = now, time.monotonic()


def _waiting(store: Path) -> int:
    cursor = Cursor.read(cursor_path(store, SINK)) or Cursor()
    with Outbox(store) as outbox:
        return sum(
            outbox.waiting(stream, cursor.positions.get(name, Position()))[0] for name, stream in STREAMS.items()
        )
