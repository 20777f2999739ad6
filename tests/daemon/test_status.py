"""The picture that people and programs get: plain JSON, whatever is known."""

import asyncio
import json

import numpy as np
import pytest
from control_rig import HandClock, Rig, machine, record_for, running
from memory_cnc import MemoryNc

from daemon.estimation.task import ThermalTask, thermal_snapshot
from daemon.monitor.control_socket import RequestError
from daemon.monitor.status import StatusBoard
from daemon.snapshots import HistorySnapshot
from models.quality import Quality, Reason
from models.records import TemperatureCycle, Trace


@pytest.fixture
async def board(tmp_path):
    configuration, clock = machine(tmp_path), HandClock()
    rig = Rig(configuration, MemoryNc(configuration, clock), clock, record=record_for(configuration))
    thermal = ThermalTask(configuration, clock, rig.history, rig.telemetry, None, asyncio.Queue(), rig.control.deliver)
    async with running(rig):
        board = StatusBoard(configuration, clock, rig.snapshots, rig.telemetry.picture)
        yield board, rig, thermal


def strict(picture):
    """Through JSON and back, NaN refused."""
    return json.loads(json.dumps(picture, allow_nan=False))


async def test_programs_that_read_the_status_find_every_key_that_they_found_before(board):
    picture = strict(board[0].picture())
    assert set(picture) >= {
        *(
            "machine",
            "time_utc_s",
            "clock_speed",
            "output",
            "axes",
            "reference",
            "tools_set",
            "model",
            "estimate",
            "cnc",
        ),
        *("spindle_speed", "bearing_model", "links", "temperatures", "displacements", "cycles", "estimates", "writes"),
        *("written_axes", "latency_s", "history"),
    }
    assert set(picture["output"]) == {
        *("state", "reason", "since_s", "alarm", "fault", "phase", "limits_hit", "weight", "guard_silent_s", "notices"),
        *("insecure_writes", "writable_model_directory"),
    }
    assert set(picture["axes"]["z"]) == {
        *("estimate_from", "wanted", "enabled", "thermal_error_um", "requested_um", "written_um", "applied_um"),
        *("bound_um", "baseline_um", "slew_um_per_min"),
    }


async def test_everything_at_once(board):
    board, rig, thermal = board
    await rig.active()
    await rig.follow(2.0, -3.0, 10)
    now = rig.clock.now()
    for number in (1, 2, 3):
        await thermal._take(
            TemperatureCycle(
                line="spindle",
                number=number,
                degc=np.array([20.0, np.nan, 21.0]),
                quality=np.array([Quality.GOOD, Quality.MISSING, Quality.GOOD], dtype=np.uint8),
                reason=np.array([Reason.NONE, Reason.NOT_RECEIVED, Reason.NONE], dtype=np.uint8),
                complete=False,
                trace=Trace(first_byte=now, last_byte=now),
            )
        )
    rig.snapshots.thermal = thermal_snapshot(thermal)
    rig.snapshots.links = (rig.link.health.snapshot(),)
    rig.snapshots.history = HistorySnapshot(acknowledged={"spindle": 1})
    picture = strict(board.picture())
    assert picture["output"]["state"] == "ACTIVE" and picture["output"]["insecure_writes"] is True
    z = picture["axes"]["z"]
    assert z["wanted"] and z["enabled"] and z["applied_um"] == pytest.approx(3.0, abs=0.11)
    assert picture["axes"]["x"]["thermal_error_um"] is None
    assert picture["reference"]["id"] == "r1" and picture["reference"]["age_s"] > 0
    assert picture["temperatures"]["usable"] == 2
    assert picture["temperatures"]["not_good"]["2"] == "not received"
    assert picture["cycles"] == {"received": 3, "incomplete": 3}
    assert picture["writes"]["sent"] == picture["writes"]["verified"]
    assert picture["cnc"]["identity"] == "urn:toolpoint:simulated-cnc"
    assert picture["latency_s"]["feedback"]["samples"] > 0
    (link,) = picture["links"]
    assert {key: link[key] for key in ("name", "up", "problem", "attempts", "failures", "last_problem")} == {
        **{"name": "cnc", "up": True, "problem": "", "attempts": 1, "failures": 0, "last_problem": ""}
    }
    assert picture["history"] == {"acknowledged": {"spindle": 1}, "problem": ""}
    assert picture["displacements"] is None and picture["displacement_rows"] is None


async def test_commands_are_taken_or_refused_in_words(board):
    board, rig, _ = board
    desk = rig.desk()
    await rig.turn()
    rig.set_reference()

    async def ask(request):
        """The answer comes when the control task has decided."""
        asked = asyncio.create_task(desk.handle(request, "p"))
        await asyncio.sleep(0)
        assert not asked.done()
        await rig.turn()
        return await asked

    answer = await ask({"command": "enable"})
    assert (answer["decided"], answer["state"]) == (True, "ARMED")
    assert "no estimate" in answer["reason"]
    assert rig.control.memory.wanted == (False, True, True), "every axis that has a model"
    await ask({"command": "disable", "axes": ["y"]})
    assert rig.control.memory.wanted == (False, False, True)
    assert (await ask({"command": "disable"}))["state"] == "RETREAT"
    assert not any(rig.control.memory.wanted)
    for request, words in (
        ({"command": "explode"}, "no command"),
        ({}, "no command"),
        ({"command": "enable", "axes": "z"}, "list of axis names"),
        ({"command": "enable", "axes": [1]}, "list of axis names"),
        ({"command": "enable", "axes": ["w" * 60_000]}, "list of axis names"),
        ({"command": "enable", "axes": ["w"]}, "no axis w"),
        ({"command": "enable", "axes": []}, "empty list"),
        ({"command": "enable", "zero": True}, "does not know zero; it takes axes"),
        ({"command": "reference", "axes": ["z"]}, "takes nothing else"),
        ({"command": "acknowledge", "axes": ["z"]}, "does not know axes; it takes fault"),
        ({"command": "acknowledge"}, "fault must be the number of the FAULT"),
        ({"command": "acknowledge", "fault": True}, "fault must be the number of the FAULT"),
        ({"command": "acknowledge", "fault": 1}, "there is no FAULT that is not acknowledged"),
        ({"command": "disable", "zero": "false"}, "true or false"),
        ({"command": "disable", "zero": 1}, "true or false"),
        ({"command": "disable", "zero": True, "axes": ["z"]}, "every axis"),
    ):
        with pytest.raises(RequestError, match=words):
            await desk.handle(request, "p")
    assert strict(await desk.handle({"command": "status"}, "p"))["machine"] == "rig"
