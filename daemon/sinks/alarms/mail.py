"""Alarms by mail: one message over SMTP, encrypted unless the configuration says otherwise."""

import smtplib
import socket
import ssl
from collections.abc import Mapping
from contextlib import suppress
from datetime import UTC, datetime
from email import policy
from email.message import EmailMessage
from email.utils import format_datetime
from typing import Any, BinaryIO

from config.schema.sinks import SinkConfig
from config.secret_files import SecretError, read_secret
from daemon.sinks.alarms.message import Message, UnansweredError
from daemon.sinks.alarms.sending import Connection, answer
from daemon.sinks.contract import SinkError
from daemon.sinks.vouching import tls_context, unvouched

WHOLE_TIMES = 6
"""All of it may take so many times as long as one answer."""
SEVEN_BITS = policy.default.clone(cte_type="7bit")
"""Letters such as umlauts are written in ASCII: a server that does not say 8BITMIME may refuse or spoil eight bits."""
READY, GO_ON = 220, 354
FOR_GOOD = 500
"""Answers below this may be another one later: greylisting, a full mailbox."""
MOST_BYTES = 1 << 16
"""A server that says more than this is no mail server."""


class MailMessenger:
    """Hands messages to one mail server; a connection is opened for each."""

    def __init__(self, config: SinkConfig) -> None:
        assert config.mail is not None
        self._config = config.mail
        self._where = f"sink {config.name}: mail server {config.place}"
        self._unanswered = False

    def send(self, message: Message) -> str:
        """Hand a message over; raises SinkError unless the server took it, and returns whom it refused."""
        password, self._unanswered = "", False
        try:
            if self._config.password_file is not None:
                password = read_secret("password_file", self._config.password_file)
            refused = self._hand_over(self.letter(message), password)
        except SecretError as error:
            raise SinkError(f"{self._where}: {error}") from None
        except (OSError, ssl.SSLError, smtplib.SMTPException, ValueError) as error:
            kind = UnansweredError if self._unanswered else SinkError
            raise kind(f"{self._where}: {_refusal(error, password)}") from None
        return f"{self._where}: {_refused(refused)}" if refused else ""

    def letter(self, message: Message) -> EmailMessage:
        """Return the mail; a header with an end of line in it is refused by the library."""
        config, letter = self._config, EmailMessage(SEVEN_BITS)
        letter["From"], letter["To"] = config.sender, ", ".join(config.recipients)
        letter["Subject"] = message.subject
        letter["Date"] = format_datetime(datetime.fromtimestamp(message.time_utc_s, UTC))
        letter["Message-ID"] = f"<{message.number}@{config.sender.partition('@')[2]}>"
        letter["Auto-Submitted"] = "auto-generated"
        letter.set_content(message.text)
        return letter

    def _hand_over(self, letter: EmailMessage, password: str) -> dict[str, tuple[int, bytes]]:
        """Return which recipients were refused."""
        config = self._config
        context = None if config.encryption == "none" else tls_context(config.ca_certificate)
        with Connection(config.host, config.port, config.timeout_s, WHOLE_TIMES * config.timeout_s) as connection:
            own = connection.socket.getsockname()[0]
            client = _Client(local_hostname=f"[IPv6:{own}]" if ":" in own else f"[{own}]")
            client.sock = connection.socket
            if context is not None and config.encryption == "tls":
                client.sock = connection.encrypt(context)
            code, said = client.getreply()
            if code != READY:
                raise smtplib.SMTPConnectError(code, said)
            client.ehlo_or_helo_if_needed()
            if context is not None and config.encryption == "starttls":
                _start_tls(client, connection, context)
            if config.user_name is not None:
                client.login(config.user_name, password)
            try:
                refused = client.send_message(letter)
            finally:
                self._unanswered = client.unanswered
            with suppress(OSError, smtplib.SMTPException):  # the message was taken
                client.quit()
            return refused


class _Client(smtplib.SMTP):
    """A client that reads answers up to a length: lines of an answer may go on without end."""

    unanswered = False
    """The server has the message, or is getting it, and has not said that it took or refuses it."""

    def data(self, msg: Any) -> tuple[int, bytes]:
        """Hand the message over; a server that examines it first may take all the time that is left for its answer."""
        assert self.sock is not None
        wait_s = self.sock.gettimeout()
        self.sock.settimeout(None)
        said = super().data(msg)
        self.sock.settimeout(wait_s)
        return said

    def getreply(self) -> tuple[int, bytes]:
        """Return code and words of an answer."""
        if self.file is None:
            self.file = _Answers(self.sock.makefile("rb"))  # type: ignore[union-attr] # it is connected
        code, said = super().getreply()
        self.unanswered = code == GO_ON
        return code, said


class _Answers:
    """What a server says, up to a length."""

    def __init__(self, stream: BinaryIO) -> None:
        self._stream, self._left = stream, MOST_BYTES

    def readline(self, size: int) -> bytes:
        """Return a line; raises OSError when the server said too much."""
        line = self._stream.readline(size)
        self._left -= len(line)
        if self._left < 0:
            raise OSError("its answer does not end")
        return line

    def close(self) -> None:
        self._stream.close()


def _start_tls(client: smtplib.SMTP, connection: Connection, context: ssl.SSLContext) -> None:
    """Go on encrypted; what the server said before does not count."""
    if not client.has_extn("starttls"):
        raise smtplib.SMTPNotSupportedError("it offers no STARTTLS")
    code, said = client.docmd("STARTTLS")
    if code != READY:
        raise smtplib.SMTPResponseException(code, said)
    client.sock = connection.encrypt(context)
    client.file, client.helo_resp, client.ehlo_resp = None, None, None
    client.esmtp_features, client.does_esmtp = {}, False
    client.ehlo_or_helo_if_needed()


def _refusal(error: Exception, password: str) -> str:
    """Return why nothing was handed over, and which key of the configuration to look at."""
    hidden = (password,) if password else ()
    match error:
        case smtplib.SMTPAuthenticationError():
            return f"it refuses the account ({_said(error, hidden)}): check `user_name` and `password_file`"
        case smtplib.SMTPNotSupportedError():
            return f"{answer(error)}: check `encryption`, `port` and `user_name`"
        case smtplib.SMTPSenderRefused() if error.smtp_code >= FOR_GOOD:
            return f"it refuses the sender ({_said(error, hidden)}): check `sender` and `user_name`"
        case smtplib.SMTPRecipientsRefused():
            return _refused(error.recipients)
        case smtplib.SMTPResponseException() if error.smtp_code > 0:
            return f"it answers {_said(error, hidden)}: look at the server; it is tried again"
        case ssl.SSLCertVerificationError():
            return unvouched(error, "host")
        case ssl.SSLError():
            return f"no encryption ({error.reason or 'broken off'}): check `encryption` and `port`"
        case TimeoutError():
            hint = "check `host`, `port`, `encryption`, `timeout_s` and the network"
            return f"no answer ({answer(error) or 'timed out'}): {hint}"
        case smtplib.SMTPServerDisconnected() if str(error).endswith("timed out"):  # as the library names silence
            return _refusal(TimeoutError(), password)
        case smtplib.SMTPServerDisconnected():
            return f"it ended the connection ({answer(error, *hidden)}): check `port` and `encryption`"
        case socket.gaierror():
            return "no address is known for it: check `host`"
        case OSError():
            return f"cannot be reached ({answer(error.strerror or error)}): check `host`, `port`, and that it runs"
    return f"does not answer as a mail server does ({type(error).__name__}): check `host` and `port`"


def _refused(recipients: Mapping[str, tuple[int, bytes]]) -> str:
    """Return whom the server takes nothing for, and whether that is for good."""
    names = ", ".join(sorted(recipients))
    code, said = max(recipients.values())
    if code >= FOR_GOOD:
        return f"it refuses {names}: check `recipients`"
    return f"it takes nothing for {names} now ({code} {answer(said.decode('utf-8', 'replace'))}): look at the server"


def _said(error: smtplib.SMTPResponseException, hidden: tuple[str, ...]) -> str:
    said = error.smtp_error
    text = said.decode("utf-8", "replace") if isinstance(said, bytes) else said
    return f"{error.smtp_code} {answer(text, *hidden)}"
