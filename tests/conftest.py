"""What holds for every test: no deadline because the computer was slow, a log as nobody has set it, order, folders."""

import gc
import importlib.util
import multiprocessing
import os
import shutil
import sys
import tempfile
import time
from collections.abc import Generator, Iterator
from pathlib import Path
from typing import Any

import pytest
import structlog
from _pytest.assertion import rewrite
from hypothesis import HealthCheck, settings

settings.register_profile("patient", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("patient")
sys.modules["rfc3987_syntax"] = None  # type: ignore[assignment]  # grammars of URIs, 1.7 s of jsonschema's import
os.environ["TOOLPOINT_SIGNING_KEY"] = "/no/key/of/whoever/runs/the/tests"

HARDSHIPS = "tests/system/test_hardships.py::test_nothing_acknowledged_is_lost_and_what_must_hold_holds"
LONGEST_FIRST = (
    f"{HARDSHIPS}[process]",
    "tests/daemon/test_truth_of_combined_faults.py",
    "tests/literature/test_fl_thermal_families.py",
    f"{HARDSHIPS}[store]",
    "tests/system/test_on_wires.py",
    "tests/system/test_faults.py",
    "tests/daemon/test_truth_after_bad_input.py",
    f"{HARDSHIPS}[calendar]",
    "tests/drivers/test_cnc_contract.py",
    "tests/daemon/test_replay_follows.py",
    "tests/daemon/test_lags_on_line.py",
    "tests/system/test_warm_up.py",
    "tests/system/test_pages.py",
    "tests/zoo/test_zoo.py",
    "tests/system/test_own_machine.py",
    "tests/system/test_stability_referee.py",
    "tests/models/test_chatter.py",
    "tests/daemon/test_cli_thermal_evaluate.py",
    "tests/system/test_warm_up_spindle.py",
    "tests/models/test_semi_discretisation.py",
    "tests/system/test_fault_campaign.py",
    "tests/daemon/test_monitor_contract.py",
    "tests/system/test_spindle_speed_wires.py",
    "tests/daemon/test_planner_process.py",
    "tests/system",
)
"""What takes longest, each that waits beside one that computes: whoever comes last leaves the other processors idle,
and so do those that wait beside each other."""
ONE_BY_ONE = (
    "tests/system/test_hardships.py",
    "tests/daemon/test_replay_follows.py",
    "tests/literature/test_fl_thermal_families.py::test_split_c",
    "tests/system/test_fault_campaign.py::test_a_part",
    "tests/system/test_own_machine.py",
)
"""Tests that share nothing with their files and take long, and are given to processes one by one."""
IN_MEMORY = Path("/dev/shm")
"""Where files never wait for a disk. No test takes away what was not synced by taking away a disk's power."""
ENOUGH_BYTES = 4 << 30
OF_SOURCES = (
    "tests/system/test_layout.py",
    "tests/system/test_layers.py",
    "tests/system/test_architecture_page.py",
    "tests/system/test_words.py",
)
"""Files that ask the same trees of the sources, and share them in one process."""
SOME_OBJECTS = 50_000
"""After so many new objects garbage is looked for among them, which saves a twentieth of the processor time."""
_folder = pytest.StashKey[str]()


def plain_log() -> None:
    """Let the log be as nobody has configured it, but for the values of all variables, megabytes with a traceback."""
    structlog.reset_defaults()
    plain = structlog.dev.ConsoleRenderer(exception_formatter=structlog.dev.plain_traceback)
    structlog.configure(processors=[*structlog.get_config()["processors"][:-1], plain])


plain_log()


def pytest_addoption(parser: pytest.Parser) -> None:
    """Let random histories be played that CI has no time for: `make histories`."""
    parser.addoption("--histories", type=int, default=1, help="play so many times as many random histories as CI does")


@pytest.fixture(scope="session")
def times_as_many(pytestconfig: pytest.Config) -> int:
    """Return how many times as many random histories as in CI are played."""
    return int(pytestconfig.getoption("--histories"))


@pytest.fixture(autouse=True)
def log_as_it_begins(request: pytest.FixtureRequest) -> Iterator[None]:
    """Undo what a command that ran in this process has set the log to."""
    if request.node.get_closest_marker("quiet"):
        structlog.configure(wrapper_class=structlog.make_filtering_bound_logger(50))
    yield
    plain_log()


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport() -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """Write half characters as escapes, which a peer's bytes may bring into a log and no process can pass on."""
    report = yield
    report.sections = [(name, text.encode(errors="backslashreplace").decode()) for name, text in report.sections]
    return report


@pytest.hookimpl(tryfirst=True)
def pytest_configure(config: pytest.Config) -> None:
    """Keep the tests' folders in memory, where the computer has enough of it, unless `--basetemp` names another."""
    gc.disable()  # until all tests are there: nothing that is loaded now goes away
    if getattr(config.option, "numprocesses", None) and not sys.dont_write_bytecode:
        with multiprocessing.get_context("fork").Pool() as pool:
            pool.map(rewrite_assertions, Path(__file__).parent.glob("*/test_*.py"), chunksize=8)
    if hasattr(config, "workerinput") or config.option.basetemp is not None or not fit(IN_MEMORY):
        return
    config.stash[_folder] = tempfile.tempdir = os.environ["TMPDIR"] = tempfile.mkdtemp(prefix="tests-", dir=IN_MEMORY)
    Path(tempfile.tempdir).chmod(0o755)  # a test reads the store as another user
    config.option.basetemp = f"{tempfile.tempdir}/t"


def pytest_unconfigure(config: pytest.Config) -> None:
    """Give the memory back."""
    if _folder in config.stash:
        shutil.rmtree(config.stash[_folder], ignore_errors=True)


def rewrite_assertions(path: Path) -> None:
    """Leave the file of a test with pytest's assertions for the processes, each of which would rewrite them all."""
    hook = next(finder for finder in sys.meta_path if isinstance(finder, rewrite.AssertionRewritingHook))
    spec = importlib.util.spec_from_file_location(path.stem, path, loader=hook)
    rewrite.exec = lambda *_: None  # type: ignore[attr-defined]  # what is rewritten is not run here
    hook.exec_module(importlib.util.module_from_spec(spec))  # type: ignore[arg-type]


def fit(folder: Path) -> bool:
    """Return whether a folder is there in which programs may be started, with room for all that tests write."""
    if not os.access(folder, os.W_OK):
        return False
    system = os.statvfs(folder)
    return not system.f_flag & os.ST_NOEXEC and system.f_bavail * system.f_frsize >= ENOUGH_BYTES


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Put the tests that take longest first."""

    def place(item: pytest.Item) -> int:
        return next((i for i, begin in enumerate(LONGEST_FIRST) if item.nodeid.startswith(begin)), len(LONGEST_FIRST))

    items.sort(key=place)


def pytest_collection_finish() -> None:
    """Load the standard nodes of OPC UA once, where a test serves some; look for garbage in what comes now alone."""
    if "asyncua.server.internal_server" in sys.modules:
        from standard_nodes import loaded_once

        loaded_once()
    gc.freeze()
    gc.set_threshold(SOME_OBJECTS, 20, 100)
    gc.enable()


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """Give whole files to processes, as `--dist loadfile` does, but in the order of collection."""
    from xdist.scheduler import LoadFileScheduling

    class InOrder(LoadFileScheduling):
        def _split_scope(self, nodeid: str) -> str:
            if nodeid.startswith(OF_SOURCES):
                return OF_SOURCES[0]
            return nodeid if nodeid.startswith(ONE_BY_ONE) else super()._split_scope(nodeid)

    if config.getoption("dist") != "loadfile":
        return None
    config.option.loadscopereorder = False  # it puts files of few tests last, and these are the longest ones
    return InOrder(config, log)


@pytest.fixture
def in_chicago(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Let the computer stand where the clocks are not those of UTC."""
    with monkeypatch.context() as place:
        place.setenv("TZ", "America/Chicago")
        time.tzset()
        yield
    time.tzset()
