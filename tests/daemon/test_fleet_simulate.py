"""Histories of simulated machines in a real database, held against the stores, through kills of what carries them."""

import json
from pathlib import Path

import psycopg
import pytest
from click.testing import CliRunner
from fleet_kills import Killer, broker_kill, database_kill, dsn_of, plant_broker
from postgresql import PASSWORD, Server, postgresql

from daemon.cli import main
from daemon.simulation import SimulationError
from daemon.simulation.fleet.counting import count_rows
from daemon.simulation.fleet.run import SINK, broker_of, plan_of, route_of, simulate_fleet


@pytest.fixture(scope="module")
def server():
    with postgresql() as server:
        yield server


@pytest.mark.slow
def test_nothing_is_lost_or_doubled_when_everything_on_the_way_is_killed(server: Server, tmp_path: Path) -> None:
    """Over MQTT: senders, broker, the plant's store and the database, each once."""
    broker, dsn = plant_broker(tmp_path), dsn_of(server, PASSWORD)
    broker.start()
    try:
        plan = plan_of(tmp_path, machines=2, minutes=4.0, speed=30.0, dsn=dsn)
        others = {"database": database_kill(server), "broker": broker_kill(broker)}
        killer = Killer(5, 8.0, seed=1, others=others)
        route = route_of(dsn, f"mqtt://127.0.0.1:{broker.port}", tmp_path, 0.3, resend_s=5.0)
        result = simulate_fleet(plan, route, began=killer.begin)
        killer.join()
    finally:
        broker.kill()
    assert killer.done == {"store": 1, "senders": 2, "database": 1, "broker": 1} and result.restarts["senders"] == 2
    assert result.complete, result.as_json()
    assert len(result.lags_s) == 2 * 3 * 23, "every cycle of every line was seen to arrive"
    again = plan_of(tmp_path / "again", machines=2, minutes=4.0, speed=30.0, dsn=dsn)
    assert again.start_utc_s > plan.start_utc_s + 240.0, "a second run does not mix with the first"
    with psycopg.connect(dsn, autocommit=True) as connection:
        for table in ("cnc", "temperatures"):
            (time, machine) = connection.execute(f"SELECT time, machine FROM toolpoint.{table} LIMIT 1").fetchone()
            changed = "degc[1] = degc[1] + 0.0625" if table == "temperatures" else "sequence_number = 99"
            connection.execute(
                f"UPDATE toolpoint.{table} SET {changed} WHERE time = %s AND machine = %s", (time, machine)
            )
        connection.execute("DELETE FROM toolpoint.writes WHERE write_id = 3 AND machine = 'simulated 1'")
        found = count_rows(plan, connection, SINK)
    assert (found.lost, found.duplicates) == (3, 2), "a change of one step in one sensor is seen too"


@pytest.mark.slow
def test_the_command_says_what_arrived(server: Server, tmp_path: Path) -> None:
    words = ["fleet", "simulate", "--machines", "1", "--minutes", "1", "--speed", "60", "--directory", str(tmp_path)]
    done = CliRunner().invoke(main, [*words, "--postgres", dsn_of(server, PASSWORD), "--json", "-"])
    assert done.exit_code == 0, done.output
    said = json.loads(done.stdout)
    rows = said["rows"]
    assert rows["stored"] == rows["acknowledged"] == rows["sent"] == rows["recorded"] > 100
    assert rows["lost"] == rows["duplicates"] == rows["waiting"] == 0
    assert 0.0 <= said["lag_s"]["p50"] <= said["lag_s"]["p99"] and said["cpu_s"] > 0.0
    plan_of(tmp_path, 1, 1.0, 60.0, dsn_of(server, PASSWORD))
    just_now = "SELECT count(*) FROM toolpoint.deliveries WHERE delivered > now() - interval '1 minute'"
    assert server.ask(just_now) == [(0,)], "the next run's new stores wait for nobody"


@pytest.mark.parametrize(
    ("dsn", "said"),
    [
        ("host=127.0.0.1 port=1 user=nobody", "--postgres: "),
        ("host=db sslmode=require", "give disable or verify-full"),
        ("no such thing", "give a DSN such as postgresql://"),
        ("host=127.0.0.1,127.0.0.2 port=1,2", "--postgres: port=1,2: give the port of one server"),
        ("postgresql://anna@db:http/plant", "--postgres: port=http: give the port of one server"),
        ("host=db port=99999", "--postgres: port: "),
        ("host=db user=''", "--postgres: user_name: "),
        ("postgresql://anna:hunter2 x@db/plant", "unexpected spaces found in …"),
        ("host=db password=my hunter2", "missing … in connection info"),
        ("anna:hunter2@db", "give a DSN such as"),
        ("postgresql://anna:hunter2@[db/plant", "give a DSN such as"),
        ("host=@nobody port=x", "--postgres: port=x: give the port"),
        ("postgresql://anna:hunter2/x@db/plant", "--postgres: write / @ : of a password as %2F"),
        ("postgresql://anna:x@hunter2@db/plant", "--postgres: write / @ : of a password as %2F"),
    ],
)
def test_a_database_that_cannot_be_used_is_refused(dsn: str, said: str) -> None:
    done = CliRunner().invoke(main, ["fleet", "simulate", "--postgres", dsn])
    assert done.exit_code == 2 and said in done.output and "hunter" not in done.output


@pytest.mark.parametrize("kind", ["mqtt", "mqtts"])
def test_a_broker_that_cannot_be_used_is_refused_at_once(server: Server, kind: str) -> None:
    words = ["fleet", "simulate", "--postgres", dsn_of(server, PASSWORD), "--mqtt", f"{kind}://127.0.0.1:1"]
    done = CliRunner().invoke(main, words)
    assert done.exit_code == 2 and "--mqtt: " in done.output and "check `host`, `port` (1)" in done.output


def test_the_brokers_password_comes_from_the_environment_and_is_never_shown(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TOOLPOINT_BROKER_PASSWORD", "quite secret 7")
    broker = broker_of("mqtts://anna@broker.plant.example", tmp_path)
    assert broker["user_name"] == "anna" and broker["password_file"].read_text("utf-8") == "quite secret 7"
    assert broker["password_file"].stat().st_mode & 0o077 == 0
    for url in ("http://anna:hush@broker", "mqtt://anna:hush@broker:hush"):
        with pytest.raises(SimulationError, match=r"^--mqtt: ") as refused:
            broker_of(url, tmp_path)
        assert "hush@" not in str(refused.value)
