"""The twin of a fault campaign: what the law says is applied, and that a tool which stands elsewhere is found."""

import ast
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from campaign_claims import claims

from config.machines import shipped_file
from config.schema import Configuration
from daemon.cli.simulate.demo import demo_machine
from daemon.simulation.faults.invariants import Ledger
from daemon.simulation.faults.truth_watch import DELAY_S, PASSED_S, TruthWatch
from daemon.simulation.faults.twin import Twin
from daemon.simulation.processes import write_simulation_configuration
from models.recordings.dataset import Recording
from models.records import FloatArray
from models.thermal.bias import Wander
from models.thermal.estimation import Machine, OnlineReference
from models.thermal.family import ThermalModel, model_from_json
from models.thermal.linear import LinearModel
from models.thermal.training.train_family import train_family

FAULTS = Path(__file__).resolve().parents[2] / "daemon" / "simulation" / "faults"
APPLIED = {"x": 0.0, "y": 4.0, "z": 10.0}
MODEL = "ridge"
"""Name under which the shipped model counts here."""
OTHER = "another"


WANTED = (False, True, True)


def shipped_model() -> ThermalModel:
    return model_from_json(shipped_file("simulated_machine_model.json").read_text(), "model")


@pytest.fixture(scope="module")
def configuration(tmp_path_factory: pytest.TempPathFactory) -> Configuration:
    """The machine of the campaign."""
    return write_simulation_configuration(demo_machine(), tmp_path_factory.mktemp("machine"), speed=1.0)[1]


class Bench:
    """A twin on a machine whose sensors all show one temperature each."""

    def __init__(self, configuration: Configuration, model: ThermalModel | None = None) -> None:
        model = model or shipped_model()
        self.configuration = configuration
        ids = [sensor.id for sensor in configuration.temperatures.sensors]
        self.twin = Twin(configuration, {MODEL: model, OTHER: model}, ids)
        self.degc: FloatArray = np.full(len(ids), 25.0)
        self.time_s = 0.0
        self.tool = 1
        self.pass_by(60.0)

    def pass_by(self, duration_s: float) -> None:
        until_s = self.time_s + duration_s
        while self.time_s < until_s:
            self.time_s += 10.0
            self.twin.sample(self.time_s, self.degc.copy(), 0.0, self.tool)

    def warm(self, by_k: float, *labels: str) -> None:
        """Warm the sensors with these labels (all of them where none is named), and let the means follow."""
        for index, sensor in enumerate(self.configuration.temperatures.sensors):
            if not labels or sensor.label in labels:
                self.degc[index] += by_k
        self.pass_by(80.0)

    def reference(self) -> None:
        self.twin.reference(self.time_s, MODEL, APPLIED)

    def requests(self) -> tuple[float, float]:
        y, z = self.twin.request_um("y"), self.twin.request_um("z")
        assert y is not None and z is not None
        return y, z


@pytest.fixture
def bench(configuration: Configuration) -> Bench:
    return Bench(configuration)


def test_the_oracles_import_nothing_of_the_control() -> None:
    for name in ("twin.py", "truth_watch.py", "state_oracle.py", "invariants.py"):
        found = {module for module in _imported(FAULTS / name) if module.startswith(("daemon", "models"))}
        assert not {m for m in found if m.startswith(("models.control", "daemon.compensation", "daemon.cnc"))}, name


def test_the_twin_leaves_no_sensor_out_because_its_own_are_right(configuration: Configuration) -> None:
    """A watch now and then takes the machine for a fault: what the twin said then was off by what is imputed."""
    ids = [sensor.id for sensor in configuration.temperatures.sensors]
    own, minutes = [ids.index(each) for each in (26, 64, 72, 87, 93)], 150
    rng = np.random.default_rng(1)
    table = 25.0 + np.sin(np.arange(minutes) / 25.0)[:, None] + rng.normal(0.0, 0.02, (minutes, len(own)))
    recording = Recording(
        name="day",
        time_s=60.0 * np.arange(float(minutes)),
        speed_rpm=None,
        temperature_names=tuple(f"T{ids[place]}" for place in own),
        temperatures_degc=table,
        displacement_names=("Y1", "Z1"),
        displacements_um=table[:, :2] * 10.0,
    )
    model = train_family([recording], "lags", sample_s=60.0, created="2026-01-01T00:00:00+00:00").model
    assert isinstance(model, LinearModel)
    model = replace(model, sensor_ids=tuple(ids[place] for place in own))
    watching, twin = model.runtime(Machine(components={})), Twin(configuration, {MODEL: model}, ids)
    counting = replace(model, watch=None).runtime(Machine(components={}))
    departs_k = np.zeros(len(own))
    for minute in range(minutes):
        departs_k[0] = max(minute - 90, 0) * 0.1
        degc = np.full(len(ids), 25.0)
        degc[own] = table[minute] + departs_k
        for each in (watching, counting):
            each.on_sample(float(minute), degc[own], 0.0)
        twin.sample(60.0 * minute, degc, 0.0, 1)
        if minute == 60:
            reference = OnlineReference(time_min=60.0, now_min=60.0, degc=degc[own])
            watching.set_reference(reference)
            counting.set_reference(reference)
            twin.reference(3600.0, MODEL, APPLIED)
    found, _ = counting.estimate(float(minutes - 1), degc[own], np.zeros(len(own), dtype=bool))
    assert found is not None and watching.excluded, "a watch would leave it out"
    assert twin.request_um("y") == pytest.approx(APPLIED["y"] - found.thermal_error_um[0], abs=1e-6)


def _imported(path: Path) -> Iterator[str]:
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.module:
            yield node.module
        elif isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)


# --- the law -------------------------------------------------------------------------------


def test_the_request_takes_the_estimate_from_the_baseline(bench: Bench) -> None:
    bench.reference()
    bench.warm(2.0)
    first = bench.requests()
    bench.warm(2.0)
    second = bench.requests()
    moved = np.array(first) - (4.0, 10.0)
    assert np.abs(moved).min() > 0.05
    assert np.array(second) - first == pytest.approx(moved, rel=0.1), "a linear model"


def test_the_bound_holds(bench: Bench) -> None:
    bench.reference()
    bench.warm(300.0)
    axes = bench.configuration.compensation.axes
    assert [abs(um) for um in bench.requests()] <= [axes["y"].absolute_bound_um, axes["z"].absolute_bound_um]


@pytest.fixture(scope="module")
def without_tool(tmp_path_factory: pytest.TempPathFactory) -> Configuration:
    machine = demo_machine()
    del machine["compensation"]["axes"]["z"]["tool_term"]
    return write_simulation_configuration(machine, tmp_path_factory.mktemp("bare"), speed=1.0)[1]


def test_a_tool_counts_from_its_own_setting_and_expands_from_when_it_came(
    bench: Bench, without_tool: Configuration
) -> None:
    bare = Bench(without_tool)
    term = bench.configuration.compensation.axes["z"].tool_term
    assert term is not None
    for each in (bare, bench):
        each.reference()
        each.warm(1.0, *term.temperatures)
    grown_um = term.direction * term.length_mm * 1e-3 * term.expansion_um_per_m_k * sum(term.temperatures.values())
    nose_um = 10.0 - bare.requests()[1]
    assert bench.requests()[1] == pytest.approx(10.0 - nose_um - grown_um)
    bench.twin.tool_changed(2)
    assert bench.requests()[1] == pytest.approx(10.0 - nose_um), "the new tool has not expanded yet"
    bench.twin.tool_set(bench.time_s, "z", 31.0)
    assert bench.requests()[1] == pytest.approx(31.0)
    bench.twin.tool_changed(1)
    assert bench.requests()[1] == pytest.approx(10.0 - nose_um), "the first tool counts from the work's reference"
    bench.twin.tool_changed(2)
    assert bench.requests()[1] == pytest.approx(31.0)


def test_a_probe_is_cancelled_and_the_setting_of_a_tool_is_gone_with_the_power(bench: Bench) -> None:
    bench.reference()
    bench.warm(2.0)
    bench.twin.probed("y", 3.0, 7.0)
    assert bench.requests()[0] == pytest.approx(4.0)
    bench.twin.forget()
    assert bench.twin.request_um("y") is None


def test_what_a_probe_found_returns_as_the_model_says_but_not_after_a_restart(configuration: Configuration) -> None:
    model = shipped_model()
    assert isinstance(model, LinearModel)
    channels = len(model.channels)
    wander = Wander(um2_per_min=np.full(channels, 0.01), correlation_min=np.full(channels, 60.0))
    bench = Bench(configuration, replace(model, probing=wander))
    bench.reference()
    bench.twin.probed("y", 3.0, 4.0)
    assert bench.requests()[0] == pytest.approx(1.0)
    bench.pass_by(3600.0)
    assert bench.requests()[0] == pytest.approx(4.0 - 3.0 / np.e, abs=0.01)
    bench.twin.restarted()
    bench.pass_by(3600.0)
    assert bench.requests()[0] == pytest.approx(4.0 - 3.0 / np.e, abs=0.01), "nobody knows of when it is"
    bench.twin.probed("y", 1.0, 4.0)
    bench.pass_by(3600.0)
    assert bench.requests()[0] == pytest.approx(4.0 - 1.0 / np.e, abs=0.01)


def test_what_the_guard_takes_up_just_after_a_reference_is_the_baseline(bench: Bench) -> None:
    bench.reference()
    bench.twin.settled(bench.time_s + 5.0, {**APPLIED, "y": 4.5})
    assert bench.requests()[0] == pytest.approx(4.5)
    bench.twin.settled(bench.time_s + 60.0, {**APPLIED, "y": 9.0})
    assert bench.requests()[0] == pytest.approx(4.5)


# --- the judge -----------------------------------------------------------------------------


class Judged:
    """A watch on a bench, with a guard that runs once a second."""

    def __init__(self, bench: Bench) -> None:
        self.bench, self.ledger = bench, Ledger([TruthWatch.NAME])
        self.watch = TruthWatch(bench.configuration, self.ledger, bench.twin)
        self.claims = claims(state="ACTIVE", reference="r1", estimate_reference="r1", model=MODEL, wanted=WANTED)
        self.now_s = bench.time_s
        self.say()

    def say(self, *, disturbed: bool = False) -> None:
        self.watch.heard(self.now_s, self.claims, lambda: APPLIED, disturbed=disturbed)

    def stand(self, duration_s: float, *, guard: bool = True, says: bool = True, **applied: float) -> int:
        """Let the tool stand there; return how often that was wrong."""
        until_s = self.now_s + duration_s
        while self.now_s < until_s:
            self.now_s += 1.0
            if says:
                self.say()
            self.watch.applied(self.now_s, {**APPLIED, **applied}, self.now_s if guard else 0.0)
        return self.ledger.counts[TruthWatch.NAME].violated


@pytest.fixture
def judged(bench: Bench) -> Judged:
    judged = Judged(bench)
    assert judged.stand(PASSED_S + 20.0) == 0
    return judged


def test_a_tool_that_stands_elsewhere_for_good_is_found_once(judged: Judged) -> None:
    assert judged.stand(200.0, y=5.0) == 0, "within one micrometre"
    assert judged.stand(600.0, y=6.0) == 1
    assert "y at 6.000 um, the twin at 4.000 um" in judged.ledger.counts[TruthWatch.NAME].examples[0]


def test_an_axis_has_the_time_that_its_slew_rate_takes(judged: Judged) -> None:
    slew_um_per_min = judged.bench.configuration.compensation.axes["z"].slew_um_per_min
    assert judged.stand(DELAY_S + 60.0 * 20.0 / slew_um_per_min - 5.0, z=30.0) == 0
    assert judged.stand(60.0, z=30.0) == 1


@pytest.mark.parametrize("state", ["HOLD", "ARMED", "RETREAT", "FAULT"])
def test_an_output_that_says_that_it_does_not_know_is_believed(judged: Judged, state: str) -> None:
    judged.claims = claims(state=state, reference="r1", estimate_reference="r1", model=MODEL, wanted=WANTED)
    assert judged.stand(3000.0, z=30.0) == 0
