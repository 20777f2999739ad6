"""Asks a running daemon over its local socket."""

import json
import socket
from pathlib import Path
from typing import Any

from daemon.monitor.control_socket import RequestError
from models.json_values import all_printable


class DaemonUnreachableError(Exception):
    """No daemon answers at the socket; the text says what to do."""


class ControlClient:
    """A blocking client for the command line."""

    def __init__(self, path: Path, timeout_s: float = 10.0) -> None:
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        self._socket.settimeout(timeout_s)
        try:
            self._socket.connect(str(path))
        except PermissionError as error:
            raise DaemonUnreachableError(
                f"{path}: permission denied; `service.socket_group` names who may use it: set it, restart the daemon, "
                "and let this account be in that group"
            ) from error
        except OSError as error:
            raise DaemonUnreachableError(
                f"{path}: no daemon answers ({error.strerror}); is it running? `systemctl status toolpoint`"
            ) from error
        self._stream = self._socket.makefile("rb")

    def ask(self, command: str, **arguments: Any) -> dict[str, Any]:
        """Send one request and return its answer; raises RequestError when it was refused."""
        message = json.dumps({"command": command, **arguments}).encode() + b"\n"
        try:
            self._socket.sendall(message)
            line = self._stream.readline()
        except ConnectionError as error:
            raise DaemonUnreachableError("the daemon closed the connection") from error
        except OSError as error:
            raise DaemonUnreachableError(f"the daemon did not answer: {error}") from error
        if not line:
            raise DaemonUnreachableError("the daemon closed the connection")
        answer = all_printable(json.loads(line), keep="\n")
        assert isinstance(answer, dict)
        if not answer.pop("ok"):
            raise RequestError(str(answer["error"]))
        return answer

    def close(self) -> None:
        self._stream.close()
        self._socket.close()
