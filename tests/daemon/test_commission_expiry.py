"""A commissioning whose block expires in a control that takes the offset out then."""

import asyncio

import pytest
from commissioning_bench import Person, serving

from drivers.contract import LinkError
from drivers.sim.nc.safe_point import simulated_guard


async def test_a_guard_that_zeroes_an_expired_block_is_no_stranger(tmp_path, monkeypatch):
    """The link is lost with more applied than one step; the block expires, and the guard takes it out meanwhile."""
    async with serving(tmp_path) as bench:
        monkeypatch.setattr("daemon.commissioning.movement.RECONNECTS", 1000)
        zeroing = simulated_guard(bench.configuration().compensation.axes).model_copy(update={"on_expiry": "zero"})
        bench.reset(guard=zeroing)
        person, cuts, applied = Person(bench), [], bench.machine.guard.applied_um

        def change(content):
            content["cnc"]["guard"] = content["cnc"].get("guard", {}) | {"on_expiry": "zero"}
            content["compensation"]["output"] |= {"validity_s": 20.0}

        async def cut():
            await bench.relay.stop()
            while bench.machine.guard.applied_um["y"] > 1.0:
                await bench.clock.sleep(0.4)
            applied.update(bench.machine.guard.applied_um)
            await bench.relay.start()

        def read(axis):
            if bench.machine.guard.applied_um["y"] > 11.9 and not cuts:
                cuts.append(asyncio.create_task(cut()))
            return bench.moved_um()[axis]

        async def slowly(question):
            number = await Person.number(person, question)
            if cuts:
                await asyncio.wait(cuts)
            return number

        person.eyes, person.number = read, slowly
        with pytest.raises(LinkError):
            await bench.commission(person, axes=("y",), offset_um=12.0, change=change)
        assert applied["y"] < 1.0, "the guard has taken the offset out"
        assert "Everything is back at zero" in person.text_said
        assert bench.at_rest()
