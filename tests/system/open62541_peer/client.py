"""Reads, subscribes to, writes and calls the daemon's OPC UA server through open62541, and prints what happened.

python client.py '{"endpoint": ..., "certificate": ..., "privateKey": ..., "server": ..., "applicationUri": ...,
                   "user": ..., "password": ..., "namespace": ..., "packages": folder of the library}'
"""

import asyncio
import json
import sys
from typing import Any

OPTIONS = json.loads(sys.argv[1])
sys.path.append(OPTIONS["packages"])

import o6  # noqa: E402

POLICY = "http://opcfoundation.org/UA/SecurityPolicy#Basic256Sha256"
ENCRYPTED = 3
UNIX_EPOCH = 116_444_736_000_000_000
"""1970-01-01 as OPC UA counts [100 ns]."""


def client(**who: str) -> Any:
    return o6.Client(
        OPTIONS["endpoint"],
        certificate=OPTIONS["certificate"],
        privateKey=OPTIONS["privateKey"],
        trustList=[OPTIONS["server"]],
        securityMode=ENCRYPTED,
        securityPolicy=POLICY,
        applicationUri=OPTIONS["applicationUri"],
        **who,
    )


async def refused(**who: str) -> bool:
    """Whether nobody of this name is admitted."""
    stranger = client(**who)
    try:
        await stranger.connect()
    except Exception:
        return True
    await stranger.disconnect()
    return False


async def main() -> None:
    user = {"username": OPTIONS["user"], "password": OPTIONS["password"]}
    reader = client(**user)
    await reader.connect()
    index = list(await reader.read("i=2255")).index(OPTIONS["namespace"])

    def node(name: str) -> str:
        return f"ns={index};s={name}"

    tag = await reader.read(node("temperature.1"), valueOnly=False)
    held = await reader.read(node("temperature.2"), valueOnly=False)
    unit = await reader.read(node("temperature.1.EngineeringUnits"))
    heard: asyncio.Future[float] = asyncio.get_running_loop().create_future()

    def changed(value: Any) -> None:
        if value == 23.25 and not heard.done():
            heard.set_result(float(value))
        else:
            print("subscribed", flush=True)

    item = reader.monitor(node("temperature.1"), changed, 250.0)
    if asyncio.iscoroutine(item) or asyncio.isfuture(item):
        await item
    told = await heard
    write = await reader.write(node("temperature.1"), 1.0)
    called = await reader.call(node("machine"), node("reference"))
    await reader.disconnect()
    result = {
        "value": float(tag.value),
        "source_ms": (int(tag.sourceTimestamp) - UNIX_EPOCH) // 10_000,
        "held": [float(held.value), str(held.status)],
        "unit": unit.displayName.text,
        "heard": told,
        "write": str(write),
        "viewer_called": str(called[0]),
        "wrong_password": await refused(username=OPTIONS["user"], password="wrong"),
        "anonymous": await refused(),
    }
    print("result " + json.dumps(result), flush=True)


asyncio.run(main())
