"""The plant's dashboard on a real database, and the files that start a plant in a box."""

import json
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import history_records as make
import numpy as np
import psycopg
import pytest
import yaml
from history_records import FULL, StillClock
from mosquitto import PROGRAM
from postgresql import FOLDERS, PASSWORD, Server, postgresql

from config.schema.sinks import SinkConfig
from daemon.history.writer import HistoryWriter
from daemon.simulation.processes import free_port
from daemon.sinks.running import SinkRunner
from models.records import ProbeSample

FOLDER = Path(__file__).parents[2] / "systemd" / "plant"
DASHBOARD = json.loads((FOLDER / "grafana/dashboards/fleet.json").read_text("utf-8"))
MACHINES = ("simulated 1", "simulated 2")


@pytest.fixture(scope="module")
def server() -> Iterator[Server]:
    with postgresql() as server:
        yield server


@pytest.fixture(scope="module")
def filled(server: Server, tmp_path_factory: pytest.TempPathFactory) -> Server:
    """Ten minutes of two machines, up to now."""
    folder = tmp_path_factory.mktemp("plant")
    (now_s,) = server.ask("SELECT extract(epoch FROM now())::float8")[0]
    (folder / "password").write_text(PASSWORD)
    (folder / "password").chmod(0o600)
    there = {"host": "127.0.0.1", "port": server.port, "tls": False, "password_file": folder / "password"}
    config = SinkConfig.model_validate({"name": "plant", "driver": "postgresql", "postgresql": there})
    for number, name in enumerate(MACHINES):
        store, stop = folder / f"{number}.sqlite", threading.Event()
        writer = HistoryWriter(store, clock=StillClock(), machine=FULL)
        writer.start()
        for k in range(10):
            at_s = now_s - 600.0 + 60.0 * k
            writer._clock.utc_s = at_s
            for line, members in FULL.lines.items():
                writer.temperatures(None, make.cycle(line, k + 1, at_s, np.full(len(members), 20.0 + k)))
            writer.cnc_sample(make.cnc_sample(at_s))
            if not 0 < k < 5:  # readings may come every five minutes
                writer.estimate(make.estimate(at_s, np.full(3, float(k)), channels=("d1", "d2", "d3")))
            written = make.macros(k + 1, np.zeros(3))
            write_id = writer.write_intent(make.command(np.zeros(3)), written, "cycle")
            writer.write_outcome(write_id, make.receipt(at_s, written))
            writer.write_echoed(write_id, replace(make.trace(at_s), echoed=make.instant(at_s + 2.0)))
            writer.displacement(make.displacement(at_s, np.arange(5.0)))
            writer.event("note", f"number {k}")
            writer.probe(
                ProbeSample(
                    time=make.instant(at_s + 5.0),
                    axis="Z",
                    deviation_um=2.0,
                    applied_um=-6.0,
                    thermal_error_um=6.0,
                    reference_id="ref-1",
                    accepted=k != 3,
                    reason="" if k != 3 else "larger than believed",
                )
            )
        writer.close()
        runner = SinkRunner(config, store, name, stop, wait=lambda _duration_s, stop=stop: stop.set())
        runner.run()
        assert runner.cursor.problem == ""
    return server


def expanded(query: str) -> str:
    """Return a query as Grafana's macros and variables make it; the step of the charts is a minute."""
    start, end = (f"'{datetime.now(UTC) + timedelta(hours=hours):%Y-%m-%dT%H:%M:%S.%fZ}'" for hours in (-8.0, 0.01))
    query = re.sub(r"\$__timeFilter\((\w+)\)", rf"\1 BETWEEN {start} AND {end}", query)
    query = re.sub(r"\$__timeGroup\((\w+), \$__interval\)", r"floor(extract(epoch from \1)/60)*60", query)
    query = query.replace("$__timeTo()", end).replace("$__timeFrom()", start)
    names = {"$machine": ",".join(f"'{name}'" for name in MACHINES), "$channel": "d1", "$label": "'A','Room'"}
    for name, value in names.items():
        query = query.replace(name, value)
    assert "$" not in query, query
    return query


@pytest.fixture(scope="module")
def reader(filled: Server) -> Iterator[psycopg.Connection]:
    """Grafana's connection, by the role that the guide makes."""
    guide = (FOLDER.parents[1] / "docs/how-to/run-a-plant.md").read_text("utf-8")
    (made,) = (block for block in re.findall(r"```sql\n(.*?)```", guide, re.DOTALL) if "ROLE grafana" in block)
    with filled.connection() as connection:
        connection.execute(made)
    with filled.connection(user="grafana", password="choose one") as connection:
        yield connection


@pytest.mark.parametrize("panel", DASHBOARD["panels"], ids=lambda panel: panel["title"])
def test_every_panel_shows_rows_of_both_machines(reader: psycopg.Connection, panel: dict) -> None:
    (target,) = panel["targets"]
    found = reader.execute(expanded(target["rawSql"]))
    names = [column.name for column in found.description]
    rows = found.fetchall()
    if target["format"] == "time_series":
        assert names == ["time", "metric", "value"]
    shown = {str(row[names.index("machine" if "machine" in names else "metric")]) for row in rows}
    assert {name[: len(MACHINES[0])] for name in shown} == set(MACHINES)
    # Where a column is null in every row, the query asks for what there is not.
    assert [name for at, name in enumerate(names) if all(row[at] is None for row in rows)] in ([], ["person"])


def test_a_month_of_a_model_is_what_accepted_probes_found_under_it(filled: Server) -> None:
    found = filled.ask(
        "SELECT axis, model_id, sum(probes)::int, max(with_um), max(without_um) FROM toolpoint.model_errors "
        f"WHERE machine = '{MACHINES[0]}' GROUP BY 1, 2"
    )
    assert found == [("Z", "made-up", 9, 2.0, 8.0)]


@pytest.mark.parametrize("variable", DASHBOARD["templating"]["list"], ids=lambda variable: variable["name"])
def test_every_variable_has_values(reader: psycopg.Connection, variable: dict) -> None:
    assert len(reader.execute(variable["query"]).fetchall()) >= 2


def test_machines_without_displacement_sensors_have_channels_too(filled: Server) -> None:
    (channel,) = (each for each in DASHBOARD["templating"]["list"] if each["name"] == "channel")
    with filled.connection() as connection, connection.transaction(force_rollback=True):
        connection.execute("DELETE FROM toolpoint.displacements")
        found = connection.execute(channel["query"]).fetchall()
    assert found == [("d3",), ("d2",), ("d1",)]


def _scans(node: dict) -> Iterator[dict]:
    if "Relation Name" in node:
        yield node
    for below in node.get("Plans", ()):
        yield from _scans(below)


@pytest.mark.parametrize(
    "query",
    [
        *(each["query"] for each in DASHBOARD["templating"]["list"]),
        *(each["targets"][0]["rawSql"] for each in DASHBOARD["panels"] if each["title"] == "Fleet now"),
    ],
)
def test_what_is_newest_is_looked_up_and_not_looked_for(reader: psycopg.Connection, query: str) -> None:
    """Grafana asks every ten seconds, of a hundred machines and their years."""
    reader.execute("SET enable_seqscan = off")  # which is quicker for the few rows here
    ((found,),) = reader.execute(f"EXPLAIN (FORMAT JSON) {expanded(query)}").fetchall()
    of_rows = [each for each in _scans(found[0]["Plan"]) if each["Relation Name"] != "deliveries"]
    assert all("Index Cond" in each for each in of_rows), of_rows
    assert "time DESC" not in json.dumps(found), "sorted, not looked up"


def test_who_reads_the_dashboards_can_change_nothing(reader: psycopg.Connection) -> None:
    with pytest.raises(psycopg.errors.InsufficientPrivilege):
        reader.execute("DELETE FROM toolpoint.deliveries")


# --- the compose file ----------------------------------------------------------------------

COMPOSES = {"plugin": ["docker", "compose"], "package": ["docker-compose"]}


@pytest.fixture(params=COMPOSES)
def compose(request: pytest.FixtureRequest) -> list[str]:
    words = COMPOSES[request.param]
    there = shutil.which(words[0]) and subprocess.run([*words, "version"], capture_output=True, check=False)
    if not there or there.returncode != 0:
        pytest.skip(f"`{' '.join(words)}` is not installed (apt-get install docker-compose)")
    return words


def test_compose_takes_the_file_with_its_ports_and_passwords(compose: list[str]) -> None:
    chosen = {f"TOOLPOINT_{name}_PORT": str(40000 + at) for at, name in enumerate(("DATABASE", "BROKER", "GRAFANA"))}
    chosen |= {"TOOLPOINT_PASSWORD": "one", "TOOLPOINT_GRAFANA_PASSWORD": "two"}
    done = subprocess.run(
        [*compose, "--file", str(FOLDER / "compose.yaml"), "config"],
        env=os.environ | chosen,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    services = yaml.safe_load(done.stdout)["services"]
    assert set(services) == {"database", "broker", "grafana"}
    for port in (40000, 40001, 40002):
        assert done.stdout.count(str(port)) == 1, done.stdout
    assert services["database"]["environment"]["POSTGRES_PASSWORD"] == "one"
    assert services["grafana"]["environment"]["TOOLPOINT_GRAFANA_PASSWORD"] == "two"
    assert services["grafana"]["depends_on"]["database"]["condition"] == "service_healthy"


IN_THE_BACKGROUND = """
import os, signal, sys
signal.signal(signal.SIGINT, signal.SIG_IGN)  # as a shell does that starts it with `&`
os.execv(sys.argv[1], sys.argv[1:])
"""


@pytest.mark.slow
@pytest.mark.skipif(PROGRAM is None or not FOLDERS, reason="mosquitto or postgresql is not installed")
def test_the_box_runs_from_debians_packages(tmp_path: Path) -> None:
    """Broker, database and a simulated machine; without Grafana, which Debian has not, it says so and goes on."""
    tmp_path.chmod(0o755)
    with tempfile.TemporaryDirectory(prefix="plant-") as folder:  # not in pytest's, which the database cannot enter
        Path(folder).chmod(0o755)
        ports = {f"TOOLPOINT_{name}_PORT": str(free_port()) for name in ("DATABASE", "BROKER", "GRAFANA")}
        words = [sys.executable, str(FOLDER / "plant.py"), "--machines", "1", "--hours", "0.05", "--folder", folder]
        environment = os.environ | ports | {"DOCKER_HOST": "unix:///nowhere/docker.sock"}
        done = subprocess.run(
            [*words, "--live-minutes", "0"], env=environment, capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, done.stdout + done.stderr
        assert (
            "0 lost, 0 doubled" in done.stdout
            and f"database: 127.0.0.1:{ports['TOOLPOINT_DATABASE_PORT']}" in done.stdout
        )
        log = (Path(folder) / "broker/log").read_text("utf-8")
        assert "running" in log and "Error" not in log
        assert (Path(folder) / "broker/mosquitto.db").exists(), "what waits in the broker outlives it"
        with subprocess.Popen(
            [sys.executable, "-c", IN_THE_BACKGROUND, *words, "--hours", "400"],
            env=environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        ) as closed:
            assert closed.stdout is not None
            assert any("times real time" in line for line in closed.stdout)
            blocked = signal.SIGHUP in signal.pthread_sigmask(signal.SIG_BLOCK, ())  # by whoever started the tests
            closed.send_signal(signal.SIGTERM if blocked else signal.SIGHUP)  # as of a terminal that is closed
            try:
                assert closed.wait(60) == 1
            finally:
                closed.terminate()
        for name in ("DATABASE", "BROKER"):
            with socket.socket() as probe:
                assert probe.connect_ex(("127.0.0.1", int(ports[f"TOOLPOINT_{name}_PORT"]))) != 0, f"{name} still runs"
