"""Alarms by webhook: one POST of JSON per message."""

import http.client
import json
import re
import ssl
from urllib.parse import unquote, urlsplit

from config.schema.sinks import SinkConfig
from config.secret_files import SecretError, read_secret
from daemon.sinks.alarms.message import Message, UnansweredError
from daemon.sinks.alarms.sending import Connection, answer
from daemon.sinks.contract import SinkError
from daemon.sinks.vouching import tls_context, unvouched

HINTS = {
    301: "it moved: write its new address into `url`",
    302: "it moved: write its new address into `url`",
    307: "it moved: write its new address into `url`",
    308: "it moved: write its new address into `url`",
    401: "check `token_file`",
    403: "check `token_file` and `url`",
    404: "check `url`",
    405: "it takes no POST: check `url`",
    410: "check `url`",
    413: "it takes no message of this length: look at the server",
    429: "it asks for fewer messages: raise `alarms.interval_s`",
}
"""What the server answered -> what to do."""
TAKEN_OR_NOT = (500, 504)
"""What a program answers that failed, perhaps after it had told people, or a proxy that waited for it in vain; a proxy
that did not reach it answers 502."""
LEAST_SECRET = 6
"""Shorter parts of an address are words such as `api`, and secret to nobody [characters]."""
MOST_BYTES = 4096
"""So much of an answer is read."""


class WebhookMessenger:
    """Posts messages to one address; a connection is opened for each."""

    def __init__(self, config: SinkConfig) -> None:
        assert config.webhook is not None
        self._config = config.webhook
        self._where = f"sink {config.name}: webhook {config.place}"
        self._unanswered = False
        """The server has the message, and has not said that it took or refuses it."""

    def send(self, message: Message) -> str:
        """Post a message; raises SinkError unless it was taken, and returns ''."""
        config, self._unanswered = self._config, False
        try:
            url = config.url or read_secret("url_file", config.url_file).strip()  # type: ignore[arg-type] # one is there
            token = "" if config.token_file is None else read_secret("token_file", config.token_file).strip()
            status, said = self._post(url, token, json.dumps(message.document(), allow_nan=False).encode())
        except SecretError as error:
            raise SinkError(f"{self._where}: {error}") from None
        except (OSError, ssl.SSLError, http.client.HTTPException, ValueError) as error:
            raise self._problem(_refusal(error)) from None
        if not 200 <= status < 300:
            hint = HINTS.get(status, "look at the server; it is tried again")
            raise self._problem(f"it answers {status} {answer(said, token, *_parts(url))}".rstrip() + f": {hint}")
        return ""

    def _problem(self, text: str) -> SinkError:
        return (UnansweredError if self._unanswered else SinkError)(f"{self._where}: {text}")

    def _post(self, url: str, token: str, body: bytes) -> tuple[int, str]:
        """Return status and beginning of the answer."""
        config, parts = self._config, urlsplit(url)
        encrypted = parts.scheme == "https"
        if not (encrypted or (parts.scheme == "http" and not token)) or not parts.hostname or parts.username:
            raise SecretError("`url_file` must hold an https:// address: write it anew")
        headers = {"Host": parts.netloc, "Content-Type": "application/json", "User-Agent": "toolpoint"}
        if token:
            headers["Authorization"] = f"Bearer {token}"
        context = tls_context(config.ca_certificate) if encrypted else None
        port = parts.port or (443 if encrypted else 80)
        with Connection(parts.hostname, port, config.timeout_s, config.timeout_s) as connection:
            client = http.client.HTTPConnection(parts.hostname, port)
            client.sock = connection.socket if context is None else connection.encrypt(context)
            path = parts.path or "/"
            client.request("POST", f"{path}?{parts.query}" if parts.query else path, body, headers)
            self._unanswered = True
            response = client.getresponse()
            self._unanswered = response.status in TAKEN_OR_NOT
            taken = 200 <= response.status < 300  # nothing that comes after this can undo it
            return response.status, "" if taken else response.read(MOST_BYTES).decode("utf-8", "replace")


def _parts(url: str) -> list[str]:
    """Return what of an address a server may repeat, the longest first: whoever knows path and query may post."""
    address = url.partition("://")[2]
    words = [each for each in re.split("[/?&=]", address.partition("/")[2]) if len(each) >= LEAST_SECRET]
    return sorted({address, *words, *map(unquote, words)}, key=len, reverse=True)


def _refusal(error: Exception) -> str:
    """Return why nothing could be posted, and which key of the configuration to look at."""
    match error:
        case ssl.SSLCertVerificationError():
            return unvouched(error, "url")
        case TimeoutError():
            return f"no answer ({answer(error) or 'timed out'}): check `url`, `timeout_s` and the network"
        case OSError():
            return f"cannot be reached ({answer(error.strerror or error)}): check `url`, and that the server runs"
    return f"does not answer as a web server does ({type(error).__name__}): check `url`"
