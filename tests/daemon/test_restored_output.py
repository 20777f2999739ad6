"""A daemon on a restored store moves nothing until a person has looked."""

import json
from pathlib import Path

import pytest
import yaml
from control_rig import Bench, running

from daemon.backup.making import make_backup
from daemon.backup.restoring import restore
from models.control.state import OperatorRequest


async def test_after_a_restoration_the_output_waits_for_a_person(bench: Bench, tmp_path: Path) -> None:
    config_path = tmp_path / "toolpoint.yaml"
    content = json.loads(bench.configuration.model_dump_json(exclude_defaults=True))
    config_path.write_text(yaml.safe_dump(content), encoding="utf-8")
    async with running(bench.rig()) as rig:
        await rig.active()
        await rig.follow(-4.0, -6.0)
        await rig.history.flushed()
        make_backup(bench.configuration, config_path, tmp_path / "backup.tar")
        await rig.follow(-8.0, -9.0)
        applied = dict(rig.applied)
        assert applied["z"] == pytest.approx(9.0)
    restore(tmp_path / "backup.tar", config_path, person="anna", replace=True)
    sent = len(bench.nc.written)
    async with running(bench.rig()) as rig:
        for _ in range(5):
            await rig.turn()
        assert rig.state == "FAULT"
        assert rig.control.reference is None
        assert "acknowledge" in str(rig.resume.faults)
        assert dict(rig.applied) == applied, "nothing was moved"
        assert len(bench.nc.written) == sent
        assert rig.acknowledge("anna (uid 1)") == ""
        await rig.turn()
        assert rig.state == "HOLD"
        rig.set_reference("r2")
        await rig.follow(-1.0, -1.0, 5)
        assert rig.state == "HOLD", "an acknowledgement is no order to go on"
        assert dict(rig.applied) == applied
        assert rig.control.request(OperatorRequest(enable=frozenset({"z"})), "anna (uid 1)") == ""
        await rig.follow(-1.0, -1.0, 3)
        assert rig.state == "ACTIVE"
