"""Asks the configured control what it gives and takes; writes nothing."""

from typing import Any

from config.schema import Configuration
from daemon.cnc.commissionable import insecure
from drivers import registry
from drivers.clock import Clock
from drivers.contract import Capability, DriverError


async def probe_control(configuration: Configuration, clock: Clock) -> dict[str, Any]:
    """Return `{driver, identity, secure, can: {capability: bool}, refused: [{what, why}]}`.

    `identity` is None when the control cannot be reached or refuses what the daemon needs; `refused` then begins with
    `connect` and the reason, and nothing can be done.
    """
    cnc = registry.open_cnc(configuration, clock)
    refused: dict[str, str] = {}
    identity: str | None = None
    try:
        await cnc.connect()
        await cnc.read(configuration.cnc.macros.block)
        identity = cnc.identity
        refused = dict(cnc.cannot)
        if not configuration.cnc.axis_positions:
            refused.setdefault(Capability.AXIS_POSITION, "cnc.axis_positions names no axis to read")
        if problem := insecure(configuration):
            refused.setdefault(Capability.WRITE_MACROS, problem)
    except DriverError as error:
        refused = {"connect": str(error)}
    finally:
        await cnc.close()
    return {
        "driver": configuration.cnc.driver,
        "identity": identity,
        "secure": cnc.security == "encrypted",
        "can": {name: identity is not None and name not in refused for name in Capability},
        "refused": [{"what": name, "why": why} for name, why in refused.items()],
    }
