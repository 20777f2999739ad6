"""Serves a scripted CNC until its standard input ends; prints the endpoint once it listens.

python serve_cnc.py [KEYS_DIRECTORY]
"""

import asyncio
import gc
import sys
import time
from pathlib import Path

from scripted_machine import Keys, ScriptedNc, cnc_config

from drivers.sim.wires.opcua_server import SimulatedCncServer


async def _serve(directory: Path | None) -> None:
    started_s = time.perf_counter()
    keys = Keys.__new__(Keys)
    if directory is not None:
        keys.client, keys.server, keys.server_key = (directory / n for n in ("client.der", "server.pem", "server.key"))
    security = keys.server_security() if directory is not None else None
    server = SimulatedCncServer(ScriptedNc(), cnc_config(), port=0, security=security)
    await server.start()
    gc.freeze()
    print(server.endpoint, f"{time.perf_counter() - started_s:.3f}", flush=True)
    await asyncio.to_thread(sys.stdin.read)
    await server.stop()


if __name__ == "__main__":
    asyncio.run(_serve(Path(sys.argv[1]) if len(sys.argv) > 1 else None))
