"""Who may speak to the daemon, and who is named in the audit: as the kernel says, not as the client says."""

import asyncio
import grp
import os
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from control_rig import Bench, Z, running
from other_user import OTHER, as_root

from daemon.history.reader import HistoryReader
from daemon.monitor.control_client import ControlClient, DaemonUnreachableError
from daemon.monitor.control_socket import ControlSocket

PATIENCE_S = 60.0


def when_there(path: Path, ask: Callable[[ControlClient], object]) -> str:
    """Return what a client gets once the socket is there."""
    end_s = time.monotonic() + PATIENCE_S
    while not path.exists() or path.stat().st_mode & 0o070 == 0:
        assert time.monotonic() < end_s, "the socket does not appear"
        time.sleep(0.02)
    try:
        client = ControlClient(path)
        answer = str(ask(client))
        client.close()
    except DaemonUnreachableError as error:
        return str(error)
    return answer


def as_member(groups: list[int], path: Path, ask: Callable[[ControlClient], object]) -> tuple[int, int]:
    """Start a process of another user in these groups; return its number and where its answer comes out."""
    receive, send = os.pipe()
    child = os.fork()
    if child == 0:
        try:
            os.setgroups(groups)
            os.setresgid(OTHER, OTHER, OTHER)
            os.setresuid(OTHER, OTHER, OTHER)
            os.write(send, when_there(path, ask).encode())
        except BaseException as error:
            os.write(send, repr(error).encode())
        finally:
            os._exit(0)
    os.close(send)
    return child, receive


def answer_of(child: int, receive: int) -> str:
    os.waitpid(child, 0)
    said = os.read(receive, 65536).decode()
    os.close(receive)
    return said


@as_root
async def test_the_group_decides_who_may_and_the_kernel_says_who_it_was(tmp_path: Path) -> None:
    group = grp.getgrgid(1)
    with tempfile.TemporaryDirectory() as folder:
        Path(folder).chmod(0o755)
        path = Path(folder) / "s"
        member = as_member([group.gr_gid], path, lambda client: client.ask("acknowledge", fault=1))
        stranger = as_member([], path, lambda client: client.ask("acknowledge", fault=1))
        bench = Bench(tmp_path)
        async with running(bench.rig()) as rig:
            await rig.active()
            bench.nc.macros.set(Z, 0.002)
            await rig.turn()
            assert rig.state == "FAULT"
            desk = rig.desk()
            serving = asyncio.create_task(ControlSocket(path, group.gr_name, desk.handle).run())
            hearing = asyncio.create_task(asyncio.to_thread(answer_of, *member))
            while not hearing.done():  # the answer may wait for the output to decide
                await rig.turn()
                await asyncio.sleep(0.05)
            heard = await hearing
            refused = await asyncio.to_thread(answer_of, *stranger)
            serving.cancel()
            await asyncio.gather(serving, return_exceptions=True)
            assert heard.startswith("{"), heard
            assert "permission denied; `service.socket_group` names who may use it" in refused
            for _ in range(2):
                await rig.turn()
            assert rig.state != "FAULT"
            await rig.history.flushed()
            with HistoryReader(bench.configuration.history.path) as reader:
                asked = [event for event in reader.events(0.0, 1e11) if event.kind == "request"]
        event = asked[-1]
        assert event.text == "acknowledge the fault" and event.person is not None
        assert f"(uid {OTHER}, pid {member[0]})" in event.person
