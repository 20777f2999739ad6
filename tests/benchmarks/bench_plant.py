"""A plant's histories into PostgreSQL: what is lost, doubled, and how late it comes, with kills of what carries it.

python tests/benchmarks/bench_plant.py [--mqtt] [--machines 100] [--minutes 10] [--kills 0] [--seed 1]

Servers, senders and machines run on this computer together, in real time; a plant has a computer for each machine and
another for the database. `--mqtt`: over mosquitto and `toolpoint fleet store`. `--kills 50`: database, broker, store
and senders are killed that often, evenly over the time, each at a random moment of its share, and started again.
"""

import argparse
import contextlib
import json
import sys
import tempfile
from pathlib import Path

if __name__ == "__main__":  # the processes of the fleet load this file as well, and need none of this
    sys.path.insert(0, str(Path(__file__).parents[1] / "support"))

    from fleet_kills import Killer, broker_kill, database_kill, dsn_of, plant_broker
    from postgresql import PASSWORD, Server, postgresql

    from daemon.simulation.fleet.run import plan_of, processor_s, route_of, simulate_fleet

SETTINGS = ("max_connections=1100", "fsync=on", "recovery_init_sync_method=syncfs")
"""A sink of each machine has a connection; the tests' server does not wait for its disk, this one does."""


def sizes(server: "Server", machines: int, minutes: float) -> dict[str, float]:
    """What the rows take in the database, indexes with them."""
    with server.connection() as connection:
        connection.execute("VACUUM (ANALYZE)")
    (size,) = server.ask(
        "SELECT sum(pg_total_relation_size(c.oid))::bigint FROM pg_class AS c JOIN pg_namespace AS n "
        "ON n.oid = c.relnamespace WHERE n.nspname = 'toolpoint' AND c.relkind = 'r'"
    )[0]
    return {
        "mib": round(size / 2**20, 1),
        "gib_per_machine_year": round(size * 525_960 / minutes / machines / 2**30, 1),
    }


def database_cpu_s(server: "Server") -> float:
    """Processor time of the server's processes that live; what those used that have ended is missing."""
    return sum(processor_s(pid) or 0.0 for (pid,) in server.ask("SELECT pid FROM pg_stat_activity"))


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--mqtt", action="store_true")
    parser.add_argument("--machines", type=int, default=100)
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--speed", type=float, default=1.0)
    parser.add_argument("--period-s", type=float, default=0.5, help="from one look of a sink to the next")
    parser.add_argument("--kills", type=int, default=0)
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as name, postgresql() as server, contextlib.ExitStack() as stack:
        server.kill(2)
        server.start(*SETTINGS)
        folder, dsn = Path(name), dsn_of(server, PASSWORD)
        plan = plan_of(folder, given.machines, given.minutes, given.speed, dsn)
        others, url = {"database": database_kill(server, *SETTINGS)}, None
        if given.mqtt:
            broker = plant_broker(folder)
            broker.start()
            stack.callback(broker.kill)
            others["broker"], url = broker_kill(broker), f"mqtt://127.0.0.1:{broker.port}"
        within_s = 60.0 * given.minutes / given.speed
        killer = Killer(given.kills, within_s, given.seed, others) if given.kills else None
        result = simulate_fleet(
            plan,
            route_of(dsn, url, folder, given.period_s),
            say=print,
            began=killer.begin if killer else lambda _keeper: None,
        )
        if killer is not None:
            killer.join()
            print("killed:", dict(killer.done))
        print(json.dumps(result.as_json(), indent=2))
        print("complete:", result.complete)
        print("database, live processes [s]:", round(database_cpu_s(server), 1))
        print("database, room:", sizes(server, given.machines, given.minutes))


if __name__ == "__main__":
    main()
