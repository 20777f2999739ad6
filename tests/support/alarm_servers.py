"""Real servers that take alarms: SMTP (aiosmtpd) and HTTP (the standard library's), with and without TLS."""

import asyncio
import json
import ssl
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from email import message_from_bytes, policy
from email.message import EmailMessage
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

from aiosmtpd.controller import Controller
from aiosmtpd.smtp import AuthResult

from daemon.simulation.processes import free_port


def server_context(folder: Path) -> ssl.SSLContext:
    """TLS with the certificate that `make_certificate` wrote into a folder."""
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.load_cert_chain(folder / "monitor.crt", folder / "monitor.key")
    return context


@dataclass
class MailBox:
    """What a mail server took, and whom it refuses."""

    port: int
    letters: list[EmailMessage] = field(default_factory=list)
    envelopes: list[tuple[str, list[str]]] = field(default_factory=list)
    refused: tuple[str, ...] = ()
    refusal: str = "550 no such mailbox"
    account: tuple[str, str] | None = None
    answer: str = "250 OK"
    answer_after_s: float = 0.0

    async def handle_RCPT(self, server, session, envelope, address, options):
        if address in self.refused:
            return self.refusal
        envelope.rcpt_tos.append(address)
        return "250 OK"

    async def handle_DATA(self, server, session, envelope):
        if self.answer.startswith("250"):
            self.letters.append(message_from_bytes(envelope.content, policy=policy.default))
            self.envelopes.append((envelope.mail_from, list(envelope.rcpt_tos)))
        await asyncio.sleep(self.answer_after_s)
        return self.answer

    def __call__(self, server, session, envelope, mechanism, auth_data) -> AuthResult:
        given = (auth_data.login.decode(), auth_data.password.decode())
        return AuthResult(success=given == self.account, handled=False)


@contextmanager
def mail_server(tls: ssl.SSLContext | None = None, *, starttls: bool = True, **settings: Any) -> Iterator[MailBox]:
    """Serve SMTP on this computer; `settings`: of the box."""
    box = MailBox(free_port(), **settings)
    known: dict[str, Any] = {"authenticator": box, "auth_required": box.account is not None}
    if tls is not None and starttls:
        known |= {"tls_context": tls, "require_starttls": True}
    elif tls is not None:
        known |= {"ssl_context": tls, "auth_require_tls": False}  # aiosmtpd does not count implicit TLS
    controller = Controller(box, hostname="127.0.0.1", port=box.port, **known)
    controller.start()
    try:
        yield box
    finally:
        controller.stop()


@dataclass
class Posts:
    """What a web server took, and what it answers."""

    url: str = ""
    status: int = 200
    body: bytes = b"ok"
    headers: dict[str, str] = field(default_factory=dict)
    taken: list[dict[str, Any]] = field(default_factory=list)
    asked: list[dict[str, str]] = field(default_factory=list)


@contextmanager
def web_server(tls: ssl.SSLContext | None = None, **settings: Any) -> Iterator[Posts]:
    """Serve HTTP on this computer."""
    posts = Posts(**settings)

    class Handler(BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            body = self.rfile.read(int(self.headers["Content-Length"]))
            posts.asked.append({"path": self.path, **{key.lower(): value for key, value in self.headers.items()}})
            if 200 <= posts.status < 300:
                posts.taken.append(json.loads(body))
            self.send_response(posts.status)
            for key, value in posts.headers.items():
                self.send_header(key, value)
            self.send_header("Content-Length", str(len(posts.body)))
            self.end_headers()
            self.wfile.write(posts.body)

        def log_message(self, *_: object) -> None:
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    if tls is not None:
        server.socket = tls.wrap_socket(server.socket, server_side=True)
    posts.url = f"{'http' if tls is None else 'https'}://localhost:{server.server_port}/hooks/42"
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
    thread.start()
    try:
        yield posts
    finally:
        server.shutdown()
        server.server_close()
        thread.join()
