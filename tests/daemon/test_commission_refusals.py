"""What is refused before a commissioning touches the machine, and what it initialises: over real OPC UA."""

import asyncio

import pytest
from commissioning_bench import Person, refused, served_by_opcua, set_back

from daemon.monitor.control_socket import ControlSocket
from models.records import WriteOutcome

pytestmark = pytest.mark.asyncio(loop_scope="module")
served, bench = served_by_opcua, set_back


async def test_vacant_variables_are_initialised_and_audited(bench):
    macros = bench.machine.nc.macros
    for number in (500, 501, 502, 503, 504, 505, 524):
        macros.set(number, None)
    assert await bench.commission(Person(bench), initialise_only=True) is None
    assert {bench.macro(number) for number in (500, 501, 502, 503, 504, 505, 524)} == {0.0}
    assert bench.macro(120) is None, "valid_until stays vacant"
    (write,) = bench.writes()
    assert (write.cause, write.person, write.outcome) == ("commission", "A. Fitter", WriteOutcome.VERIFIED)
    assert write.macros[0] == (500, 0.0) and write.macros[-1] == (505, 0.0)


async def test_foreign_values_are_shown_and_left_alone_unless_a_person_says_so(bench):
    bench.machine.nc.macros.set(502, 123.4)
    person = Person(bench)
    person.denies = "Overwrite"
    said = await refused(bench, person)
    assert "#502 = 123.4" in said and bench.macro(502) == 123.4 and bench.writes() == []
    person.denies = None
    assert await bench.commission(person, axes=("z",)) is not None
    assert bench.at_rest()


async def test_a_running_daemon_is_left_alone(bench):
    async def handle(request, peer):
        return {}

    serving_socket = asyncio.create_task(ControlSocket(bench.directory / "control.sock", None, handle).run())
    while not (bench.directory / "control.sock").exists():
        await bench.clock.sleep(1.0)
    try:
        assert "the daemon is running" in await refused(bench)
    finally:
        serving_socket.cancel()
        await asyncio.gather(serving_socket, return_exceptions=True)


@pytest.mark.parametrize(
    ("state", "words"),
    [
        ({"alarm": 1}, "alarm is active"),
        ({"mode": 3}, "mode edit"),
        ({"spindle_speed_rpm": 500.0}, "spindle turns"),
        ({"sequence_number": 210}, "not at a configured safe point"),
    ],
)
async def test_a_machine_that_is_not_at_rest_is_refused(bench, state, words):
    bench.frozen = True
    for name, value in state.items():
        setattr(bench.machine.nc, name, value)
    assert words in await refused(bench)
    assert bench.writes() == []


async def test_an_insecure_connection_and_a_wrong_offset_are_refused(bench):
    def insecure(content):
        content["cnc"]["allow_insecure_writes"] = False

    assert "allow_insecure_writes" in await refused(bench, change=insecure)
    assert "too small" in await refused(bench, offset_um=1.0)
    assert "no whole number" in await refused(bench, offset_um=4.55)
    assert "outside its absolute bound" in await refused(bench, offset_um=31.0)
