"""The network face of a simulated CNC, by the driver that the configuration names."""

from collections.abc import Iterable
from typing import Protocol
from urllib.parse import urlparse

from config.schema.cnc import CncConfig
from config.schema.cnc_drivers import FocasConfig, HaasConfig, MtconnectConfig, OpcUaConfig
from drivers.sim.contract import SimulatedNc
from drivers.sim.wires.focas_server import SimulatedFocasServer
from drivers.sim.wires.haas_server import SimulatedHaasServer
from drivers.sim.wires.mtconnect_agent import SimulatedMtconnectAgent
from drivers.sim.wires.opcua_server import ServerSecurity, SimulatedCncServer


class CncServer(Protocol):
    """A server on 127.0.0.1 that a driver connects to."""

    @property
    def port(self) -> int:
        """The port that is listened on (known after start)."""

    @property
    def endpoint(self) -> str:
        """Where clients find it (known after start)."""

    async def start(self) -> None: ...

    async def stop(self) -> None:
        """Close all connections and stop listening. May be called more than once."""


def configured_port(config: CncConfig) -> int:
    """Return the TCP port at which the configuration expects the control."""
    connection = config.connection
    if isinstance(connection, OpcUaConfig):
        return urlparse(connection.endpoint).port or 4840
    assert isinstance(connection, FocasConfig | HaasConfig | MtconnectConfig)
    return connection.port


def cnc_server(
    nc: SimulatedNc, config: CncConfig, *, port: int, security: ServerSecurity | None, readable: Iterable[int]
) -> CncServer:
    """Return the server of the configured driver, not started; `readable` are macros beside those of the map."""
    if config.driver == "focas":
        return SimulatedFocasServer(nc, config, port=port)
    if config.driver == "haas":
        return SimulatedHaasServer(nc, config, port=port)
    if config.driver == "mtconnect":
        return SimulatedMtconnectAgent(nc, config, port=port)
    return SimulatedCncServer(nc, config, port=port, security=security, readable=readable)
