"""Debian's PostgreSQL, a server of its own for as long as tests need it."""

import contextlib
import os
import pwd
import shutil
import signal
import subprocess
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import psycopg
import pytest

from daemon.simulation.processes import free_port

PATIENCE_S = 60.0
FOLDERS = sorted(Path("/usr/lib/postgresql").glob("*/bin"))
USER, PASSWORD = "toolpoint", "lathe 7"


class Server:
    """One server with the role and the database `toolpoint`; it can be killed and started again."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.port = folder, free_port()
        self._user = "postgres" if os.geteuid() == 0 else None
        self._process: subprocess.Popen[bytes] | None = None

    def make(self) -> None:
        password = self.folder / "password"
        password.write_text(PASSWORD)
        if self._user is not None:
            account = pwd.getpwnam(self._user)
            for path in (self.folder, password):
                os.chown(path, account.pw_uid, account.pw_gid)
        words = ["--username=toolpoint", "--auth=scram-sha-256", f"--pwfile={password}", "--no-sync", "--locale=C"]
        self._program("initdb", "--pgdata", str(self.folder / "data"), "--encoding=UTF8", *words)
        self.start()
        with self.connection("postgres") as connection:
            connection.execute("CREATE DATABASE toolpoint")

    def start(self, *settings: str) -> None:
        words = ("fsync=off", "listen_addresses=127.0.0.1", f"unix_socket_directories={self.folder}", *settings)
        options = [word for setting in words for word in ("-c", setting)]
        deadline_s = time.monotonic() + PATIENCE_S
        while True:
            if self._process is None or self._process.poll() is not None:  # the killed one left children
                with (self.folder / "log").open("ab") as log:
                    self._process = subprocess.Popen(
                        [FOLDERS[-1] / "postgres", "-D", self.folder / "data", "-p", str(self.port), *options],
                        stdout=subprocess.DEVNULL,
                        stderr=log,
                        user=self._user,
                        cwd=self.folder,
                    )
            try:
                self.connection("postgres").close()
                return
            except psycopg.OperationalError:
                if time.monotonic() > deadline_s:
                    raise
                time.sleep(0.05)

    def kill(self, number: int = signal.SIGKILL) -> None:
        """End it without a word, as a power cut does; or with one."""
        assert self._process is not None
        self._process.send_signal(number)
        self._process.wait()
        self._process = None

    def secure(self, certificate: Path, key: Path) -> None:
        """Start again, with TLS."""
        self.kill(signal.SIGINT)
        for path in (certificate, key):
            copy = shutil.copy(path, self.folder)
            Path(copy).chmod(0o600)
            if self._user is not None:
                shutil.chown(copy, self._user)
        files = f"ssl_cert_file={self.folder / certificate.name}", f"ssl_key_file={self.folder / key.name}"
        self.start("ssl=on", *files)

    def close(self) -> None:
        if self._process is not None:
            self.kill(signal.SIGQUIT)

    def connection(self, database: str = "toolpoint", **changes: object) -> psycopg.Connection:
        known = {"host": "127.0.0.1", "port": self.port, "user": USER, "password": PASSWORD, "dbname": database}
        return psycopg.connect(**(known | changes), autocommit=True, connect_timeout=10)

    def ask(self, query: str) -> list[tuple]:
        with self.connection() as connection:
            return connection.execute(query).fetchall()

    def empty(self) -> None:
        """Take everything out again."""
        with self.connection() as connection:
            connection.execute("DROP SCHEMA IF EXISTS toolpoint CASCADE")

    def _program(self, name: str, *words: str) -> None:
        done = subprocess.run(
            [FOLDERS[-1] / name, *words],
            user=self._user,
            cwd=self.folder,
            check=False,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
        )
        assert done.returncode == 0, done.stdout.decode()


@contextlib.contextmanager
def postgresql() -> Iterator[Server]:
    """Run a server."""
    if not FOLDERS:
        pytest.skip("PostgreSQL is not installed (apt-get install postgresql)")
    folder = Path(tempfile.mkdtemp(prefix="postgresql-"))  # not in pytest's folder, which others cannot enter
    server = Server(folder)
    try:
        server.make()
        yield server
    finally:
        server.close()
        shutil.rmtree(folder, ignore_errors=True)
