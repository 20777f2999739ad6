"""Commissioning of the simulated machine over real OPC UA, and attacks on it."""

import sys
from pathlib import Path

import pytest
import pytest_asyncio

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "support"))

from commissioning_bench import Bench, Person, serving

from config.commissioning import commissioning_obstacle
from models.records import WriteOutcome

pytestmark = pytest.mark.asyncio(loop_scope="module")


@pytest_asyncio.fixture(scope="module", loop_scope="module")
async def served(tmp_path_factory):
    async with serving(tmp_path_factory.mktemp("commission")) as bench:
        yield bench


@pytest.fixture
def bench(served) -> Bench:
    served.reset()
    return served


async def test_a_straight_machine_is_commissioned(bench):
    person = Person(bench)
    record = await bench.commission(person)
    assert record is not None
    assert {axis: (found.sign, found.scale) for axis, found in record.axes.items()} == dict.fromkeys("xyz", (1, 1.0))
    assert all(found.measured_um == pytest.approx(5.0, abs=0.06) for found in record.axes.values())
    assert record.axes["z"].others_um == pytest.approx({"x": 0.0, "y": 0.0}, abs=0.01)
    assert (record.guard_version, record.person, record.instrument) == (1, "A. Fitter", "indicator 7")
    configuration = bench.configuration()
    obstacle = commissioning_obstacle(
        record,
        cnc_identity="urn:toolpoint:simulated-cnc",
        macros=configuration.cnc.macros,
        axes=["x", "y", "z"],
        guard_version=1.0,
    )
    assert obstacle == ""
    assert bench.at_rest()
    assert all(write.outcome is WriteOutcome.VERIFIED for write in bench.writes())
