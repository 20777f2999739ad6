"""The person at the machine of a fault campaign: switches on, acknowledges, and does what the script says."""

import contextlib
import json
import socket
from collections import deque
from pathlib import Path
from typing import Any

from daemon.simulation.faults.invariants import Claims
from daemon.simulation.faults.script import Happening, Incident

ROUND_S = 20.0
"""The person looks at the machine this often [s]."""
PATIENCE_S = 60.0
"""A person needs so long to see that something must be done [s]."""
LONG_HOLD_S = 240.0
"""After holding for so long the person switches on again, in case the daemon waits for that [s]."""


class Person:
    """Sends requests to the daemon over its local socket; never waits for an answer."""

    def __init__(self, path: Path, axes: tuple[str, ...]) -> None:
        self._path = path
        self._axes = axes
        self._socket: socket.socket | None = None
        self._received = b""
        self._asked: deque[str] = deque()
        self._since: tuple[str, float] = ("", 0.0)
        self._resting_until_s = 0.0
        self._asked_at_s = -PATIENCE_S
        self.acknowledges = 0
        self.refusals: list[str] = []

    def hang_up(self) -> None:
        if self._socket is not None:
            self._socket.close()
        self._socket = None
        self._received = b""
        self._asked.clear()

    def round(self, time_s: float, claims: Claims | None, *, calm: bool) -> bool:
        """Look at the machine; return whether an acknowledgement was asked for. `calm`: nothing is going on."""
        self._listen()
        if claims is None:
            return False
        if claims.state != self._since[0]:
            self._since = (claims.state, time_s)
        if time_s - self._since[1] < PATIENCE_S or time_s - self._asked_at_s < PATIENCE_S:
            return False
        if claims.state == "FAULT" and calm:
            self._asked_at_s = time_s
            self.acknowledges += 1
            return self._ask("acknowledge", fault=claims.fault)
        off = claims.state == "OFF" or (claims.state == "RETREAT" and not any(claims.wanted))
        long_hold = claims.state == "HOLD" and time_s - self._since[1] > LONG_HOLD_S
        if (off or long_hold) and time_s >= self._resting_until_s:
            self._asked_at_s = time_s
            self._ask("enable")
        return False

    def do(self, happening: Happening) -> None:
        match happening.kind:
            case Incident.DISABLED_AXIS:
                self._ask("disable", axes=[self._axes[int(happening.target or 0) % len(self._axes)]])
            case Incident.DISABLED:
                self._ask("disable")
            case Incident.ZEROED:
                self._ask("disable", zero=True)
            case Incident.HAND_REFERENCE:
                self._ask("reference")
        self._resting_until_s = max(self._resting_until_s, happening.end_s)

    def undo(self, happening: Happening) -> None:
        """Switch on again what the script had switched off."""
        if happening.kind in (Incident.DISABLED_AXIS, Incident.DISABLED, Incident.ZEROED):
            self._ask("enable")

    def _ask(self, command: str, **arguments: Any) -> bool:
        if not self._connected():
            return False
        assert self._socket is not None
        try:
            self._socket.send(json.dumps({"command": command, **arguments}).encode() + b"\n")
        except OSError:
            self.hang_up()
            return False
        self._asked.append(command)
        return True

    def _connected(self) -> bool:
        if self._socket is not None:
            return True
        attempt = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        attempt.setblocking(False)
        with contextlib.suppress(OSError):
            attempt.connect(str(self._path))
            self._socket = attempt
            return True
        attempt.close()
        return False

    def _listen(self) -> None:
        if self._socket is None:
            return
        try:
            while data := self._socket.recv(1 << 16):
                self._received += data
        except BlockingIOError:
            pass
        except OSError:
            self.hang_up()
            return
        *answers, self._received = self._received.split(b"\n")
        for answer in answers:
            content = json.loads(answer)
            command = self._asked.popleft()
            if not content["ok"]:
                self.refusals.append(f"{command}: {content['error']}")
                del self.refusals[:-50]


CROWD = 40
"""More connections than the daemon serves at a time."""
HALF_A_REQUEST = b'{"command": "enab'
STRANGE_REQUEST = b'{"command": "disable", "axes": ["\\ud800\\u001b[2J"]}\n'


class Crowd:
    """Connects to the local socket and says half of something; one asks for an axis that no terminal can show."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._sockets: list[socket.socket] = []

    def come(self) -> None:
        for number in range(CROWD):
            one = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
            one.setblocking(False)
            self._sockets.append(one)
            with contextlib.suppress(OSError):
                one.connect(str(self._path))
                one.send(STRANGE_REQUEST if number == 0 else HALF_A_REQUEST)

    def go(self) -> None:
        for one in self._sockets:
            one.close()
        self._sockets.clear()
