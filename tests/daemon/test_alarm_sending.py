"""Alarms over real SMTP and HTTP: what arrives, what servers that refuse or hang lead to, what nobody may inject."""

import contextlib
import json
import socket
import threading
import time
from pathlib import Path

import pytest
import yaml
from alarm_servers import mail_server, server_context, web_server
from certificates import make_certificate
from click.testing import CliRunner
from structlog.testing import capture_logs

from config.sample import sample_configuration
from config.schema.base import KeyProblems
from config.schema.sinks import MailConfig, SinkConfig, WebhookConfig
from daemon.cli import main
from daemon.sinks.alarms.ledger import Alarm, Condition, Entry, Ledger, Limits
from daemon.sinks.alarms.message import Message, UnansweredError
from daemon.sinks.contract import SinkError
from daemon.sinks.running import make_messenger

NOW_S = 1_770_000_000.0
PASSWORD = "quite secret 7"
pytestmark = pytest.mark.usefixtures("in_chicago")
FAULT = Alarm(kind="fault", subject="", text="read-back differs: #501", since_utc_s=NOW_S - 720.0)
MESSAGE = Message(machine="mill 7", time_utc_s=NOW_S, entries=(Entry(change="raised", alarm=FAULT),))


def mail_sink(port: int, **changes: object) -> SinkConfig:
    known = {
        "host": "127.0.0.1",
        "port": port,
        "encryption": "none",
        "sender": "toolpoint@plant.example",
        "recipients": ["maintenance@plant.example", "shift@plant.example"],
    }
    return SinkConfig.model_validate({"name": "people", "driver": "mail", "mail": known | changes}, strict=False)


def web_sink(url: str | None, **changes: object) -> SinkConfig:
    content = {"name": "chat", "driver": "webhook", "webhook": {"url": url} | changes}
    return SinkConfig.model_validate(content, strict=False)


def refusal(config: SinkConfig) -> str:
    with pytest.raises(SinkError) as caught:
        make_messenger(config).send(MESSAGE)
    return str(caught.value)


@pytest.fixture(scope="module")
def pki(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("pki")
    make_certificate(folder)
    (folder / "password").write_text(PASSWORD + "\n")
    (folder / "password").chmod(0o600)
    return folder


# --- mail ----------------------------------------------------------------------------------


def test_a_mail_with_umlauts_goes_in_ascii_to_any_server() -> None:
    with mail_server() as box:
        message = Message(machine="Fr\u00e4se 7", time_utc_s=NOW_S, entries=MESSAGE.entries)
        assert make_messenger(mail_sink(box.port)).send(message) == ""
        (letter,) = box.letters
    assert letter["Subject"].startswith("Fr\u00e4se 7: FAULT") and "Fr\u00e4se 7" in letter.get_content()
    assert letter.as_bytes().isascii()


@pytest.mark.filterwarnings("ignore:Requiring AUTH")
@pytest.mark.parametrize("encryption", ["starttls", "tls"])
def test_a_mail_arrives_over_tls_with_an_account(pki: Path, encryption: str) -> None:
    with mail_server(server_context(pki), starttls=encryption == "starttls", account=("tp", PASSWORD)) as box:
        secured = {"host": "localhost", "ca_certificate": pki / "monitor.crt", "encryption": encryption}
        secured |= {"user_name": "tp", "password_file": pki / "password"}
        assert make_messenger(mail_sink(box.port, **secured)).send(MESSAGE) == ""
        (letter,) = box.letters
        assert box.envelopes == [("toolpoint@plant.example", ["maintenance@plant.example", "shift@plant.example"])]
        assert letter["Subject"].strip() == "mill 7: FAULT, since 2026-02-01 20:28:00-06:00: read-back differs: #501"
        assert letter["Message-ID"] == f"<{MESSAGE.number}@plant.example>"
        assert "- FAULT, since 2026-02-01 20:28:00-06:00" in letter.get_content()
        (pki / "wrong").write_text("not this one")
        (pki / "wrong").chmod(0o600)
        said = refusal(mail_sink(box.port, **secured | {"password_file": pki / "wrong"}))
        assert "refuses the account (535" in said and "check `user_name` and `password_file`" in said
        said = refusal(mail_sink(box.port, **secured | {"ca_certificate": None}))
        assert "its certificate is none that `ca_certificate` vouches for" in said
        said = refusal(mail_sink(box.port, **secured | {"host": "127.0.0.1"}))
        assert "`host` must be a name in its certificate" in said
        other = {"starttls": "tls", "tls": "starttls"}[encryption]
        said = refusal(mail_sink(box.port, **secured | {"encryption": other, "timeout_s": 0.5}))
        assert "`encryption`" in said
        assert len(box.letters) == 1


def test_a_server_without_starttls_gets_neither_mail_nor_password(pki: Path) -> None:
    with mail_server() as box:
        secured = {"encryption": "starttls", "user_name": "tp", "password_file": pki / "password"}
        said = refusal(mail_sink(box.port, **secured))
        assert "offers no STARTTLS: check `encryption`" in said and box.letters == []


def test_who_gets_no_mail_is_named_and_the_others_get_it_once() -> None:
    with mail_server(refused=("shift@plant.example",)) as box:
        said = make_messenger(mail_sink(box.port)).send(MESSAGE)
        assert said.endswith("it refuses shift@plant.example: check `recipients`") and len(box.letters) == 1
        box.refused = ("shift@plant.example", "maintenance@plant.example")
        assert "check `recipients`" in refusal(mail_sink(box.port)) and len(box.letters) == 1
        box.refused, box.answer = (), "452 the disk is full"
        assert "it answers 452 the disk is full: look at the server" in refusal(mail_sink(box.port))


def test_a_server_that_examines_a_mail_first_may_answer_late_and_one_that_never_does_may_have_it() -> None:
    with mail_server(answer_after_s=0.5) as box:
        assert make_messenger(mail_sink(box.port, timeout_s=0.2)).send(MESSAGE) == "" and len(box.letters) == 1
        box.answer_after_s = 30.0
        with pytest.raises(UnansweredError, match="`timeout_s`"):
            make_messenger(mail_sink(box.port, timeout_s=0.1)).send(MESSAGE)
        box.answer_after_s, box.answer = 0.0, "452 the disk is full"
        with pytest.raises(SinkError) as refused:
            make_messenger(mail_sink(box.port)).send(MESSAGE)
        assert not isinstance(refused.value, UnansweredError), "it said that it does not take it"


@pytest.mark.parametrize(("begun", "kind"), [(b"", SinkError), (b"354 go on\r\n", UnansweredError)])
def test_who_hangs_up_before_he_wants_the_message_has_not_got_it(begun: bytes, kind: type[SinkError]) -> None:
    def serve(listener: socket.socket) -> None:
        peer, _ = listener.accept()
        with peer, peer.makefile("rb") as lines:
            peer.sendall(b"220 ready\r\n")
            while not (line := lines.readline()).upper().startswith(b"DATA"):
                assert line
                peer.sendall(b"250 ok\r\n")
            peer.sendall(begun)
            while begun and lines.readline() not in (b".\r\n", b""):
                pass

    with socket.create_server(("127.0.0.1", 0)) as listener:
        threading.Thread(target=serve, args=(listener,), daemon=True).start()
        with pytest.raises(SinkError) as raised:
            make_messenger(mail_sink(listener.getsockname()[1])).send(MESSAGE)
    assert type(raised.value) is kind, raised.value


@pytest.mark.parametrize("ending", ["\r\n", "\n", "\r", "\u2028", "\x0b", "\x1b[2J"])
def test_no_text_of_the_machine_becomes_a_header_or_a_line_of_its_own(ending: str) -> None:
    """Labels, links and reasons come from files and devices of others."""
    evil = f"label{ending}Bcc: all@plant.example{ending}.{ending}RCPT TO:<x@y.z>"
    ledger = Ledger().seen([Condition(kind="sensor", subject=evil, text=evil, since_utc_s=NOW_S)], (), NOW_S)
    entries = ledger.due(Limits(interval_s=1.0, remind_s=1e6), NOW_S)
    with mail_server() as box, web_server() as posts:
        message = Message(machine=f"mill{ending}To: all@plant.example", time_utc_s=NOW_S, entries=entries)
        make_messenger(mail_sink(box.port)).send(message)
        make_messenger(web_sink(posts.url)).send(message)
        (letter,), (post,) = box.letters, posts.taken
        assert set(letter.keys()) - {"X-Peer", "X-MailFrom", "X-RcptTo"} == {
            *("From", "To", "Subject", "Date", "Message-ID", "Auto-Submitted", "Content-Type"),
            *("Content-Transfer-Encoding", "MIME-Version"),
        }
        assert letter["To"] == "maintenance@plant.example, shift@plant.example"
        assert box.envelopes[0][1] == ["maintenance@plant.example", "shift@plant.example"]
        lines = letter.get_content().splitlines()
        assert len(lines) == 4 and lines[3].startswith("- sensor label") and not any(x.startswith("Bcc") for x in lines)
        assert "\x1b" not in letter.get_content()
        assert post["alarms"][0]["subject"].isprintable() and post["text"].isprintable()


# --- webhook -------------------------------------------------------------------------------


def test_a_post_arrives_over_tls_with_its_token(pki: Path) -> None:
    with web_server(server_context(pki)) as posts:
        config = web_sink(posts.url, ca_certificate=pki / "monitor.crt", token_file=pki / "password")
        assert make_messenger(config).send(MESSAGE) == ""
        (post,), (asked,) = posts.taken, posts.asked
        assert post == {
            "id": MESSAGE.number,
            "machine": "mill 7",
            "time_utc": "2026-02-02T02:40:00+00:00",
            "test": False,
            "text": "mill 7: FAULT, since 2026-02-01 20:28:00-06:00: read-back differs: #501",
            "alarms": [
                {
                    "id": post["alarms"][0]["id"],
                    "change": "raised",
                    "kind": "fault",
                    "subject": "",
                    "text": "read-back differs: #501",
                    "sentence": "FAULT, since 2026-02-01 20:28:00-06:00: read-back differs: #501",
                    "since_utc": "2026-02-02T02:28:00+00:00",
                    "ended_utc": None,
                    "duration_s": None,
                    "times": 1,
                }
            ],
        }
        assert asked["authorization"] == f"Bearer {PASSWORD}" and asked["path"] == "/hooks/42"
        assert asked["host"].startswith("localhost:") and asked["content-type"] == "application/json"
        said = refusal(web_sink(posts.url))
        assert "its certificate is none that `ca_certificate` vouches for" in said


@pytest.mark.parametrize(
    ("status", "word"),
    [(302, "`url`"), (401, "`token_file`"), (404, "`url`"), (429, "interval_s"), (500, "tried again")],
)
def test_an_answer_that_refuses_names_what_to_look_at_and_hides_what_is_secret(
    pki: Path, status: int, word: str
) -> None:
    with web_server(status=status, headers={"Location": "http://127.0.0.1:1/"}) as posts:
        hook = posts.url.replace("/hooks/42", "/hooks/T0Qx7%20Zk?key=s3cr3tKey")
        parts = "Cannot POST /hooks/T0Qx7%20Zk: T0Qx7 Zk, s3cr3tKey"
        posts.body = f"no: Bearer {PASSWORD} at {hook}, {parts}\x1b[2J".encode()
        address = pki / f"address{status}"
        address.write_text(hook)
        address.chmod(0o600)
        said = refusal(web_sink(None, url_file=address))
        assert f"it answers {status} no: Bearer" in said and word in said
        assert "T0Qx7" not in said and "s3cr3tKey" not in said, "servers repeat parts of the address, too"
        assert "\x1b" not in said and len(posts.asked) == 1


# --- servers that do not answer as they should ----------------------------------------------


class Peer:
    """A server that speaks its own way to every connection."""

    def __init__(self, say) -> None:
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port = self._listener.getsockname()[1]
        self._say = say
        self._open: list[socket.socket] = []
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    def _serve(self) -> None:
        while True:
            try:
                connection, _ = self._listener.accept()
            except OSError:
                return
            self._open.append(connection)
            threading.Thread(target=self._one, args=(connection,), daemon=True).start()

    def _one(self, connection: socket.socket) -> None:
        with contextlib.suppress(OSError):
            self._say(connection)

    def close(self) -> None:
        self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()
        for connection in self._open:
            connection.close()


def hangs(connection: socket.socket) -> None:
    connection.recv(1_000_000)


def drips(connection: socket.socket) -> None:
    while True:
        connection.sendall(b"2")
        time.sleep(0.02)


def drips_lines(connection: socket.socket) -> None:
    while True:
        connection.sendall(b"220-")
        time.sleep(0.02)
        connection.sendall(b"x\r\n")


def babbles(connection: socket.socket) -> None:
    connection.sendall(b"\xff\xfe\x00 what\r\n" * 10)
    connection.close()


def hangs_up(connection: socket.socket) -> None:
    connection.close()


@pytest.mark.parametrize("say", [hangs, drips, drips_lines, babbles, hangs_up])
@pytest.mark.parametrize("driver", ["mail", "webhook", "https", "tls"])
def test_a_server_that_does_not_answer_is_given_up_and_named(say, driver: str) -> None:
    peer = Peer(say)
    try:
        config = {
            "mail": mail_sink(peer.port, timeout_s=0.1),
            "tls": mail_sink(peer.port, timeout_s=0.1, encryption="tls"),
            "webhook": web_sink(f"http://127.0.0.1:{peer.port}/x", timeout_s=0.3),
            "https": web_sink(f"https://127.0.0.1:{peer.port}/x", timeout_s=0.3),
        }[driver]
        said = refusal(config)
        assert said.startswith(f"sink {config.name}: ") and "check `" in said, said
    finally:
        peer.close()


def test_nobody_there_and_no_such_name() -> None:
    with socket.create_server(("127.0.0.1", 0)) as nobody:
        port = nobody.getsockname()[1]
    assert "Connection refused): check `host`, `port`" in refusal(mail_sink(port))
    assert "check `url`" in refusal(web_sink(f"http://127.0.0.1:{port}/"))
    assert "check `host`" in refusal(mail_sink(port, host="no-such-host.invalid"))


# --- configuration and secrets --------------------------------------------------------------


@pytest.mark.parametrize(
    ("section", "content", "sentence"),
    [
        (WebhookConfig, {}, "give either url or url_file"),
        (WebhookConfig, {"url": "https://a/b", "url_file": "/x"}, "give either url or url_file"),
        (WebhookConfig, {"url": "http://a/b", "token_file": "/x"}, "in the clear"),
        (MailConfig, {"user_name": "tp"}, "user_name and password_file together"),
        (MailConfig, {"user_name": "tp", "password_file": "/x", "encryption": "none"}, "starttls or tls"),
    ],
)
def test_sections_that_would_send_a_secret_in_the_clear_or_say_two_things_are_refused(
    section: type, content: dict[str, object], sentence: str
) -> None:
    known = {"host": "m", "sender": "a@b", "recipients": ["c@d"]} if section is MailConfig else {}
    with pytest.raises((KeyProblems, ValueError), match=sentence):
        section.model_validate(known | content, strict=False)


@pytest.mark.parametrize("content", [None, b"", b"\xff\xfe", b"two\nlines", b"x" * 9000])
def test_a_secret_that_cannot_be_read_is_named_and_never_shown(tmp_path: Path, content: bytes | None) -> None:
    path = tmp_path / "secret"
    if content is not None:
        path.write_bytes(content)
        path.chmod(0o600)
    account = {"user_name": "tp", "password_file": path, "encryption": "starttls"}
    with mail_server() as box, web_server() as posts:
        for config, key in (
            (mail_sink(box.port, **account), "password_file"),
            (web_sink(None, url_file=path), "url_file"),
            (web_sink(posts.url.replace("http:", "https:"), token_file=path), "token_file"),
        ):
            said = refusal(config)
            assert f"`{key}` {path}" in said and "lines" not in said and "xxx" not in said
        assert box.letters == [] and posts.asked == []


# --- the command ----------------------------------------------------------------------------


def test_the_command_sends_a_test_message(tmp_path: Path, pki: Path) -> None:
    content = yaml.safe_load(sample_configuration())
    with mail_server() as box, web_server(status=404) as posts:
        content["sinks"] = [
            {"name": "plant", "driver": "postgresql", "postgresql": {"host": "db"}},
            json.loads(mail_sink(box.port).model_dump_json(exclude_none=True)),
            {"name": "chat", "driver": "webhook", "webhook": {"url": posts.url}},
        ]
        path = tmp_path / "t.yaml"
        path.write_text(yaml.safe_dump(content))
        with capture_logs() as logs:
            done = CliRunner().invoke(main, ["alarm", "test", "--config", str(path), "--json", "-"])
            assert done.exit_code == 1, done.output
            mail, chat = json.loads(done.stdout)["alarms"]
            assert mail["taken"] and mail["name"] == "people" and "`url`" in chat["problem"]
            posts.status = 200
            done = CliRunner().invoke(main, ["alarm", "test", "--config", str(path), "--sink", "chat"])
        assert done.exit_code == 0 and "chat (webhook, http://localhost:" in done.output and "taken" in done.output
        assert "hooks" not in done.output + str(logs)
        assert len(box.letters) == 1 and posts.taken[0]["test"] is True
        assert "Nothing is wrong" in box.letters[0].get_content()
        done = CliRunner().invoke(main, ["alarm", "test", "--config", str(path), "--sink", "plant"])
        assert done.exit_code == 2 and "there are people, chat" in done.output
