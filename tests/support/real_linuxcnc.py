"""LinuxCNC itself, from Debian's package, with simulated hardware: headless, in namespaces, as an ordinary user.

`command` starts LinuxCNC's programs by hand, because its own script wants a display. The namespaces keep its port
5005, its shared memory and its processes apart from everything else on the computer.
"""

import asyncio
import contextlib
import json
import os
import shutil
import signal
import subprocess
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

USER, GROUP = "nobody", "nogroup"
NEEDED = ("milltask", "linuxcncsvr", "halcmd", "unshare", "nsenter", "setpriv")
ALONE = ["unshare", "--net", "--ipc", "--pid", "--fork", "--mount-proc", "--kill-child"]
AXIS = "MIN_LIMIT = -500\nMAX_LIMIT = 500\nMAX_VELOCITY = 200\nMAX_ACCELERATION = 5000\n"
INI = """[EMC]
VERSION = 1.1
MACHINE = simulated mill
DEBUG = 0
[TASK]
TASK = milltask
CYCLE_TIME = 0.005
[RS274NGC]
PARAMETER_FILE = mill.var
SUBROUTINE_PATH = .
[EMCMOT]
EMCMOT = motmod
COMM_TIMEOUT = 2.0
SERVO_PERIOD = 2000000
[EMCIO]
EMCIO = io
CYCLE_TIME = 0.050
TOOL_TABLE = mill.tbl
[TRAJ]
COORDINATES = X Y Z
LINEAR_UNITS = mm
ANGULAR_UNITS = degree
MAX_LINEAR_VELOCITY = 200
DEFAULT_LINEAR_VELOCITY = 100
NO_FORCE_HOMING = 1
[KINS]
KINEMATICS = trivkins coordinates=XYZ
JOINTS = 3
"""
HAL = """loadrt tpmod
loadrt homemod
loadrt trivkins coordinates=XYZ
loadrt motmod servo_period_nsec=2000000 num_joints=3 num_aio=64 num_dio=4
addf motion-command-handler servo-thread
addf motion-controller servo-thread
net x joint.0.motor-pos-cmd => joint.0.motor-pos-fb
net y joint.1.motor-pos-cmd => joint.1.motor-pos-fb
net z joint.2.motor-pos-cmd => joint.2.motor-pos-fb
net estop iocontrol.0.user-enable-out iocontrol.0.emc-enable-in
net prepare iocontrol.0.tool-prepare iocontrol.0.tool-prepared
net change iocontrol.0.tool-change iocontrol.0.tool-changed
"""
START = """ip link set lo up
exec setpriv --reuid {user} --regid {group} --clear-groups sh -e -c '
cd "$HOME"
linuxcncsvr -ini $HOME/mill.ini & sleep 0.3
/usr/lib/linuxcnc/realtime start
halcmd loadusr -Wn iocontrol io -ini $HOME/mill.ini
halcmd -f mill.hal
halcmd start
halcmd loadusr -Wn inihal milltask -ini $HOME/mill.ini
echo ready
exec sleep 1000'
"""
DESK = """
import json, linuxcnc, sys, time
linuxcnc.nmlfile = "/usr/share/linuxcnc/linuxcnc.nml"
stat, command, errors = linuxcnc.stat(), linuxcnc.command(), linuxcnc.error_channel()
for line in sys.stdin:
    done = []
    for what, *words in json.loads(line):
        if what == "wait":
            done.append(command.wait_complete(*words))
        elif what == "messages":
            while message := errors.poll():
                done.append(message[1])
        elif what == "take":
            while stat.poll() or abs(stat.ain[words[0]] - words[1]) > 1e-9:
                time.sleep(0.005)
        elif what == "pass":
            seen = 0
            while seen < 5:
                stat.poll()
                taken = stat.echo_serial_number == command.serial and not stat.queued_mdi_commands
                idle = stat.interp_state == linuxcnc.INTERP_IDLE and stat.exec_state == linuxcnc.EXEC_DONE
                seen = seen + 1 if taken and idle else 0
                if stat.interp_state == linuxcnc.INTERP_PAUSED:
                    command.auto(linuxcnc.AUTO_RESUME)
                time.sleep(0.01)
        elif what == "stand":
            seen = 0
            while seen < 5:
                stat.poll()
                idle = stat.interp_state == linuxcnc.INTERP_IDLE and stat.exec_state == linuxcnc.EXEC_DONE
                follows = max(abs(a - b) for a, b in zip(stat.position[:3], stat.actual_position[:3])) < 1e-9
                still = stat.inpos and not stat.queue and follows
                seen = seen + 1 if idle and still else 0
                time.sleep(0.02)
            done.append(list(stat.actual_position[:3]))
        else:
            getattr(command, what)(*[getattr(linuxcnc, str(word), word) for word in words])
    print(json.dumps(done), flush=True)
"""
"""What an operator does at the control: LinuxCNC's own commands, one list of them a line."""


def missing() -> str:
    """Return why LinuxCNC cannot run here, '' where it can."""
    if absent := [name for name in NEEDED if shutil.which(name) is None]:
        return f"{', '.join(absent)} is not installed (linuxcnc-uspace)"
    if os.geteuid() != 0:
        return "only root makes the namespaces in which LinuxCNC runs"
    done = subprocess.run([*ALONE, "true"], capture_output=True, check=False)
    return "" if done.returncode == 0 else "this computer allows no namespaces"


class RealLinuxcnc:
    """One LinuxCNC; its files are in a directory, so that it can be started again with them."""

    def __init__(self, directory: Path, hal: str = "", units: str = "mm") -> None:
        self.directory = directory
        self._hal = hal
        self._ini = INI.replace("LINEAR_UNITS = mm", f"LINEAR_UNITS = {units}")
        self._process: asyncio.subprocess.Process | None = None
        self._desk: asyncio.subprocess.Process | None = None
        self._init = 0

    async def start(self) -> None:
        """Start it, and a desk at which commands are given."""
        self._write_files()
        script = START.format(user=USER, group=GROUP)
        environment = {"PATH": "/usr/sbin:/usr/bin:/sbin:/bin", "HOME": str(self.directory)}
        with (self.directory / "log").open("ab") as log:
            self._process = await asyncio.create_subprocess_exec(
                *ALONE, "sh", "-e", "-c", script, stdout=subprocess.PIPE, stderr=log, env=environment
            )
        assert self._process.stdout is not None
        async with asyncio.timeout(30):
            while line := await self._process.stdout.readline():
                if line == b"ready\n":
                    break
            else:
                raise RuntimeError((self.directory / "log").read_text()[-2000:])
        (init,) = Path(f"/proc/{self._process.pid}/task/{self._process.pid}/children").read_text().split()
        self._init = int(init)  # the first process inside: all others end with it
        self._desk = await asyncio.create_subprocess_exec(
            *self.python(), "-c", DESK, stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=environment
        )

    def python(self) -> list[str]:
        """Return the command that runs the system's Python inside, as LinuxCNC's user."""
        return [*self._inside(), "env", f"HOME={self.directory}", "/usr/bin/python3"]

    def _inside(self) -> list[str]:
        enter = ["nsenter", "--target", str(self._init), "--net", "--ipc", "--pid", "--mount"]
        return [*enter, "setpriv", "--reuid", USER, "--regid", GROUP, "--clear-groups"]

    async def do(self, *commands: Sequence[Any]) -> list[Any]:
        """Give commands at the desk; return what those that ask have found."""
        assert self._desk is not None and self._desk.stdin is not None and self._desk.stdout is not None
        self._desk.stdin.write(json.dumps(commands).encode() + b"\n")
        async with asyncio.timeout(30):
            found = json.loads(await self._desk.stdout.readline())
        assert isinstance(found, list)
        return found

    async def switch_on(self) -> None:
        """End the E-stop, switch the machine on, and let the operator type."""
        await self.do(["state", "STATE_ESTOP_RESET"], ["wait"])
        await self.do(["state", "STATE_ON"], ["wait"], ["mode", "MODE_MDI"], ["wait"])

    async def mdi(self, *blocks: str) -> None:
        """Type blocks, each after the one before is done; press cycle start where one stops."""
        for block in blocks:
            await self.do(["mdi", block], ["pass"])

    async def take(self, pin: int, value: float) -> None:
        """Wait until programs read this value at an analog input: they read what its task has copied."""
        await self.do(["take", pin, value])

    async def position_mm(self) -> list[float]:
        """Return where LinuxCNC says that the axes are, once they stand [mm]."""
        (position,) = await self.do(["stand"])
        assert isinstance(position, list)
        return position

    def halcmd(self, *words: str) -> str:
        """Run halcmd inside; return what it prints."""
        return subprocess.run([*self._inside(), "halcmd", *words], check=True, capture_output=True, text=True).stdout

    async def stop(self) -> None:
        """Kill everything."""
        if self._process is not None and self._process.returncode is None:
            with contextlib.suppress(ProcessLookupError):
                os.kill(self._init, signal.SIGKILL)
        for process in (self._process, self._desk):
            if process is not None:
                await process.wait()
        self._desk = self._process = None

    def _write_files(self) -> None:
        axes = "".join(f"[AXIS_{name}]\n{AXIS}" for name in "XYZ")
        joints = "".join(
            f"[JOINT_{n}]\nTYPE = LINEAR\n{AXIS}FERROR = 10\nMIN_FERROR = 5\nHOME_SEARCH_VEL = 0\nHOME_SEQUENCE = 0\n"
            for n in range(3)
        )
        (self.directory / "mill.ini").write_text(self._ini + axes + joints, encoding="ascii")
        (self.directory / "mill.hal").write_text(HAL + self._hal, encoding="ascii")
        (self.directory / "mill.tbl").write_text("T1 P1 Z0 D1\n", encoding="ascii")
        (self.directory / "mill.var").touch()
        for path in (self.directory, *self.directory.iterdir()):
            shutil.chown(path, USER, GROUP)


@contextlib.contextmanager
def folder() -> Iterator[Path]:
    """Yield a folder that an ordinary user reaches, which those of pytest are not."""
    with tempfile.TemporaryDirectory(prefix="linuxcnc-", dir="/tmp") as name:
        Path(name).chmod(0o755)
        yield Path(name)
