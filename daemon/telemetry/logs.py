"""Logging: JSON lines for the journal, readable lines on a terminal."""

import logging
import sys
from typing import Literal

import structlog

from models.json_values import printable


def _printable(_logger: object, _method: str, entry: structlog.types.EventDict) -> structlog.types.EventDict:
    """Keep control characters in foreign texts from acting on the terminal on which the log is read."""
    return {key: printable(value, keep="\n") if isinstance(value, str) else value for key, value in entry.items()}


def configure_logging(level: Literal["debug", "info", "warning", "error"], *, terminal: bool | None = None) -> None:
    """Send structlog and the standard library's loggers to standard error, in one form."""
    human = sys.stderr.isatty() if terminal is None else terminal
    shared: list[structlog.types.Processor] = [
        structlog.contextvars.merge_contextvars,
        structlog.stdlib.add_log_level,
        structlog.processors.TimeStamper(fmt="iso", utc=True),
        structlog.processors.format_exc_info,
        _printable,
    ]
    plain = structlog.dev.plain_traceback  # others show what the variables hold, passwords too
    renderer: structlog.types.Processor = (
        structlog.dev.ConsoleRenderer(exception_formatter=plain) if human else structlog.processors.JSONRenderer()
    )
    structlog.configure(
        processors=[*shared, renderer],
        wrapper_class=structlog.make_filtering_bound_logger(getattr(logging, level.upper())),
        logger_factory=structlog.PrintLoggerFactory(file=sys.stderr),
        cache_logger_on_first_use=False,
    )
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(
        structlog.stdlib.ProcessorFormatter(
            foreign_pre_chain=shared,
            processors=[structlog.stdlib.ProcessorFormatter.remove_processors_meta, renderer],
        )
    )
    root = logging.getLogger()
    root.handlers[:] = [handler]
    root.setLevel(logging.WARNING)
