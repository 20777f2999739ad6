"""What holds for every test: no deadline because the computer was slow, and a log as nobody has configured it."""

from collections.abc import Iterator

import pytest
import structlog
from hypothesis import HealthCheck, settings

settings.register_profile("patient", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("patient")


@pytest.fixture(autouse=True)
def log_as_it_begins() -> Iterator[None]:
    """Undo what a command that ran in this process has set the log to."""
    yield
    structlog.reset_defaults()
