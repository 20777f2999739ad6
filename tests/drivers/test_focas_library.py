"""FANUC's own library behind the FOCAS driver: a stand-in with its published signatures, in a process of its own."""

import shutil
import subprocess
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import pytest
import pytest_asyncio
from cnc_contract import CHECKS, IMPATIENT_S, Check, connected
from scripted_machine import cnc_config

from drivers.clock import SystemClock
from drivers.contract import Cnc, FatalDriverError, LinkError
from drivers.registry import CNC_DRIVERS
from models.records import CncMode, CncRun

COMPILER = shutil.which("cc")
SOURCE = Path(__file__).parents[1] / "support/focas_library.c"
pytestmark = [pytest.mark.wires, pytest.mark.skipif(COMPILER is None, reason="there is no C compiler (cc)")]


@pytest.fixture(scope="module")
def library(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The stand-in, built here; `behaviour` beside it says how it behaves."""
    directory = tmp_path_factory.mktemp("focas")
    built, behaviour = directory / "libfwlib32.so", directory / "behaviour"
    about = f'-DFOCAS_FILE="{behaviour}"'
    subprocess.run([str(COMPILER), "-shared", "-fPIC", "-O1", about, "-o", built, SOURCE], check=True)
    return built


class LibraryBench:
    """The driver at the stand-in, which holds macro variables as long as its process lives."""

    def __init__(self, library: Path) -> None:
        self.library = library
        self.behaviour = library.with_name("behaviour")
        self.behaviour.unlink(missing_ok=True)

    def open(self, **changes: Any) -> Cnc:
        section = {"host": "127.0.0.1", "port": 8193, "library": self.library, **changes.pop("focas", {})}
        return CNC_DRIVERS["focas"]()(cnc_config(focas=section, **changes), SystemClock())

    def tell(self, *lines: str) -> None:
        """Let the library behave so from now on."""
        waiting = self.behaviour.with_name("waiting")
        waiting.write_text("\n".join(lines) + "\n")
        waiting.replace(self.behaviour)

    async def lose(self) -> None:
        self.tell("gone 0")

    def refuse(self, number: int) -> None:
        self.tell(f"refuse {number}")


@pytest_asyncio.fixture
async def bench(library: Path) -> AsyncIterator[LibraryBench]:
    yield LibraryBench(library)


@pytest.mark.parametrize("check", CHECKS, ids=lambda check: check.__name__)
async def test_it_does_what_the_daemon_relies_on(bench: LibraryBench, check: Check) -> None:
    await check(bench)


async def test_state_and_values_are_what_the_library_says(bench: LibraryBench) -> None:
    cnc = await connected(bench)
    sample = await cnc.read([500])
    assert (sample.mode, sample.run, sample.alarm) == (CncMode.MEMORY, CncRun.START, False)
    assert (sample.program, sample.sequence_number, sample.spindle_speed_rpm) == (1000, 20, 5000.0)
    assert (sample.work_offset, sample.tool_number, sample.macros) == (54, 3, {500: None})
    assert cnc.identity == "0-TEST@127.0.0.1:8193", "as the own client calls this control: the record stays valid"
    assert "leave cnc.focas.library out" in cnc.cannot["motor_temperature"]
    values = {500: 1.999999999, 501: -0.000123456, 502: 123456.789, 503: -999_999_999.0}
    await cnc.write_macros([list(values.items())])
    for number, value in (await cnc.read_macros(list(values))).items():
        assert value == pytest.approx(values[number], rel=1e-8)
    with pytest.raises(FatalDriverError, match=r"#504.*does not take this value"):
        await cnc.write_macros([[(504, 2_000_000_000.0)]])
    await cnc.close()


@pytest.mark.parametrize("behaviour", ["crash 0", "hang 0"])
async def test_a_library_that_dies_or_hangs_is_a_lost_link_and_the_next_begins_anew(
    bench: LibraryBench, behaviour: str
) -> None:
    cnc = await connected(bench, timeout_s=5 * IMPATIENT_S)
    bench.tell(behaviour)
    with pytest.raises(LinkError, match=r"did not answer within|the bridge has ended; if it happens again"):
        await cnc.read([500])
    with pytest.raises(LinkError):
        await cnc.write_macros([[(500, 1.0)]])
    await cnc.close()
    bench.tell()
    again = await connected(bench)
    assert (await again.read([500])).program == 1000
    await again.close()


@pytest.mark.parametrize(
    ("content", "words"), [(None, "cannot be loaded"), (b"no library", "cannot be loaded"), ("libm", "is no FOCAS2")]
)
async def test_what_is_no_such_library_is_named(
    bench: LibraryBench, tmp_path: Path, content: bytes | str | None, words: str
) -> None:
    path = Path("libm.so.6") if content == "libm" else tmp_path / "lib.so"
    if isinstance(content, bytes):
        path.write_bytes(content)
    cnc = bench.open(focas={"library": path})
    with pytest.raises(FatalDriverError, match=rf"cnc\.focas\.library: .*{words}"):
        await cnc.connect()
    await cnc.close()
