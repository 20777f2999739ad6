"""What the daemon's OPC UA server costs: 302 tags that change each second, watched by five subscribers.

    python tests/benchmarks/bench_opcua_server.py [--minutes 4] [--subscribers 5]

The demo's daemon runs at speed 1, its three lines bring all 302 sensors each second. First it runs without the
server, then with it; then, in turns of twenty seconds, nobody is connected or all subscribers are told every
measurement of every sensor, signed and encrypted, so that both are measured in one run on the same computer. Prints
feedback percentiles and processor time of the daemon, each beside those with nobody, the changes, and its memory.
"""

import argparse
import asyncio
import logging
import shutil
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import yaml
from asyncua import Client, ua
from asyncua.crypto.security_policies import SecurityPolicyBasic256Sha256
from asyncua.crypto.uacrypto import CertProperties

from config.schema import Configuration
from daemon.cli.simulate.demo import demo_machine
from daemon.history.decimation import SeriesReader
from daemon.monitor.accounts import Account, Role, hashed, write_accounts
from daemon.simulation.demonstration import switch_on
from daemon.simulation.processes import free_port, start_simulation, write_simulation_configuration
from drivers.opcua.new_certificate import create_application_certificate

TURN_S = 20.0
SETTLING_S = 30.0
PERIOD_S = 1.0
PASSWORD = "a password for the benchmark"
CLIENT_URI = "urn:toolpoint:benchmark"


class Counter:
    """Counts the changes that a subscriber hears of."""

    def __init__(self) -> None:
        self.changes = 0

    def datachange_notification(self, node: Any, value: Any, data: Any) -> None:
        self.changes += 1


@dataclass
class Turn:
    """What was measured while so many subscribed."""

    words: str
    subscribers: int
    delays_s: list[float] = field(default_factory=list)
    cores: list[float] = field(default_factory=list)
    changes: int = 0
    mib: float = 0.0

    def in_words(self, nobody: "Turn") -> str:
        p99_ms, least_ms = (1e3 * float(np.percentile(turn.delays_s, 99)) for turn in (self, nobody))
        percent, least = (100.0 * float(np.mean(turn.cores)) for turn in (self, nobody))
        rate = self.changes / (len(self.cores) * TURN_S)
        return (
            f"{self.words}: {len(self.delays_s)} cycles, feedback median {1e3 * np.median(self.delays_s):.2f} ms, p99 "
            f"{p99_ms:.2f} ms ({p99_ms / least_ms:.2f} times that of nobody); daemon {percent:.2f} % of a core "
            f"({percent - least:+.2f}); {rate:.0f} changes/s; memory {self.mib:.1f} MiB"
        )


def with_server(path: Path, folder: Path) -> tuple[int, Path, Path]:
    """Add the server to a configuration; return its port, and certificate and key of a client."""
    for name, uri in (("server", "urn:toolpoint:tags-benchmark"), ("client", CLIENT_URI)):
        create_application_certificate(
            folder / f"{name}.der",
            folder / f"{name}.pem",
            application_uri=uri,
            host_name="localhost",
            server=name == "server",
        )
    trusted = folder / "trusted"
    trusted.mkdir()
    shutil.copy(folder / "client.der", trusted)
    account = Account(name="plant", role=Role.VIEWER, password_hash=hashed(PASSWORD))
    write_accounts(folder / "users", {"plant": account})
    content, port = yaml.safe_load(path.read_text("utf-8")), free_port()
    content["service"]["users"] = str(folder / "users")
    content["opcua_server"] = {
        "port": port,
        "certificate": str(folder / "server.der"),
        "private_key": str(folder / "server.pem"),
        "trusted_clients": str(trusted),
    }
    path.write_text(yaml.safe_dump(content, sort_keys=False), encoding="utf-8")
    return port, folder / "client.der", folder / "client.pem"


async def subscribed(port: int, certificate: Path, key: Path, counter: Counter, ready: asyncio.Semaphore) -> None:
    """Watch every temperature until cancelled."""
    client = Client(f"opc.tcp://127.0.0.1:{port}/", timeout=30.0)
    client.application_uri = CLIENT_URI
    server = str(certificate.with_name("server.der"))
    await client.set_security(
        SecurityPolicyBasic256Sha256, str(certificate), CertProperties(key, "pem"), server_certificate=server
    )
    client.set_user("plant")
    client.set_password(PASSWORD)
    async with client:
        index = await client.get_namespace_index("urn:toolpoint:tags")
        folder = client.get_node(ua.NodeId("temperatures", index))
        subscription = await client.create_subscription(1000.0 * PERIOD_S, counter)
        tags = await folder.get_children(nodeclassmask=ua.NodeClass.Variable)
        every = ua.DataChangeFilter(Trigger=ua.DataChangeTrigger.StatusValueTimestamp)
        how = ua.AttributeIds.Value, every, 1, ua.MonitoringMode.Reporting, 1000.0 * PERIOD_S
        await subscription.create_monitored_items(
            [subscription._make_monitored_item_request(tag, *how) for tag in tags]
        )
        ready.release()
        await asyncio.Event().wait()


def used(process: psutil.Process) -> float:
    times = process.cpu_times()
    return float(times.user + times.system)


async def turns(
    process: psutil.Process,
    configuration: Configuration,
    port: int,
    keys: tuple[Path, Path],
    ahead_s: float,
    given: Any,
) -> list[Turn]:
    """Measure in turns with nobody and with all subscribers."""
    kinds = [Turn("nobody", 0), Turn(f"{given.subscribers} subscribers", given.subscribers)]
    until_s = time.monotonic() + 60.0 * given.minutes
    while time.monotonic() < until_s:
        for turn in kinds:
            counter, ready = Counter(), asyncio.Semaphore(0)
            others = [asyncio.create_task(subscribed(port, *keys, counter, ready)) for _ in range(turn.subscribers)]
            for _ in others:
                await asyncio.wait_for(ready.acquire(), 60.0)
            await asyncio.sleep(2.0)
            begin_s, before, counter.changes = time.time(), used(process), 0
            await asyncio.sleep(TURN_S)
            end_s = time.time()
            turn.cores.append((used(process) - before) / (end_s - begin_s))
            turn.changes += counter.changes
            turn.mib = process.memory_full_info().pss / 2**20
            with SeriesReader(configuration.history.path) as reader:
                writes = reader.writes(begin_s - ahead_s, end_s - ahead_s)
            turn.delays_s += [each.delay_s["read_back"] for each in writes if "read_back" in each.delay_s]
            for task in others:
                task.cancel()
            await asyncio.gather(*others, return_exceptions=True)
    return kinds


@contextmanager
def daemon(
    folder: Path, *, served: bool
) -> Iterator[tuple[psutil.Process, Configuration, int, tuple[Path, Path], float]]:
    """Run the demo's machine and daemon, with the server or without."""
    content = demo_machine()
    for line in content["temperatures"]["lines"]:
        line["cycle_period_s"] = PERIOD_S
        line["baud"] = 115200
    content["compensation"]["reference"]["mean_s"] = 60.0 * PERIOD_S / 10.0
    folder.mkdir()
    path, configuration = write_simulation_configuration(content, folder, speed=1.0, http_port=free_port())
    port, *keys = with_server(path, folder) if served else (0, path, path)
    with start_simulation([], path, speed=1.0, epoch_utc_s=time.time(), directory=folder) as running:
        switch_on(running)
        time.sleep(SETTLING_S)
        running.client.ask("reference")
        time.sleep(5.0)
        ahead_s = time.time() - running.client.ask("status")["time_utc_s"]
        yield psutil.Process(running.daemon.pid), configuration, port, (keys[0], keys[1]), ahead_s


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=4.0)
    parser.add_argument("--subscribers", type=int, default=5)
    given = parser.parse_args()
    logging.disable(logging.WARNING)  # of the clients' library
    with tempfile.TemporaryDirectory() as name:
        with daemon(Path(name) / "without", served=False) as (process, *_):
            time.sleep(60.0 * given.minutes)
            bare_mib = process.memory_full_info().pss / 2**20
            print(f"without the server: memory {bare_mib:.1f} MiB after as long", flush=True)
        with daemon(Path(name) / "with", served=True) as (process, *where):
            kinds = asyncio.run(turns(process, *where, given))
        for turn in kinds:
            print(turn.in_words(kinds[0]))
        print(f"memory beside that without the server: {kinds[-1].mib - bare_mib:+.1f} MiB")


if __name__ == "__main__":
    main()
