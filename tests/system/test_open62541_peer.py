"""The daemon's OPC UA server read by an open62541 client, a stack in C that shares no line with ours.

The client is the package `o6`, which is built on open62541. It is no part of Toolpoint nor of its environment: its
licence lets it run for ten minutes, so it is installed into a cache of its own (environment variable
TOOLPOINT_O6_CACHE, default ~/.cache/toolpoint-tests) and runs in a process of its own.
"""

import asyncio
import fcntl
import json
import os
import platform
import subprocess
import sys
from pathlib import Path

import pytest
from monitor_bench import PASSWORD
from opcua_bench import NOW, TAGS, tag_server, tell
from scripted_machine import CLIENT_URI, Keys

PEER = Path(__file__).resolve().parent / "open62541_peer" / "client.py"
PACKAGE = "o6==2.2.0"
PATIENCE_S = 120.0

pytestmark = [
    pytest.mark.wires,
    pytest.mark.skipif(
        (platform.system(), platform.machine(), platform.python_implementation()) != ("Linux", "x86_64", "CPython"),
        reason="the package o6 is not built for this kind of computer",
    ),
]


@pytest.fixture(scope="module")
def packages() -> Path:
    """Install the client once, and return its folder."""
    default = Path.home() / ".cache" / "toolpoint-tests"
    name = f"{PACKAGE}-{sys.implementation.cache_tag}"
    cache = Path(os.environ.get("TOOLPOINT_O6_CACHE", default)) / name
    cache.mkdir(parents=True, exist_ok=True)
    with (cache / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not (cache / "installed").exists():
            command = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--only-binary", ":all:"]
            done = subprocess.run(
                [*command, "--target", str(cache), PACKAGE], capture_output=True, text=True, check=False
            )
            assert done.returncode == 0, f"{PACKAGE} cannot be installed:\n{done.stdout}\n{done.stderr}"
            (cache / "installed").touch()
    return cache


async def test_open62541_reads_the_daemons_tags(packages: Path, tmp_path: Path) -> None:
    (tmp_path / "keys").mkdir()
    keys = Keys(tmp_path / "keys")
    async with tag_server(tmp_path, keys) as bench:
        tell(bench)
        options = {
            "endpoint": bench.url,
            "certificate": str(keys.client),
            "privateKey": str(keys.client_key),
            "server": str(keys.server),
            "applicationUri": CLIENT_URI,
            "user": "otto",
            "password": PASSWORD,
            "namespace": TAGS,
            "packages": str(packages),
        }
        client = await asyncio.create_subprocess_exec(
            sys.executable, str(PEER), json.dumps(options), stdout=asyncio.subprocess.PIPE
        )
        assert client.stdout is not None
        said: list[str] = []
        async with asyncio.timeout(PATIENCE_S):
            while line := (await client.stdout.readline()).decode().strip() or not client.stdout.at_eof():
                said.append(str(line))
                if line == "subscribed":
                    break
            tell(bench, first_degc=23.25)
            rest = asyncio.ensure_future(client.communicate())
            while not rest.done():
                await bench.rig.turn()
                await asyncio.sleep(0.02)
        said += rest.result()[0].decode().splitlines()
    (result,) = (line.removeprefix("result ") for line in said if line.startswith("result "))
    assert json.loads(result) == {
        "value": 21.5,
        "source_ms": round(NOW.utc_s * 1000),
        "held": [22.0, json.loads(result)["held"][1]],
        "unit": "°C",
        "heard": 23.25,
        "write": "BAD_NOT_WRITABLE",
        "viewer_called": "BAD_USER_ACCESS_DENIED",
        "wrong_password": True,
        "anonymous": True,
    }
