"""Commissioning of the simulated machine over the real wire of every driver, and attacks on it."""

import pytest
import pytest_asyncio
from commissioning_bench import Person, serving, set_back

from config.records.commissioning import commissioning_inhibit
from config.records.commissioning_file import save_commissioning
from daemon.checkup.machine import preflight
from models.records import WriteOutcome

pytestmark = pytest.mark.asyncio(loop_scope="module")
bench = set_back


@pytest_asyncio.fixture(scope="module", loop_scope="module", params=["opcua", "focas", "haas", "sinumerik"])
async def served(tmp_path_factory, request):
    async with serving(tmp_path_factory.mktemp("commission"), request.param) as bench:
        yield bench


async def test_a_straight_machine_is_commissioned(bench):
    person = Person(bench)
    record = await bench.commission(person)
    assert record is not None
    assert {axis: (found.sign, found.scale) for axis, found in record.axes.items()} == dict.fromkeys("xyz", (1, 1.0))
    assert all(found.measured_um == pytest.approx(5.0, abs=0.06) for found in record.axes.values())
    assert record.axes["z"].others_um == pytest.approx({"x": 0.0, "y": 0.0}, abs=0.01)
    assert (record.guard_version, record.person, record.instrument) == (2, "A. Fitter", "indicator 7")
    configuration = bench.configuration()
    inhibit = commissioning_inhibit(
        record,
        cnc_identity="urn:toolpoint:simulated-cnc",
        macros=configuration.cnc.macros,
        axes=["x", "y", "z"],
        guard_version=2.0,
    )
    assert inhibit == ""
    assert bench.at_rest()
    assert all(write.outcome is WriteOutcome.VERIFIED for write in bench.writes())


async def test_check_compares_the_record_with_the_control_and_its_guard(bench):
    path = bench.directory / "record.json"

    def change(content):
        content["compensation"]["commissioning_file"] = str(path)

    record = await bench.commission(Person(bench), axes=("y", "z"))
    assert record is not None
    for version, passed, words in ((2, True, "O9100"), (9, False, "runs guard version 2")):
        save_commissioning(record.model_copy(update={"guard_version": version}), path)
        findings = [f async for f in preflight(bench.configuration(change), bench.clock, devices=True)]
        (cnc,) = (finding for finding in findings if finding.subject == "cnc")
        assert (cnc.passed, words in cnc.detail) == (passed, True), cnc
        (covered,) = (finding for finding in findings if finding.subject == "commissioning")
        assert covered.passed
