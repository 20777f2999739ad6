"""The OPC UA server of a control task in this process, with accounts, certificates and trusted clients."""

import asyncio
import contextlib
import shutil
import time
from collections.abc import AsyncIterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from asyncua import Client
from asyncua.crypto.security_policies import SecurityPolicyBasic256Sha256
from asyncua.crypto.uacrypto import CertProperties
from asyncua.ua import MessageSecurityMode
from control_rig import HandClock, Rig, machine, record_for, running
from memory_cnc import MemoryNc
from monitor_bench import PASSWORD, accounts_file
from scripted_machine import CLIENT_URI, Keys

from config.schema import Configuration
from config.schema.service import OpcUaServerConfig
from daemon.history.reader import HistoryReader
from daemon.monitor.opcua.serving import OpcUaService
from daemon.simulation.processes import free_port
from models.quality import Quality, Reason
from models.records import Instant, MachineTemperatures, Trace

TAGS = "urn:toolpoint:tags"
NOW = Instant(monotonic_s=1000.0, utc_s=1_760_000_400.0, real_s=1000.0)
ROLES = {"otto": "viewer", "anna": "operator", "eva": "engineer"}


def section(directory: Path, keys: Keys, **changes: Any) -> OpcUaServerConfig:
    """The section of a server on a free port that trusts the client of these keys."""
    trusted = directory / "clients"
    trusted.mkdir(exist_ok=True)
    shutil.copy(keys.client, trusted)
    fields = {
        "port": free_port(),
        "certificate": keys.server,
        "private_key": keys.server_key,
        "trusted_clients": trusted,
    }
    return OpcUaServerConfig(**(fields | changes))


@dataclass
class OpcUaBench:
    """A running server."""

    configuration: Configuration
    rig: Rig
    keys: Keys

    @property
    def url(self) -> str:
        assert self.configuration.opcua_server is not None
        return f"opc.tcp://127.0.0.1:{self.configuration.opcua_server.port}/"

    async def client(
        self,
        name: str = "",
        password: str = PASSWORD,
        keys: Keys | None = None,
        mode: MessageSecurityMode = MessageSecurityMode.SignAndEncrypt,
    ) -> Client:
        """A client of the library, prepared but not connected; without a name it says that it is anonymous."""
        keys = keys or self.keys
        client = Client(self.url, timeout=20.0)
        client.application_uri = CLIENT_URI
        key = CertProperties(keys.client_key, extension="pem")
        await client.set_security(
            SecurityPolicyBasic256Sha256, str(keys.client), key, server_certificate=str(self.keys.server), mode=mode
        )
        if name:
            client.set_user(name)
            client.set_password(password)
        return client

    @contextlib.asynccontextmanager
    async def logged_in(self, name: str, **how: Any) -> AsyncIterator[Client]:
        async with await self.client(name, **how) as client:
            yield client

    def events(self, kind: str | None = "access") -> list[tuple[str, str | None]]:
        """Text and person of what the audit holds."""
        with HistoryReader(self.configuration.history.path) as reader:
            return [(e.text, e.person) for e in reader.events(0.0, 1e11) if kind is None or e.kind == kind]


@contextlib.asynccontextmanager
async def tag_server(directory: Path, keys: Keys, **changes: Any) -> AsyncIterator[OpcUaBench]:
    """Serve the tags of a rig; `changes` are those of the section."""
    configuration = machine(directory)
    service = configuration.service.model_copy(update={"users": accounts_file(directory, **ROLES)})
    configuration = configuration.model_copy(
        update={"service": service, "opcua_server": section(directory, keys, **changes)}
    )
    clock = HandClock()
    rig = Rig(configuration, MemoryNc(configuration, clock), clock, record=record_for(configuration))
    async with running(rig):
        serving = asyncio.Event()
        server = OpcUaService(configuration, rig.snapshots, rig.desk(), rig.history)
        task = asyncio.create_task(server.serve(serving.set))
        waiting = asyncio.create_task(serving.wait())
        await asyncio.wait([task, waiting], return_when=asyncio.FIRST_COMPLETED)
        if task.done():
            task.result()
        try:
            yield OpcUaBench(configuration, rig, keys)
        finally:
            task.cancel()
            await asyncio.gather(task, waiting, return_exceptions=True)


def temperatures(first_degc: float = 21.5, utc_s: float = NOW.utc_s, ago_s: float = 0.0) -> MachineTemperatures:
    """Five sensors: good, held, out of range, not received, good; the cycle ended so long ago."""
    at = replace(NOW, real_s=time.monotonic() - ago_s)
    return MachineTemperatures(
        line="spindle",
        measured_degc=np.array([first_degc, 99.0, 300.0, np.nan, 20.0]),
        degc=np.array([first_degc, 22.0, np.nan, np.nan, 20.0]),
        quality=np.array([Quality.GOOD, Quality.HELD, Quality.MISSING, Quality.MISSING, Quality.GOOD], dtype=np.uint8),
        reason=np.array(
            [Reason.NONE, Reason.RATE, Reason.OUT_OF_RANGE, Reason.NOT_RECEIVED, Reason.NONE], dtype=np.uint8
        ),
        age_s=np.array([0.0, 12.0, np.inf, np.inf, 4.0]),
        trace=Trace(first_byte=at, last_byte=replace(at, utc_s=utc_s)),
    )


def tell(bench: OpcUaBench, **of: float) -> None:
    """Publish temperatures as the thermal task does."""
    board = bench.rig.snapshots
    board.thermal = replace(board.thermal, temperatures=temperatures(**of))
