"""One temperature in a macro of its own: written when it changes, read back, in the audit; never in a fault."""

import numpy as np
import pytest
from control_rig import HandClock, Rig, machine, record_for, running
from memory_cnc import MemoryNc

from config.schema.cnc import TemperatureMacroConfig
from daemon.history.reader import HistoryReader
from models.records import MachineTemperatures, Trace, WriteOutcome

SENSOR, MACRO = 11, 549


def with_macro(tmp_path, *, cleansed=False):
    configuration = machine(tmp_path)
    shown = TemperatureMacroConfig(sensor=SENSOR, macro=MACRO, cleansed=cleansed)
    return configuration.model_copy(update={"cnc": configuration.cnc.model_copy(update={"temperature_macro": shown})})


@pytest.fixture(params=[False, True], ids=["as measured", "cleansed"])
async def rig(request, tmp_path):
    configuration, clock = with_macro(tmp_path, cleansed=request.param), HandClock()
    rig = Rig(configuration, MemoryNc(configuration, clock), clock, record=record_for(configuration))
    async with running(rig):
        await rig.turn()
        rig.cleansed = request.param
        yield rig


def temperatures(rig, degc, *, line="column"):
    """A cycle; what is not looked at is far off."""
    now = rig.clock.now()
    shown, other = np.full(5, 20.0), np.full(5, 77.0)
    shown[3] = degc
    codes = np.zeros(5, dtype=np.uint8)
    return MachineTemperatures(
        line=line,
        measured_degc=other if rig.cleansed else shown,
        degc=shown if rig.cleansed else other,
        quality=codes,
        reason=codes.copy(),
        age_s=np.zeros(5),
        trace=Trace(first_byte=now, last_byte=now, cleansed=now),
    )


async def cycle(rig, degc, **changes):
    rig.control.deliver(temperatures(rig, degc, **changes))
    await rig.serve()


def written(rig):
    return [value for number, value in rig.nc.written if number == MACRO]


async def test_a_changed_value_is_written_once_and_audited(rig):
    for degc in (21.5, 21.5, np.nan, 22.0):
        await cycle(rig, degc)
    assert written(rig) == [21.5, 22.0]
    assert rig.nc.macros.get(MACRO) == 22.0
    await rig.history.flushed()
    with HistoryReader(rig.configuration.history.path) as reader:
        audit = [record for record in reader.writes(0.0, 1e12) if record.cause == "temperature"]
    assert [record.macros for record in audit] == [((MACRO, 21.5),), ((MACRO, 22.0),)]
    assert all(record.outcome is WriteOutcome.VERIFIED and "read_back" in record.delay_s for record in audit)
    shown = rig.telemetry.registry.get_sample_value("toolpoint_temperature_macro_seconds_count")
    assert shown == 2.0


async def test_a_foreign_value_is_a_fault_and_is_not_written_over(rig):
    rig.nc.macros.set(MACRO, 5.0)
    await cycle(rig, 21.5)
    assert written(rig) == [21.5], "nobody here has written it before, so nobody knows what it held"
    rig.nc.macros.set(MACRO, 99.0)
    await cycle(rig, 22.0)
    assert written(rig) == [21.5] and rig.nc.macros.get(MACRO) == 99.0
    assert f"a write was refused: macro #{MACRO} holds 99, we wrote 21.5" in rig.control.journal.fault


async def test_what_was_lost_on_the_way_is_written_with_the_next_cycle(rig):
    rig.nc.reachable = False
    await cycle(rig, 21.5)
    assert rig.link.session is None and rig.control.journal.fault is None
    await cycle(rig, 22.0)
    rig.nc.reachable = True
    await rig.connected()
    await cycle(rig, 22.0)
    assert written(rig) == [22.0]


async def test_a_value_that_does_not_stay_is_a_fault_and_nothing_more_is_written(rig):
    rig.nc.forgets = MACRO
    await cycle(rig, 21.5)
    assert rig.control.journal.fault is not None and "read-back differs" in rig.control.journal.fault
    rig.nc.forgets = None
    await cycle(rig, 22.0)
    assert written(rig) == [21.5]
