"""Keeps a second writer on this computer away from a CNC, whatever store it keeps.

A name in the kernel's table of local sockets, gone with its process. It reaches as far as the network namespace; a
writer on another computer is found by its values, which are foreign.
"""

import hashlib
import os
import socket
import struct
from typing import Self

from config.schema.cnc_drivers import CncDriverConfig
from models.errors import RefusedInputError

_PEER = struct.Struct("3i")


class CncLockError(RefusedInputError):
    """Another process on this computer writes to this CNC; the text is fit for an operator."""


class CncLock:
    """The only writer to one CNC; held from `acquire` to `release`."""

    def __init__(self, cnc: CncDriverConfig) -> None:
        self._address = cnc.connection.address
        digest = hashlib.sha256(f"{cnc.driver} {self._address}".encode()).hexdigest()
        self._name = f"\0toolpoint-cnc-{digest[:32]}"
        self._socket: socket.socket | None = None

    def acquire(self) -> None:
        """Take the lock, or raise CncLockError naming who holds it."""
        listening = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM | socket.SOCK_CLOEXEC)
        try:
            listening.bind(self._name)
            listening.listen(socket.SOMAXCONN)  # nobody accepts: each who has asked stays in the queue
        except OSError as error:
            listening.close()
            raise CncLockError(
                f"{self._address}: {self._holder()} on this computer writes to this CNC already; two writers would "
                "take each other's values for foreign ones. Stop that process, or give this one another CNC"
            ) from error
        self._socket = listening

    def _holder(self) -> str:
        try:
            with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as asking:
                asking.setblocking(False)
                asking.connect(self._name)
                process, user, _ = _PEER.unpack(asking.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _PEER.size))
        except OSError:
            return "another process"
        return f"process {process} (uid {user})" if process != os.getpid() else "this process"

    def release(self) -> None:
        """Let another writer in; without effect when the lock is not held."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def __enter__(self) -> Self:
        self.acquire()
        return self

    def __exit__(self, *_: object) -> None:
        self.release()
