"""Keeps the OPC UA library's own log readable: a lost link would otherwise print a traceback every second."""

import copy
import logging
import time
from collections.abc import Callable

LIBRARY = "asyncua"
PERIOD_S = 60.0
"""The same message of the library is passed on at most once in this time [s]."""


class RateLimitedHandler(logging.Handler):
    """Hands a library's records on to the root logger, each message once per period and without its traceback."""

    def __init__(self, period_s: float = PERIOD_S, now: Callable[[], float] = time.monotonic) -> None:
        super().__init__()
        self._period_s = period_s
        self._now = now
        self._last_s: dict[tuple[str, str], float] = {}
        self._suppressed: dict[tuple[str, str], int] = {}

    def emit(self, record: logging.LogRecord) -> None:
        """Pass the record on, or count it as suppressed."""
        key = (record.name, str(record.msg))
        now_s = self._now()
        last_s = self._last_s.get(key)
        if last_s is not None and now_s - last_s < self._period_s:
            self._suppressed[key] = self._suppressed.get(key, 0) + 1
            return
        self._last_s[key] = now_s
        logging.getLogger().handle(self._shorten(record, self._suppressed.pop(key, 0)))

    @staticmethod
    def _shorten(record: logging.LogRecord, suppressed: int) -> logging.LogRecord:
        text = record.getMessage()
        if record.exc_info and record.exc_info[1] is not None:
            error = record.exc_info[1]
            text += f" ({type(error).__name__}: {error})"
        if suppressed:
            text += f" [{suppressed} more of these since]"
        short = copy.copy(record)
        short.msg, short.args, short.exc_info, short.exc_text, short.stack_info = text, None, None, None, None
        return short


def limit_library_log() -> None:
    """Put the rate limit on the library's logger; does nothing when it is there already."""
    logger = logging.getLogger(LIBRARY)
    if any(isinstance(handler, RateLimitedHandler) for handler in logger.handlers):
        return
    logger.addHandler(RateLimitedHandler())
    logger.propagate = False
    logger.setLevel(logging.WARNING)
