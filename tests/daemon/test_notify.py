"""The service manager's protocol, over a real datagram socket."""

import asyncio
import socket

import pytest
from control_rig import HandClock, Rig, machine, record_for, running
from memory_cnc import MemoryNc

from daemon.telemetry.sd_notify import ServiceManager


@pytest.fixture
def listener(tmp_path):
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as listener:
        listener.bind(str(tmp_path / "notify"))
        listener.settimeout(30.0)
        yield listener


def test_messages_are_systemds(listener):
    manager = ServiceManager({"NOTIFY_SOCKET": listener.getsockname()})
    manager.ready("running")
    manager.watchdog("ACTIVE")
    manager.stopping()
    received = [listener.recv(1000).decode().split("\n") for _ in range(3)]
    assert received == [["READY=1", "STATUS=running"], ["WATCHDOG=1", "STATUS=ACTIVE"], ["STOPPING=1"]]


def test_what_a_server_says_is_no_message_of_ours(listener):
    """The status of a sink and of the plant's store holds sentences of a database or broker."""
    manager = ServiceManager({"NOTIFY_SOCKET": listener.getsockname()})
    manager.ready("sink plant: no\nMAINPID=1")
    manager.watchdog("sink plant: no\r\nSTOPPING=1")
    received = [listener.recv(1000).decode().split("\n") for _ in range(2)]
    assert received == [
        ["READY=1", "STATUS=sink plant: no MAINPID=1"],
        ["WATCHDOG=1", "STATUS=sink plant: no STOPPING=1"],
    ]


def test_a_manager_that_does_not_read_holds_nothing_up(listener):
    manager = ServiceManager({"NOTIFY_SOCKET": listener.getsockname()})
    for _ in range(1000):
        manager.watchdog("ACTIVE")
    manager.ready("running")
    listener.setblocking(False)
    received = []
    with pytest.raises(BlockingIOError):
        while True:
            received.append(listener.recv(1000))
    assert {each.split(b"\n")[0] for each in received} == {b"WATCHDOG=1"}
    manager.watchdog("ACTIVE")
    manager.watchdog("ACTIVE")
    assert listener.recv(1000) == b"READY=1\nWATCHDOG=1\nSTATUS=ACTIVE", "or the start would end at its time limit"
    assert listener.recv(1000) == b"WATCHDOG=1\nSTATUS=ACTIVE"


async def test_the_watchdog_is_fed_by_the_control_tick_and_by_nothing_else(listener, tmp_path):
    manager = ServiceManager({"NOTIFY_SOCKET": listener.getsockname()})
    listener.setblocking(False)
    configuration, clock = machine(tmp_path), HandClock()
    rig = Rig(configuration, MemoryNc(configuration, clock), clock, record=record_for(configuration))
    rig.on_tick = lambda: manager.watchdog("x")
    loop = asyncio.get_running_loop()
    async with running(rig), asyncio.timeout(30):
        task = asyncio.create_task(rig.control.run())
        try:
            for _ in range(3):
                clock.monotonic_s += 1.1
                rig.control._inbox.wake()
                assert (await loop.sock_recv(listener, 1000)).startswith(b"WATCHDOG=1")
        finally:
            task.cancel()
            await asyncio.gather(task, return_exceptions=True)
    with pytest.raises(BlockingIOError):
        while True:
            listener.recv(1000)
