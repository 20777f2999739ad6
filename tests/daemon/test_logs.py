"""The log: what a peer said does not act on the terminal of whoever reads it."""

import io
import logging
import sys

import pytest
import structlog

from daemon.telemetry.logs import configure_logging


def connect(password: str) -> None:
    raise ConnectionError(f"server says \x1b]0;owned\x07 \ud800 to {len(password)} characters")


@pytest.mark.parametrize("terminal", [True, False])
def test_neither_escape_sequences_of_a_peer_nor_passwords_reach_the_terminal(
    terminal: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    stream, secret = io.StringIO(), "".join(reversed("7 terces"))
    monkeypatch.setattr(sys, "stderr", stream)
    handlers, level = logging.getLogger().handlers[:], logging.getLogger().level
    try:
        configure_logging("info", terminal=terminal)
        structlog.get_logger().warning("link.lost", problem="server says \x1b]0;owned\x07 \ud800")
        logging.getLogger("another.logger").warning("refused by \x1b[2J")
        try:
            connect(secret)
        except ConnectionError:
            structlog.get_logger().exception("link.defect")
            logging.getLogger("another.logger").exception("a defect too")
    finally:
        logging.getLogger().handlers[:] = handlers
        logging.getLogger().setLevel(level)
        structlog.reset_defaults()
    said = stream.getvalue()
    assert "\x1b]" not in said and "\x1b[2J" not in said and "\x07" not in said and "\ud800" not in said
    assert "owned" in said and "[2J" in said
    assert said.count("ConnectionError: server says") == 2 and said.count("in connect") == 2 and secret not in said
