"""The web server: bounded connections, TLS where it is configured, and nobody who is slow holds a place."""

import asyncio
import socket
import ssl
from collections.abc import Callable, Sequence
from pathlib import Path

import h11
import structlog
import uvicorn
from cryptography import x509
from starlette.types import ASGIApp
from uvicorn.protocols.http.h11_impl import H11Protocol
from uvicorn.server import ServerState

from config.files import read_closed, read_whole, stamp_of
from daemon.monitor.connections import BoundedConnections, Conversation
from daemon.monitor.listening import listening
from daemon.monitor.web.gate import CLOSE, HEADERS, SEND_S
from daemon.monitor.web.problems import problem_response

log = structlog.get_logger(__name__)

HEAD_S = 10.0
"""A request's head must have arrived within this [s]."""
IDLE_S = 15
"""A connection without a request is ended after this [s]."""
HANDSHAKE_S = 10.0
WAITING_CONNECTIONS = MOST_CONNECTIONS = 256
"""So many connections wait in the kernel until they are taken, and are open at a time: the pages of 50 viewers."""
SHARE_OF_DESCRIPTORS = 4
HEADER_LINES = [(name.encode(), value.encode()) for name, value in HEADERS.items()]
LONGEST_HEAD = 16384
"""A head of a request that has not ended by then is refused [byte]."""
PIECE = 1024


class _Connection(H11Protocol):
    """HTTP on one connection, which says when it ends and is ended when a request's head does not arrive."""

    def __init__(self, config: uvicorn.Config, state: ServerState, conversation: Conversation) -> None:
        super().__init__(config=config, server_state=state, app_state={"abort": self._abort})
        self.ended = asyncio.Event()
        self._conversation = conversation
        self._head: asyncio.TimerHandle | None = None
        self._untaken: asyncio.TimerHandle | None = None

    def _abort(self) -> None:
        self.transport.abort()

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        super().connection_made(transport)
        self._wait_for_head()

    def data_received(self, data: bytes) -> None:
        """Take what has come, piece by piece: the bound of a head counts only while it has not ended."""
        for at in range(0, len(data), PIECE):
            super().data_received(data[at : at + PIECE])
            if self.transport.is_closing():
                return
        self._look()

    def send_400_response(self, msg: str) -> None:
        """Refuse what is no HTTP, or longer than we read; `msg` is none of a person's words."""
        refused = problem_response(
            400, f"this is no HTTP request, or its head is longer than {LONGEST_HEAD} byte", CLOSE
        )
        for event in (
            h11.Response(status_code=400, headers=[*HEADER_LINES, *refused.raw_headers]),
            h11.Data(data=bytes(refused.body)),
            h11.EndOfMessage(),
        ):
            self.transport.write(self.conn.send(event) or b"")
        self.transport.close()

    def on_response_complete(self) -> None:
        super().on_response_complete()
        self._look()
        if self._untaken is not None:
            self._untaken.cancel()
        self._wait_until_taken(0)

    def _under_way(self) -> bool:
        return self.cycle is not None and not self.cycle.response_complete

    def _wait_until_taken(self, waited: int) -> None:
        """End the connection when of an answer that is complete nothing is taken: all of it waits in memory."""
        # Of a next answer that is under way each piece must be taken in time, and this begins anew at its end.
        waits = 0 if self._under_way() else self.transport.get_write_buffer_size()
        if 0 < waited <= waits:
            self._abort()
        elif waits:
            self._untaken = self.loop.call_later(SEND_S, self._wait_until_taken, waits)

    def _look(self) -> None:
        """Bound the time of a head that has begun; note whether a request is under way."""
        under_way = self._under_way()
        if under_way and not self._conversation.busy:
            self._conversation.busy = True
            self._conversation.on_request()
        self._conversation.busy = under_way
        if under_way and self._head is not None:
            self._head.cancel()
            self._head = None
        elif not under_way and self._head is None and self.conn.trailing_data[0]:
            self._wait_for_head()

    def _wait_for_head(self) -> None:
        self._head = self.loop.call_later(HEAD_S, self._abort)

    def connection_lost(self, exc: Exception | None) -> None:
        super().connection_lost(exc)
        self._unset_keepalive_if_required()
        for timer in (self._head, self._untaken):
            if timer is not None:
                timer.cancel()
        self.ended.set()


class Certificate:
    """The certificate of the monitor; one that was replaced on the disk counts from the next connection on.

    One that does not fit the key, such as a new one before its key is there, leaves the old one in use.
    """

    def __init__(self, certificate: Path, key: Path) -> None:
        """Raise OSError where the files cannot be read or are no certificate and key."""
        self._certificate, self._key = certificate, key
        self._seen = stamp_of(certificate, key)
        self.context, self.names = self._loaded()

    def _loaded(self) -> tuple[ssl.SSLContext, set[str]]:
        """Return what a connection needs, and the names that the certificate is for."""
        context = ssl.create_default_context(ssl.Purpose.CLIENT_AUTH)
        context.minimum_version = ssl.TLSVersion.TLSv1_2
        pem, key = read_whole(self._certificate), read_closed(self._key)  # OpenSSL waits for the end of a pipe
        if b"ENCRYPTED" in key:
            raise ValueError(
                f"{self._key} has a passphrase, which nobody is there to type: `openssl pkey` takes it off"
            )
        context.load_cert_chain(self._certificate, self._key, password="")  # whatever it is, nobody is asked
        return context, names_of_certificate(pem)

    def now(self) -> ssl.SSLContext:
        """Return the context for a new connection."""
        try:
            if (seen := stamp_of(self._certificate, self._key)) != self._seen:
                self._seen = seen
                self.context, self.names = self._loaded()
        except (OSError, ValueError) as error:
            log.warning("monitor.certificate_not_taken", file=str(self._certificate), problem=str(error))
        return self.context


def names_of_certificate(pem: bytes) -> set[str]:
    """Return the names and addresses that a certificate is for; raises ValueError when it is none."""
    certificate = x509.load_pem_x509_certificate(pem)
    try:
        found = certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    except x509.ExtensionNotFound:
        return set()
    return {str(each).lower() for kind in (x509.DNSName, x509.IPAddress) for each in found.get_values_for_type(kind)}


async def serve_web(
    application: ASGIApp,
    host: str,
    port: int,
    certificate: Certificate | None = None,
    on_serving: Callable[[], None] = lambda: None,
    trusted_proxies: Sequence[str] = (),
) -> None:
    """Serve until cancelled; raises OSError when the port is taken."""
    config = uvicorn.Config(
        application,
        http=_Connection,
        ws="none",
        lifespan="off",
        log_config=None,
        log_level="critical",  # what a peer sends wrongly is its own affair, and would fill the log
        access_log=False,
        server_header=False,
        forwarded_allow_ips=list(trusted_proxies),  # of nobody else X-Forwarded-For is believed
        timeout_keep_alive=IDLE_S,
        h11_max_incomplete_event_size=LONGEST_HEAD,
    )
    config.load()
    state = ServerState()
    state.default_headers = config.encoded_headers

    async def serve(connection: socket.socket, conversation: Conversation) -> None:
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        transport, protocol = await asyncio.get_running_loop().connect_accepted_socket(
            lambda: _Connection(config, state, conversation),
            connection,
            ssl=certificate.now() if certificate is not None else None,
            ssl_handshake_timeout=HANDSHAKE_S if certificate is not None else None,
        )
        try:
            await protocol.ended.wait()
        finally:
            transport.abort()

    with listening(host, port, WAITING_CONNECTIONS) as listener:
        on_serving()
        await BoundedConnections(
            "monitor", serve, most=MOST_CONNECTIONS, share_of_descriptors=SHARE_OF_DESCRIPTORS
        ).run(listener)
