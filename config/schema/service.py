"""History, local socket, telemetry and log."""

import ipaddress
import os
from pathlib import Path
from typing import Literal

from pydantic import Field, IPvAnyAddress

from config.schema.base import Days, Host, Problems, Seconds, Section, checked

LONGEST_SOCKET_PATH = 107
"""Bytes that Linux takes for the path of a local socket."""


class BackupConfig(Section):
    """Back-ups that the daemon makes by itself."""

    directory: Path = Field(
        description="the back-ups are kept here; carry them to another disk", examples=["/var/lib/toolpoint/backups"]
    )
    every_hours: float = Field(24.0, ge=0.1, le=744, description="time between back-ups [h]")
    keep: int = Field(7, ge=1, le=1000, description="so many of its back-ups are kept; older ones are removed")


class HistoryConfig(Section):
    """The SQLite store."""

    path: Path = Field(Path("/var/lib/toolpoint/history.sqlite"), description="the store's file")
    pack_after_s: Seconds = Field(7200.0, description="older whole hours are packed")
    keep_temperatures_days: Days = Field(730.0, description="temperatures are kept this long [d]")
    keep_cnc_days: Days = Field(730.0, description="CNC samples are kept this long [d]")
    keep_displacements_days: Days = Field(3650.0, description="displacements are kept this long [d]")
    keep_estimates_days: Days = Field(730.0, description="estimates are kept this long [d]")
    keep_writes_days: Days = Field(3650.0, description="the audit of writes, and probes, are kept this long [d]")
    keep_for_sinks_days: Days = Field(
        30.0, description="what a sink has not taken yet (`sinks`) is kept so much longer, then the oldest goes [d]"
    )
    backup: BackupConfig | None = Field(None, description="regular back-ups; none: only those that a person makes")


class SignaturesConfig(Section):
    """The keys that are accepted for releases, commissioning records and back-ups."""

    public_keys: Path = Field(
        Path("keys"),
        description="folder of the public keys (*.pub) that count; where it holds one, what is not signed is refused",
        examples=["/etc/toolpoint/keys"],
    )


class ServiceConfig(Section):
    """The daemon as a service."""

    socket: Path = Field(Path("/run/toolpoint/control.sock"), description="local socket for commands")
    socket_group: str | None = Field(
        None, description="group that may use the socket; none: the daemon's own", examples=["operators"]
    )
    http_host: Host = Field(
        "127.0.0.1",
        description="address of the monitor and of /metrics; any but this computer's own takes tls_certificate, "
        "tls_key and users",
    )
    http_port: int | None = Field(
        9464, ge=0, le=65535, description="port of the monitor and of /metrics; null: no web server"
    )
    tls_certificate: Path | None = Field(
        None,
        description="certificate of the monitor with its chain (PEM); its names are those by which it is reached",
        examples=["/etc/toolpoint/monitor.crt"],
    )
    tls_key: Path | None = Field(
        None, description="private key of that certificate (PEM)", examples=["/etc/toolpoint/secrets/monitor.key"]
    )
    users: Path | None = Field(
        None,
        description="accounts of the monitor (`toolpoint users`); none: whoever reaches it may look, nobody may act",
        examples=["/etc/toolpoint/users"],
    )
    trusted_proxies: list[IPvAnyAddress] = Field(
        [], description="reverse proxies whose X-Forwarded-For tells who asks", examples=[["127.0.0.1"]]
    )
    session_hours: float = Field(12.0, gt=0, le=168, description="a login to the monitor ends after this long [h]")
    log_level: Literal["debug", "info", "warning", "error"] = Field("info", description="least level logged")
    retry_min_s: Seconds = Field(0.5, description="first wait before a lost link is tried again")
    retry_max_s: Seconds = Field(30.0, description="longest wait before a lost link is tried again")

    @checked
    def _sensible(self) -> Problems:
        if len(os.fsencode(self.socket)) > LONGEST_SOCKET_PATH:
            yield ("socket",), f"a local socket's path has at most {LONGEST_SOCKET_PATH} bytes"
        elif self.retry_min_s > self.retry_max_s:
            yield ("retry_min_s",), "must not be longer than retry_max_s"

    @property
    def http_is_local(self) -> bool:
        """The monitor can be reached from this computer alone."""
        if self.http_host == "localhost":
            return True
        try:
            return ipaddress.ip_address(self.http_host).is_loopback
        except ValueError:
            return False

    @checked
    def _open_to_others(self) -> Problems:
        """Yield what the monitor lacks to be opened to other computers."""
        if (self.tls_certificate is None) != (self.tls_key is None):
            missing = "tls_key" if self.tls_key is None else "tls_certificate"
            yield (missing,), "give tls_certificate and tls_key together"
        elif self.http_port is not None and not self.http_is_local:
            absent = [key for key in ("tls_certificate", "tls_key", "users") if getattr(self, key) is None]
            if absent:
                sentence = (
                    f"{self.http_host} opens the monitor to other computers, which takes {', '.join(absent)} too "
                    "(docs/how-to/open-the-monitor.md); or keep 127.0.0.1"
                )
                yield ("http_host",), sentence


class OpcUaServerConfig(Section):
    """The daemon as an OPC UA server: every sensor, estimate, compensation and state as tags, methods for operators."""

    host: Host = Field("127.0.0.1", description="address that is listened on; 0.0.0.0: every one")
    port: int = Field(4841, ge=1, le=65535, description="TCP port; clients find it at opc.tcp://HOST:PORT/")
    certificate: Path = Field(
        description="certificate of the server (PEM or DER); its subject alternative name holds the application URI",
        examples=["/etc/toolpoint/opcua-server.der"],
    )
    private_key: Path = Field(
        description="private key of that certificate (PEM)", examples=["/etc/toolpoint/secrets/opcua-server.pem"]
    )
    trusted_clients: Path = Field(
        description="folder of the certificates of the clients that may connect; empty: nobody may",
        examples=["/etc/toolpoint/opcua-clients"],
    )
    sessions: int = Field(10, ge=1, le=50, description="so many may be logged in at a time")


class ShdrConfig(Section):
    """The daemon as an SHDR adapter, from which an MTConnect agent reads temperatures, estimate and state."""

    host: Host = Field(
        "127.0.0.1",
        min_length=1,
        description="address that is listened on; whoever reaches it may read, without a login and in the clear",
    )
    port: int = Field(7878, ge=1, le=65535, description="TCP port, which the agent's configuration names")
