"""The OPC UA library's log does not flood ours."""

import logging
from collections.abc import Iterator

import pytest

from drivers.opcua.log import RateLimitedHandler


class Recorder(logging.Handler):
    """Stands for whatever the program logs to."""

    def __init__(self) -> None:
        super().__init__()
        self.records: list[logging.LogRecord] = []

    def emit(self, record: logging.LogRecord) -> None:
        self.records.append(record)

    def texts(self) -> list[str]:
        return [record.getMessage() for record in self.records]


@pytest.fixture
def root() -> Iterator[Recorder]:
    recorder = Recorder()
    logging.getLogger().addHandler(recorder)
    yield recorder
    logging.getLogger().removeHandler(recorder)


@pytest.fixture
def limited() -> tuple[logging.Logger, list[float]]:
    time_s = [0.0]
    logger = logging.getLogger("a_library_for_this_test")
    logger.handlers[:] = [RateLimitedHandler(period_s=60.0, now=lambda: time_s[0])]
    logger.propagate = False
    return logger, time_s


def test_repeated_message_passes_once_per_period_with_the_count(
    limited: tuple[logging.Logger, list[float]], root: Recorder
) -> None:
    logger, time_s = limited
    for second in range(0, 61, 10):
        time_s[0] = float(second)
        logger.warning("lost %s", "link")
    assert root.texts() == ["lost link", "lost link [5 more of these since]"]
