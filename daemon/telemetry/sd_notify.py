"""The service manager's notification protocol (sd_notify): ready, watchdog, status, stopping."""

import os
import socket


class ServiceManager:
    """Sends datagrams to the socket that systemd named in NOTIFY_SOCKET; silent without one."""

    def __init__(self, environment: dict[str, str] | None = None) -> None:
        values = dict(os.environ) if environment is None else environment
        self._address = values.get("NOTIFY_SOCKET", "")
        self._socket: socket.socket | None = None
        if self._address:
            self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC)
            self._socket.setblocking(False)
        self._untold = ""
        """That the daemon is ready, until the manager has taken it."""

    def ready(self, status: str) -> None:
        self._untold = "READY=1\n"
        self._send(f"STATUS={' '.join(status.split())}")

    def watchdog(self, status: str) -> None:
        self._send(f"WATCHDOG=1\nSTATUS={' '.join(status.split())}")  # a second line would be a message of its own

    def stopping(self) -> None:
        self._send("STOPPING=1")

    def _send(self, message: str) -> None:
        if self._socket is None:
            return
        address = "\0" + self._address[1:] if self._address.startswith("@") else self._address
        try:
            self._socket.sendto((self._untold + message).encode(), address)
        except OSError:
            # Nobody listens, or nobody has read for many messages: control goes on, and the watchdog does its work.
            return
        self._untold = ""
