"""The log: what a peer said does not act on the terminal of whoever reads it."""

import io
import logging
import sys

import pytest
import structlog

from daemon.telemetry.logs import configure_logging


@pytest.mark.parametrize("terminal", [True, False])
def test_escape_sequences_of_a_peer_do_not_reach_the_terminal(terminal: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    stream = io.StringIO()
    monkeypatch.setattr(sys, "stderr", stream)
    handlers, level = logging.getLogger().handlers[:], logging.getLogger().level
    try:
        configure_logging("info", terminal=terminal)
        structlog.get_logger().warning("link.lost", problem="server says \x1b]0;owned\x07 \ud800")
        logging.getLogger("another.logger").warning("refused by \x1b[2J")
    finally:
        logging.getLogger().handlers[:] = handlers
        logging.getLogger().setLevel(level)
        structlog.reset_defaults()
    said = stream.getvalue()
    assert "\x1b]" not in said and "\x1b[2J" not in said and "\x07" not in said and "\ud800" not in said
    assert "owned" in said and "[2J" in said
