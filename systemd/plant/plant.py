"""A plant in a box: broker, PostgreSQL, Grafana, and ten simulated machines whose histories go there.

python systemd/plant/plant.py [--way compose|packages] [--machines 10] [--hours 8] [--folder .plant]

With Docker and its compose the servers come from compose.yaml beside this file. Without, Debian's packages
`postgresql` and `mosquitto` are started as processes of this command, and Grafana where `grafana` is installed. Ctrl-C
ends everything; what was stored stays in the folder, or in the volumes of compose.
"""

import argparse
import contextlib
import os
import pwd
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

import psycopg
from psycopg import sql

HERE = Path(__file__).resolve().parent
PASSWORD = os.environ.get("TOOLPOINT_PASSWORD", "simulated")
GRAFANA_PASSWORD = os.environ.get("TOOLPOINT_GRAFANA_PASSWORD", "simulated")
DATABASE_PORT = int(os.environ.get("TOOLPOINT_DATABASE_PORT", "5432"))
BROKER_PORT = int(os.environ.get("TOOLPOINT_BROKER_PORT", "1883"))
GRAFANA_PORT = int(os.environ.get("TOOLPOINT_GRAFANA_PORT", "3000"))
PROGRAMS = [
    Path("/usr/sbin"),
    *sorted(Path("/usr/lib/postgresql").glob("*/bin"), reverse=True),
    Path("/usr/share/grafana/bin"),
]
PROJECT = "toolpoint-plant"
PATIENCE_S = 120.0
FASTEST = 480.0
"""Simulated seconds per second while the hours before now are filled."""
NO_COMPOSE = (
    "`docker info`, or `docker compose version` (`docker-compose version`), does not work here: install and start "
    "Docker with its compose plugin, let this user reach it, or leave --way out"
)
NO_GRAFANA = (
    "Grafana is not installed; it is no package of Debian: install `grafana` from its maker's package repository, or "
    "Docker, and start this again. The histories go to the database all the same."
)


def program(name: str) -> str | None:
    """Return where a program is."""
    return shutil.which(name, path=os.pathsep.join([os.environ.get("PATH", ""), *map(str, PROGRAMS)]))


def _works(*words: str) -> bool:
    try:
        return subprocess.run(words, capture_output=True, check=False).returncode == 0
    except FileNotFoundError:
        return False


def compose() -> list[str] | None:
    """Return the words before those of `docker compose`; None where it, or Docker's engine, does not work."""
    if not _works("docker", "info"):
        return None
    for words in (["docker", "compose"], ["docker-compose"]):
        if _works(*words, "version"):
            return [*words, "--project-name", PROJECT, "--file", str(HERE / "compose.yaml")]
    return None


@contextlib.contextmanager
def by_compose(words: Sequence[str]) -> Iterator[bool]:
    """Run the servers from their images."""
    if subprocess.run([*words, "up", "--detach"], check=False).returncode != 0:
        sys.exit("the servers did not start: compose says above why; ports are set by TOOLPOINT_..._PORT")
    try:
        yield True
    finally:
        subprocess.run([*words, "stop"], check=False)


@contextlib.contextmanager
def by_packages(folder: Path) -> Iterator[bool]:
    """Run the servers of Debian's packages; yields whether Grafana is among them."""
    missing = [package for name, package in (("initdb", "postgresql"), ("mosquitto", "mosquitto")) if not program(name)]
    if missing:
        sys.exit(f"neither Docker nor the packages are there: apt-get install {' '.join(missing)}")
    with contextlib.ExitStack() as stack:
        stack.enter_context(_database(folder / "database"))
        stack.enter_context(_broker(folder / "broker"))
        grafana = program("grafana")
        if grafana is not None:
            stack.enter_context(_grafana(grafana, folder / "grafana"))
        yield grafana is not None


@contextlib.contextmanager
def _running(words: Sequence[str], log: Path, user: str | None = None, **more: str) -> Iterator[None]:
    with log.open("ab") as output:
        process = subprocess.Popen(
            words, stdout=output, stderr=output, user=user, env=os.environ | more, start_new_session=True
        )
    try:
        yield
    finally:
        process.terminate()
        process.wait(PATIENCE_S)


def _owned(folder: Path, user: str | None) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    if user is not None:
        shutil.chown(folder, user)
    return folder


@contextlib.contextmanager
def _database(folder: Path) -> Iterator[None]:
    user = "postgres" if os.geteuid() == 0 else None  # the server refuses to be root
    _owned(folder, user)
    data = folder / "data"
    if not data.exists():
        secret = folder / "password"
        secret.touch(mode=0o600)
        secret.write_text(PASSWORD)
        if user is not None:
            os.chown(secret, pwd.getpwnam(user).pw_uid, -1)
        words = ["--username=toolpoint", "--auth=scram-sha-256", f"--pwfile={secret}", "--encoding=UTF8", "--locale=C"]
        done = subprocess.run([str(program("initdb")), "--pgdata", str(data), *words], user=user, check=False, cwd="/")
        secret.unlink()
        if done.returncode != 0:
            sys.exit(f"the database was not made: see above; its user must be able to enter --folder {folder.parent}")
    words = [str(program("postgres")), "-D", str(data), "-p", str(DATABASE_PORT)]
    settings = ("listen_addresses=127.0.0.1", f"unix_socket_directories={folder}", "max_connections=300")
    with _running([*words, *(word for each in settings for word in ("-c", each))], folder / "log", user):
        with _connected("postgres") as connection:
            if connection.execute("SELECT 1 FROM pg_database WHERE datname = 'toolpoint'").fetchone() is None:
                connection.execute("CREATE DATABASE toolpoint")
        yield


@contextlib.contextmanager
def _broker(folder: Path) -> Iterator[None]:
    """The broker of the compose file, with its place on this computer."""
    user = "mosquitto" if os.geteuid() == 0 else None
    _owned(folder, user)
    text = (HERE / "mosquitto.conf").read_text("utf-8").replace("listener 1883", f"listener {BROKER_PORT} 127.0.0.1")
    config = folder / "mosquitto.conf"
    config.write_text(text.replace("/mosquitto/data/", f"{folder}/"), encoding="utf-8")
    with _running([str(program("mosquitto")), "-c", str(config)], folder / "log"):
        yield


@contextlib.contextmanager
def _grafana(grafana: str, folder: Path) -> Iterator[None]:
    _owned(folder, None)
    settings = {
        "GF_PATHS_PROVISIONING": str(HERE / "grafana/provisioning"),
        "GF_PATHS_DATA": str(folder),
        "GF_SERVER_HTTP_ADDR": "127.0.0.1",
        "GF_SERVER_HTTP_PORT": str(GRAFANA_PORT),
        "GF_AUTH_ANONYMOUS_ENABLED": "true",
        "GF_DASHBOARDS_DEFAULT_HOME_DASHBOARD_PATH": str(HERE / "grafana/dashboards/fleet.json"),
        "TOOLPOINT_DASHBOARDS": str(HERE / "grafana/dashboards"),
        "TOOLPOINT_DATABASE_HOST": "127.0.0.1",
        "TOOLPOINT_DATABASE_PORT": str(DATABASE_PORT),
        "TOOLPOINT_DATABASE_SSLMODE": "disable",
        "TOOLPOINT_GRAFANA_PASSWORD": GRAFANA_PASSWORD,
    }
    with _running([grafana, "server", "--homepath", "/usr/share/grafana"], folder / "log", **settings):
        yield


@contextlib.contextmanager
def _connected(database: str = "toolpoint") -> Iterator[psycopg.Connection]:
    """Connect as soon as the server answers."""
    deadline_s = time.monotonic() + PATIENCE_S
    known = {"host": "127.0.0.1", "port": DATABASE_PORT, "user": "toolpoint", "password": PASSWORD, "dbname": database}
    while True:
        try:
            connection = psycopg.connect(**known, autocommit=True)
            break
        except psycopg.OperationalError as error:
            if time.monotonic() > deadline_s:
                sys.exit(f"the database does not answer at port {DATABASE_PORT}: {error}")
            time.sleep(0.2)
    with connection:
        yield connection


def let_grafana_read() -> None:
    """Make the role that may read, and nothing else."""
    with _connected() as connection:
        if connection.execute("SELECT 1 FROM pg_roles WHERE rolname = 'grafana'").fetchone() is None:
            connection.execute(sql.SQL("CREATE ROLE grafana LOGIN PASSWORD {}").format(sql.Literal(GRAFANA_PASSWORD)))
        connection.execute("CREATE SCHEMA IF NOT EXISTS toolpoint")
        connection.execute("GRANT USAGE ON SCHEMA toolpoint TO grafana")
        connection.execute("GRANT SELECT ON ALL TABLES IN SCHEMA toolpoint TO grafana")
        connection.execute("ALTER DEFAULT PRIVILEGES IN SCHEMA toolpoint GRANT SELECT ON TABLES TO grafana")


def fleet(machines: int, minutes: float, speed: float) -> int:
    """Run simulated machines; returns the exit status."""
    dsn = f"host=127.0.0.1 port={DATABASE_PORT} dbname=toolpoint user=toolpoint"
    words = ["fleet", "simulate", "--postgres", dsn, "--machines", str(machines), "--minutes", f"{minutes:g}"]
    command = [sys.executable, "-P", "-m", "daemon.cli", *words, "--speed", f"{speed:g}"]
    process = subprocess.Popen(command, env=os.environ | {"PGPASSWORD": PASSWORD})
    try:
        return process.wait()
    except SystemExit:
        process.terminate()  # Ctrl-C reaches it by itself
        raise
    finally:
        process.wait(PATIENCE_S)


def _end(*_: object) -> None:
    """End everything that was started: a terminal that is closed must not leave the servers at their ports."""
    sys.exit(1)


def port_is_free(port: int) -> bool:
    """Whether nothing listens there."""
    with socket.socket() as probe:
        return probe.connect_ex(("127.0.0.1", port)) != 0


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--way", choices=("compose", "packages"), help="left out: compose where Docker works")
    parser.add_argument("--machines", type=int, default=10)
    parser.add_argument("--hours", type=float, default=8.0, help="of history before now, made at the beginning")
    parser.add_argument("--live-minutes", type=float, default=1440.0, help="then as long in real time")
    parser.add_argument(
        "--folder", type=Path, default=Path(".plant"), help="where the packages' servers keep their data"
    )
    given = parser.parse_args()
    for number in (signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, _end)
    words = compose() if given.way != "packages" else None
    if words is None and given.way == "compose":
        sys.exit(NO_COMPOSE)
    if words is None and (taken := [p for p in (DATABASE_PORT, BROKER_PORT) if not port_is_free(p)]):
        sys.exit(f"port {taken[0]} is taken: set TOOLPOINT_DATABASE_PORT or TOOLPOINT_BROKER_PORT to a free one")
    with by_compose(words) if words else by_packages(given.folder.resolve()) as grafana:
        let_grafana_read()
        print(f"dashboard: http://127.0.0.1:{GRAFANA_PORT}" if grafana else NO_GRAFANA, flush=True)
        print(f"database: 127.0.0.1:{DATABASE_PORT}, broker: 127.0.0.1:{BROKER_PORT}", flush=True)
        with contextlib.suppress(KeyboardInterrupt):
            status = fleet(given.machines, 60.0 * given.hours, FASTEST)
            if status == 0 and given.live_minutes:
                status = fleet(given.machines, given.live_minutes, 1.0)
            sys.exit(status)


if __name__ == "__main__":
    main()
