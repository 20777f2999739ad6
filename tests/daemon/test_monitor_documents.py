"""The documents of the API on a machine at work: state, series, audit, downloads, and what is refused."""

import csv
import io
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from control_rig import EPOCH_S
from monitor_bench import monitor

from daemon.estimation.task import ThermalTask, thermal_snapshot
from daemon.monitor.web.estimate import estimate_document
from daemon.snapshots import Contributions, LinkSnapshot
from models.quality import Quality, Reason
from models.records import OutputState, TemperatureCycle, Trace


@pytest.fixture
async def bench(tmp_path):
    """A monitor of a machine that follows an estimate, with some cycles of temperatures."""
    async with monitor(tmp_path) as bench:
        rig = bench.rig
        await rig.active()
        await rig.follow(2.0, -3.0, 10)
        thermal = ThermalTask(rig.configuration, rig.clock, rig.history, rig.telemetry, None, None, rig.control.deliver)
        for number in range(1, 6):
            rig.clock.monotonic_s += 10.0
            now = rig.clock.now()
            await thermal._take(
                TemperatureCycle(
                    line="spindle",
                    number=number,
                    degc=np.array([20.0 + number, np.nan, 21.0]),
                    quality=np.array([Quality.GOOD, Quality.MISSING, Quality.GOOD], dtype=np.uint8),
                    reason=np.array([Reason.NONE, Reason.NOT_RECEIVED, Reason.NONE], dtype=np.uint8),
                    complete=False,
                    trace=Trace(first_byte=now, last_byte=now),
                )
            )
        rig.snapshots.thermal = thermal_snapshot(thermal)
        await rig.history.flushed()
        yield bench


async def test_the_status_says_what_is_estimated_asked_written_and_applied(bench):
    status = (await bench.browser().get("/api/v1/status")).json
    assert status["state"] == "ACTIVE" and status["reason"] == "following the estimate"
    z = status["axes"]["z"]
    assert z["estimated_um"] == pytest.approx(-3.0) and z["applied_um"] == pytest.approx(3.0, abs=0.11)
    assert z["remaining_um"] == pytest.approx(0.0, abs=0.11) and z["bound_um"] == 30.0 and z["band_um"] is None
    assert status["reference"]["source"] == "O1000 N100" and status["age_s"] == pytest.approx(0.0)
    assert status["latency"]["feedback"]["samples"] > 0


REFUSED = [
    ("series", 422, "query parameter name"),
    ("series?name=x", 404, "there is no series 'x'"),
    ("series?name=temperature.1&points=1", 422, "query parameter points"),
    ("series?name=temperature.1&points=99999", 422, "query parameter points"),
    ("series?name=temperature.1&from=nan", 422, "query parameter from"),
    ("series?name=temperature.1&from=-1", 422, "query parameter from"),
    ("series?name=temperature.1&to=1e300", 422, "query parameter to"),
    ("series?name=temperature.1&from=20&to=10", 422, "must be before to"),
    ("series?" + "&".join(f"name=temperature.{i}" for i in range(33)), 422, "query parameter name"),
    ("writes?limit=0", 422, "query parameter limit"),
    ("writes?limit=99999", 422, "query parameter limit"),
    ("past-events?limit=99999", 422, "query parameter limit"),
    ("past-events?kinds=fault", 422, "it takes from, kind, limit, text, to"),
    ("export?what=secrets", 422, "query parameter what"),
    ("export?what=recording", 404, "no axis of this machine follows a channel that is measured"),
    ("export?what=temperatures&from=10&to=20", 404, "no temperatures were recorded in that time"),
    (
        "series?name=temperature.1&form=10",
        422,
        "'form' is not known to /api/v1/series; it takes from, name, points, to",
    ),
    ("status?verbose=1", 422, "it takes none"),
    ("nothing", 404, "there is nothing at"),
]


async def test_what_cannot_be_answered_is_refused_with_a_sentence(tmp_path):
    async with monitor(tmp_path) as bench:
        for query, status, sentence in REFUSED:
            answer = await bench.browser().get(f"/api/v1/{query}")
            assert (answer.status, sentence in answer.detail) == (status, True), (query, answer.body)


async def test_the_audit_is_listed_newest_first_with_what_stood_there_before(bench):
    browser = bench.browser()
    found = (await browser.get(f"/api/v1/writes?from={EPOCH_S}&to={EPOCH_S + 5000}&limit=3")).json
    assert found["more"] is True and len(found["writes"]) == 3
    times = [each["time"] for each in found["writes"]]
    assert times == sorted(times, reverse=True)
    asked = f"/api/v1/writes?from={EPOCH_S}&to={EPOCH_S + 5000}"
    whole = (await browser.get(f"{asked}&limit=1000")).json["writes"]
    for newer, older in pairwise(whole):
        held = dict(older["macros"])
        for (number, _), before in zip(newer["macros"], newer["old"], strict=True):
            assert number not in held or before == held[number]
    by_reason = (await browser.get(f"{asked}&reason=FOLLOWING")).json["writes"]
    assert by_reason and all("following" in each["reason"] for each in by_reason)
    assert not (await browser.get(f"{asked}&reason=zzz")).json["writes"]
    assert {each["outcome"] for each in whole} == {"verified"}
    assert (await browser.get(f"{asked}&limit=1000&outcome=verified")).json["writes"] == whole
    none = (await browser.get(f"{asked}&limit=1&outcome=refused")).json
    assert none == {"writes": [], "more": False}, "looked for in all of the time, not among the newest"
    answer = await browser.get(f"{asked}&outcome=lost")
    assert answer.status == 422 and "outcome" in answer.detail


async def test_what_happened_is_listed_newest_first_by_kind_text_and_person(bench):
    browser, history = bench.browser(), bench.rig.history
    history.event("refused", "enable z: 100 % of it, it_is", "Anna (monitor)")
    history.event("fault", "macro #802 holds 3, we wrote 2", "daemon")
    await history.flushed()
    asked = f"/api/v1/past-events?from={EPOCH_S}&to={EPOCH_S + 5000}"
    whole = (await browser.get(asked)).json
    assert [each["kind"] for each in whole["events"]][:2] == ["fault", "refused"] and not whole["more"]
    times = [each["time"] for each in whole["events"]]
    assert times == sorted(times, reverse=True)
    assert whole["kinds"]["fault"] == 1 and sum(whole["kinds"].values()) == len(whole["events"])
    faults = (await browser.get(f"{asked}&kind=fault")).json
    assert [each["text"] for each in faults["events"]] == ["macro #802 holds 3, we wrote 2"]
    assert faults["kinds"] == whole["kinds"], "so that another kind can be chosen"
    by_person = (await browser.get(f"{asked}&text=ANNA")).json
    assert [each["kind"] for each in by_person["events"]] == ["refused"] and by_person["kinds"] == {"refused": 1}
    assert not (await browser.get(f"{asked}&text=it%25is")).json["events"], "a text is no pattern"
    few = (await browser.get(f"{asked}&limit=1")).json
    assert few == {"events": whole["events"][:1], "kinds": whole["kinds"], "more": True}
    none = (await browser.get(f"/api/v1/past-events?from=10&to={EPOCH_S - 1}")).json
    assert none == {"events": [], "kinds": {}, "more": False}


@pytest.mark.parametrize("what", ["temperatures", "writes", "events"])
async def test_records_are_downloaded_as_csv_and_parquet(bench, what):
    browser = bench.browser()
    asked = f"/api/v1/export?what={what}&from={EPOCH_S}&to={EPOCH_S + 5000}"
    answer = await browser.get(asked)
    assert answer.headers["content-type"].startswith("text/csv")
    assert f'filename="{what}-' in answer.headers["content-disposition"]
    rows = list(csv.DictReader(io.StringIO(answer.body.decode())))
    assert rows and "utc_s" in rows[0]
    packed = await browser.get(f"{asked}&format=parquet")
    assert packed.body[:4] == packed.body[-4:] == b"PAR1"


async def test_a_line_that_counts_for_nothing_is_named_where_the_output_does_not_follow(bench):
    """The overview named three sensors and not the broken chain that had taken 126."""
    rig, chain = bench.rig, "line bed: its IDs announce 2 sensors where the chain has 3"
    rig.snapshots.thermal = replace(rig.snapshots.thermal, line_faults={"bed": (chain, "more"), "spindle": ()})

    async def problems() -> list[str]:
        return (await bench.browser().get("/api/v1/status")).json["problems"]

    assert chain not in await problems(), "it follows: one disturbed pass is no problem"
    rig.snapshots.control = replace(rig.snapshots.control, state=OutputState.HOLD)
    assert chain in await problems() and "more" not in await problems()


async def test_health_is_bad_in_fault_and_without_a_link(bench):
    browser, board = bench.browser(), bench.rig.snapshots
    assert (await browser.get("/api/v1/health")).json == {"healthy": True, "state": "ACTIVE", "reason": ""}
    down = {"attempts": 1, "failures": 1, "losses": 1, "last_problem": "gone", "last_problem_utc_s": 1.0}
    board.links = (LinkSnapshot(name="cnc", up=False, problem="no answer", **down),)
    answer = await browser.get("/api/v1/health")
    assert answer.status == 503 and answer.json["reason"] == "link cnc is down: no answer"
    assert (await browser.get("/healthz")).status == 200, "the process itself lives"
    board.links = ()
    bench.rig.nc.macros.set(502, 0.5)
    for _ in range(5):
        await bench.rig.turn()
    assert bench.rig.state == "FAULT"
    answer = await browser.get("/api/v1/health")
    assert answer.status == 503 and answer.json["reason"].startswith("FAULT: ")


async def test_the_estimate_says_which_sensors_carry_it_and_what_is_measured_beside_it(bench):
    rig = bench.rig
    um = np.array([[1.0, -2.0], [0.5, 3.0]])
    thermal = replace(
        rig.snapshots.thermal,
        estimate=rig.estimate(2.0, -3.0),
        contributions=Contributions(sensor_ids=(1, 11), channels=("Y1", "Z1"), work_out=lambda: um),
    )
    rig.snapshots.thermal = thermal
    found = (await bench.browser().get("/api/v1/estimate")).json
    z = found["channels"]["Z1"]
    assert z["thermal_error_um"] == -3.0 and z["axes"] == ["z"] and z["measured_um"] is None
    assert [(each["sensor"], each["um"]) for each in z["contributions"]] == [(11, 3.0), (1, -2.0)]
    short = (await bench.browser().get("/api/v1/estimate?contributions=false")).json
    assert short["channels"]["Z1"] == z | {"contributions": None}
    assert [each["source"] for each in found["references"]] == ["O1000 N100"]
    then_um, now_um = {"Z1": 5.0}, {"Z1": 4.0}
    z = estimate_document(rig.configuration, rig.snapshots, then_um, now_um)["channels"]["Z1"]
    applied_um = rig.applied["z"] - rig.snapshots.control.baseline_um[2]
    assert z["measured_um"] == pytest.approx(-1.0 - applied_um, abs=1e-6), "its sensor feels what is applied"
    assert z["residual_um"] == pytest.approx(z["measured_um"] + 3.0, abs=1e-6)
