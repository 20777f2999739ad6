"""One connected CNC: what is accepted as ours, and what the audit says of a write."""

import asyncio
import contextlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from control_rig import ENABLE, SEQUENCE_A, SEQUENCE_B, HandClock, Z, machine
from memory_cnc import MemoryNc
from scripted_machine import GROUPS, ScriptedMacros, ScriptedNc, cnc_config

from daemon.cnc.audited_write import AuditedWriter, ForeignValueError, MacroWrite
from daemon.cnc.limits import output_limits
from daemon.cnc.macro_block import LAST_SEQUENCE, MacroBlock
from daemon.cnc.session import CncSession
from daemon.cnc.write_ahead import WriteAheadRecord
from daemon.history.layout import MachineLayout
from daemon.history.reader import HistoryReader
from daemon.history.writer import HistoryWriter
from daemon.telemetry.metrics import Telemetry
from drivers.clock import SystemClock
from drivers.contract import FatalDriverError, LinkError
from drivers.opcua.cnc import OpcUaCnc
from drivers.sim.wires.opcua_server import SimulatedCncServer
from models.records import CompensationCommand, OutputState, Trace, WriteOutcome

AXES = ("x", "y", "z")


class Desk:
    """A control, a store, and sessions on it."""

    def __init__(self, directory: Path) -> None:
        self.configuration = machine(directory)
        self.clock = HandClock()
        self.nc = MemoryNc(self.configuration, self.clock)
        self.history = HistoryWriter(
            self.configuration.history.path,
            clock=self.clock,
            machine=MachineLayout.from_configuration(self.configuration),
        )
        self.last_block = WriteAheadRecord(directory / "last-block")
        self.block = MacroBlock(self.configuration.cnc.macros, AXES, {})

    def session(self, known=None) -> CncSession:
        writer = AuditedWriter(self.nc.open(), self.block, self.clock, self.history, Telemetry())
        return CncSession(writer, output_limits(self.configuration), known, self.last_block)

    async def write(self, session, z_um=3.0, enable=(False, False, True)):
        now = self.clock.now()
        command = CompensationCommand(
            axes=AXES,
            requested_um=np.array([0.0, 0.0, z_um]),
            compensation_um=np.array([0.0, 0.0, z_um]),
            enable=enable,
            state=OutputState.ACTIVE,
            reason="",
            write=True,
        )
        trace = Trace(first_byte=now, last_byte=now)
        return await session.write(command, validity_s=30.0, trace=trace, cause="tick")

    def audit(self):
        self.history.close()
        with HistoryReader(self.configuration.history.path) as reader:
            return reader.writes(0.0, 1e11), reader.unsettled_writes()


@pytest.fixture
def desk(tmp_path):
    desk = Desk(tmp_path)
    desk.history.start()
    yield desk
    desk.history.close()


async def test_a_commissioned_block_that_is_off_is_taken_over(desk):
    session = desk.session()
    assert await session.poll() == []
    assert session.known[Z] == (0.0,)
    assert not session.enabled


@pytest.mark.parametrize("number", [SEQUENCE_A, Z, ENABLE, SEQUENCE_B])
async def test_a_vacant_macro_is_named_until_it_is_filled(desk, number):
    desk.nc.macros.set(number, None)
    session = desk.session()
    for _ in range(2):
        assert any(f"#{number} is vacant" in problem for problem in await session.poll())
    assert any(f"#{number} is vacant" in problem for problem in session.acknowledge())
    desk.nc.macros.set(number, 0.0)
    assert any(f"#{number} holds 0, we wrote nothing" in problem for problem in await session.poll())
    assert session.acknowledge() == []
    assert await session.poll() == []


async def test_a_write_is_read_back_and_audited(desk):
    session = desk.session()
    await session.poll()
    receipt = await desk.write(session)
    assert receipt.outcome is WriteOutcome.VERIFIED and receipt.detail == ""
    assert dict(receipt.macros)[Z] == pytest.approx(0.003)
    assert receipt.read_back == tuple(value for _, value in receipt.macros)
    assert receipt.trace.written is not None and receipt.trace.read_back is not None
    assert session.enabled
    assert await session.poll() == []
    records, unsettled = desk.audit()
    assert [record.outcome for record in records] == [WriteOutcome.VERIFIED] and unsettled == []


async def test_the_sequence_goes_on_from_the_controls_and_starts_again_at_the_end(desk):
    for number in (SEQUENCE_A, SEQUENCE_B):
        desk.nc.macros.set(number, float(LAST_SEQUENCE - 1))
    session = desk.session()
    await session.poll()
    assert [(await desk.write(session)).sequence for _ in range(3)] == [LAST_SEQUENCE, 1, 2]


@pytest.mark.parametrize(
    ("error", "outcome"),
    [
        (LinkError("lost"), WriteOutcome.FAILED),
        (FatalDriverError("refused"), WriteOutcome.REFUSED),
        (ZeroDivisionError("nobody expected"), WriteOutcome.FAILED),
    ],
)
async def test_a_write_that_ends_in_an_error_is_settled_in_the_audit(desk, error, outcome):
    session = desk.session()
    await session.poll()
    desk.nc.breaks = error
    with pytest.raises(type(error)):
        await desk.write(session)
    records, unsettled = desk.audit()
    assert [record.outcome for record in records] == [outcome] and unsettled == []
    assert str(error) in records[0].detail


@pytest.mark.parametrize("groups", [0, 1, 2])
async def test_after_a_lost_write_the_next_session_accepts_old_or_new_and_nothing_else(desk, groups):
    first = desk.session()
    await first.poll()
    await desk.write(first, 1.0)
    desk.nc.groups_until_lost = groups
    with pytest.raises(LinkError):
        await desk.write(first, 2.0)
    second = desk.session(first.known)
    assert await second.poll() == []
    assert len(second.known[Z]) == 1, "what was found is now known"
    desk.nc.macros.set(Z, 0.0015)
    assert any(f"#{Z} holds 0.0015" in problem for problem in await second.poll())


@pytest.mark.parametrize("groups", [0, 1, 2, None])
async def test_a_daemon_killed_before_its_audit_was_committed_knows_its_block(desk, groups):
    first = desk.session()
    await first.poll()
    await desk.write(first, 1.0)
    desk.nc.groups_until_lost = groups
    with contextlib.suppress(LinkError):
        await desk.write(first, 2.0)
    second = desk.session(desk.last_block.load())  # and no audit at all
    assert await second.poll() == []
    desk.nc.macros.set(Z, 0.0015)
    assert any(f"#{Z} holds 0.0015" in problem for problem in await second.poll())


async def test_a_value_that_is_not_kept_is_seen_in_the_read_back(desk):
    session = desk.session()
    await session.poll()
    desk.nc.forgets = Z
    receipt = await desk.write(session, 4.0)
    assert receipt.outcome is WriteOutcome.DIFFERS and f"#{Z} holds 0" in receipt.detail
    assert session.acknowledge() == []
    assert await session.poll() == [], "acknowledged: what the control holds is known now"


async def test_a_value_that_is_not_kept_is_looked_for_as_long_however_slow_the_control_is(desk, monkeypatch):
    session = desk.session()
    await session.poll()
    desk.nc.forgets = Z
    read, looks = session.cnc.read_macros, []

    async def slowly(numbers):
        looks.append(numbers)
        await asyncio.sleep(0.4)
        return await read(numbers)

    monkeypatch.setattr(session.cnc, "read_macros", slowly)
    receipt = await desk.write(session, 4.0)
    assert receipt.outcome is WriteOutcome.DIFFERS and len(looks) <= 5, "nothing else is done meanwhile"


class LateMacros(ScriptedMacros):
    """What is written stands there a while later, as behind a gateway that answers from its memory."""

    def set(self, number: int, value: float | None) -> None:
        asyncio.get_running_loop().call_later(0.2, super().set, number, value)


@pytest.mark.wires
async def test_a_value_that_a_gateway_acknowledges_and_shows_a_moment_later_is_no_other_value(desk):
    nc = ScriptedNc()
    nc.macros = LateMacros()
    server = SimulatedCncServer(nc, cnc_config(), port=0)
    await server.start()
    cnc = OpcUaCnc(cnc_config(server.endpoint), SystemClock())
    await cnc.connect()
    block = MacroBlock(macros := cnc_config().macros, tuple(macros.values), {})
    writer = AuditedWriter(cnc, block, SystemClock(), desk.history, Telemetry())
    expected = {number: (None,) for group in GROUPS for number, _ in group}
    now = SystemClock().now()
    write = MacroWrite(groups=GROUPS, expected=expected, cause="tick", trace=Trace(first_byte=now, last_byte=now))
    receipt = await writer.write(write)
    assert (receipt.outcome, receipt.detail) == (WriteOutcome.VERIFIED, "")
    unseen = replace(write, groups=tuple(tuple((n, v + 1.0) for n, v in group) for group in GROUPS), expected={})
    assert (await writer.write(unseen)).outcome is WriteOutcome.VERIFIED, "as the first temperature after a start"
    nc.macros.values[503] = 0.5
    with pytest.raises(ForeignValueError, match=r"#503 holds 0\.5"):
        await writer.write(replace(write, expected=expected | {503: (0.0105,)}))
    await cnc.close()
    await server.stop()
