"""The CNC driver against a CNC in another process that freezes, comes back and dies."""

import asyncio
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

SUPPORT = Path(__file__).resolve().parents[1] / "support"
sys.path.insert(0, str(SUPPORT))
from scripted_machine import GROUPS, cnc_config  # noqa: E402

from drivers.clock import SystemClock  # noqa: E402
from drivers.contract import LinkError  # noqa: E402
from drivers.opcua.cnc import OpcUaCnc  # noqa: E402

pytestmark = pytest.mark.wires
IMPATIENT_S = 3.0  # a slow computer still connects within it


class ServingProcess:
    """A scripted CNC in a process of its own."""

    def __init__(self) -> None:
        self.process = subprocess.Popen(
            [sys.executable, str(SUPPORT / "serve_cnc.py")], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )
        assert self.process.stdout is not None
        self.endpoint = self.process.stdout.readline().split()[0]


@pytest.fixture
def serving() -> Iterator[ServingProcess]:
    serving = ServingProcess()
    yield serving
    serving.process.kill()
    serving.process.communicate()


async def test_frozen_cnc_ends_every_call_until_it_thaws_and_its_death_ends_a_waiting_write(
    serving: ServingProcess,
) -> None:
    config = cnc_config(serving.endpoint, timeout_s=IMPATIENT_S)
    patient = cnc_config(serving.endpoint)
    reader, writer = OpcUaCnc(config, SystemClock()), OpcUaCnc(config, SystemClock())
    await reader.connect()
    await writer.connect()
    before = asyncio.all_tasks()
    serving.process.send_signal(signal.SIGSTOP)
    with pytest.raises(LinkError, match=r"did not answer within 3 s while reading"):
        await reader.read([500])
    with pytest.raises(LinkError, match=r"did not answer within 3 s while writing macro variables"):
        await writer.write_macros(GROUPS)
    with pytest.raises(LinkError, match=r"did not answer within 3 s while connecting"):
        await OpcUaCnc(config, SystemClock()).connect()
    await reader.close()
    await writer.close()
    assert asyncio.all_tasks() <= before

    serving.process.send_signal(signal.SIGCONT)
    cnc = OpcUaCnc(patient, SystemClock())
    await cnc.connect()
    assert (await cnc.read([])).program == 1000
    await cnc.write_macros(GROUPS)
    assert await cnc.read_macros([505]) == {505: 1.0}

    serving.process.send_signal(signal.SIGSTOP)
    write = asyncio.create_task(cnc.write_macros(GROUPS))
    await asyncio.sleep(0.05)
    serving.process.kill()
    with pytest.raises(LinkError, match="while writing macro variables"):
        await write
    await cnc.close()
