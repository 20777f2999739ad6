"""The guard that echoes and the guard that was commissioned must be the same."""

from control_rig import record_for, running

from config.records.commissioning_file import save_commissioning
from config.signing_key import SigningKey
from models.control.state import OperatorRequest


async def test_another_guard_than_the_commissioned_one_is_not_enabled(bench):
    record = record_for(bench.configuration, guard_version=7)
    async with running(bench.rig(record=record)) as rig:
        await rig.turn()
        said = rig.control.request(OperatorRequest(enable=frozenset({"z"})), "p")
        assert "guard version 2" in said and "made with version 7" in said and "toolpoint commission" in said


async def test_a_guard_that_is_exchanged_under_way_holds_the_output(bench):
    async with running(bench.rig()) as rig:
        await rig.active()
        rig.nc.macros.set(bench.configuration.cnc.macros.echo_guard_version, 3.0)
        await rig.turn(rig.estimate(0.0, 0.0), safe=False)
        await rig.turn(rig.estimate(0.0, 0.0), safe=False)
        assert rig.state != "ACTIVE"
        assert "guard version 3" in rig.control.memory.reason, rig.control.memory


async def test_a_guard_that_makes_no_check_is_not_enabled(bench):
    record = record_for(bench.configuration, guard_version=1)
    async with running(bench.rig(record=record)) as rig:
        rig.nc.macros.set(bench.configuration.cnc.macros.echo_guard_version, 1.0)
        await rig.turn(safe=False)
        said = rig.control.request(OperatorRequest(enable=frozenset({"z"})), "p")
        assert "guard version 1, which applies a block whose check does not fit" in said
        assert bench.nc.written == []


async def test_a_record_that_cannot_be_read_is_named(bench, tmp_path):
    content = bench.configuration.model_dump()
    content["compensation"]["commissioning_file"] = tmp_path / "broken.json"
    bench.configuration = type(bench.configuration).model_validate(content)
    async with running(bench.rig(record=None)) as rig:
        await rig.turn()
        said = rig.control.request(OperatorRequest(enable=frozenset({"z"})), "p")
        assert "broken.json was refused when the daemon started" in said and "no commissioning record" in said
        assert "broken.json: cannot be read (No such file or directory)" in said


async def test_a_record_that_is_not_signed_by_a_known_key_says_so(bench, tmp_path):
    content = bench.configuration.model_dump()
    path = content["compensation"]["commissioning_file"] = tmp_path / "commissioning.json"
    content["signatures"]["public_keys"] = tmp_path / "keys"
    bench.configuration = type(bench.configuration).model_validate(content)
    save_commissioning(record_for(bench.configuration), path)
    (tmp_path / "keys").mkdir()
    (tmp_path / "keys/anna.pub").write_bytes(SigningKey.make(tmp_path / "own/key.pem").public)
    async with running(bench.rig(record=None)) as rig:
        await rig.turn()
        said = rig.control.request(OperatorRequest(enable=frozenset({"z"})), "p")
        assert "commissioning.json was refused" in said and "is not signed" in said
