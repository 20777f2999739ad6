"""Two writers on one CNC: the second is refused in words, however its configuration looks."""

import os
from pathlib import Path

import pytest
from control_rig import machine
from other_user import in_child

from config.schema.cnc import CncConfig
from config.schema.cnc_drivers import OpcUaConfig
from daemon.cnc.cnc_lock import CncLock, CncLockError


def cnc(tmp_path: Path, endpoint: str) -> CncConfig:
    there = machine(tmp_path).cnc
    assert there.opcua is not None
    opcua: OpcUaConfig = there.opcua.model_copy(update={"endpoint": endpoint})
    return there.model_copy(update={"opcua": opcua})


def endpoint_of(name: str) -> str:
    """Return an address that no other test run on this computer uses."""
    return f"opc.tcp://{name}-{os.getpid()}:4840"


def test_a_second_writer_is_told_who_the_first_is(tmp_path: Path) -> None:
    endpoint = endpoint_of("mill")

    def second() -> str:
        try:
            CncLock(cnc(tmp_path, endpoint.replace("mill", "MILL") + "/other/path")).acquire()
        except CncLockError as error:
            return str(error)
        return "acquired"

    with CncLock(cnc(tmp_path, endpoint)):
        for _ in range(3):  # and every time, as when it is started again and again
            said = in_child(second)
        assert f"process {os.getpid()} (uid {os.getuid()}) on this computer writes to this CNC already" in said
        with pytest.raises(CncLockError, match="this process on this computer"):
            CncLock(cnc(tmp_path, endpoint)).acquire()
        with CncLock(cnc(tmp_path, endpoint_of("lathe"))):
            pass
    assert in_child(second) == "acquired"


def test_a_killed_writer_leaves_no_lock(tmp_path: Path) -> None:
    lock = CncLock(cnc(tmp_path, endpoint_of("killed")))

    def first() -> str:
        lock.acquire()
        os._exit(9)

    in_child(first)
    with lock:
        pass
