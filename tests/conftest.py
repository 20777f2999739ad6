"""What holds for every test: no deadline because the computer was slow, a log as nobody has set it; and the order."""

from collections.abc import Iterator
from typing import Any

import pytest
import structlog
from hypothesis import HealthCheck, settings

settings.register_profile("patient", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("patient")

LONGEST_FIRST = (
    "tests/system/test_hardships.py",
    "tests/literature/test_fl_thermal_families.py",
)
"""Files that take longest, in this order: whoever comes last with a long one leaves the other processors idle."""
ONE_BY_ONE = frozenset({"tests/system/test_hardships.py"})
"""Files whose tests share nothing, and are given to processes one by one."""


@pytest.fixture(autouse=True)
def log_as_it_begins() -> Iterator[None]:
    """Undo what a command that ran in this process has set the log to."""
    yield
    structlog.reset_defaults()


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Put the files that take longest first."""
    place = {file: number for number, file in enumerate(LONGEST_FIRST)}
    items.sort(key=lambda item: place.get(file_of(item.nodeid), len(place)))


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """Give whole files to processes, as `--dist loadfile` does, but in the order of collection."""
    from xdist.scheduler import LoadFileScheduling

    class InOrder(LoadFileScheduling):
        def _split_scope(self, nodeid: str) -> str:
            return nodeid if file_of(nodeid) in ONE_BY_ONE else super()._split_scope(nodeid)

    if config.getoption("dist") != "loadfile":
        return None
    config.option.loadscopereorder = False  # it puts files of few tests last, and these are the longest ones
    return InOrder(config, log)


def file_of(nodeid: str) -> str:
    return nodeid.partition("::")[0]
