"""Where the tool stands, by truth: after any history of the output's pure step it stands where it was set to stand.

The nose moves by a thermal error that the model tells exactly; a probe tells exactly what is left of it. So once
sensors, link and phase are good again, work and every tool stand where their reference or setting left them, whatever
was silent, held, faded, probed, released or exchanged before. Nothing of the control's arithmetic is used here.
"""

import numpy as np
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, rule, run_state_machine_as_test
from output_machine import AXES, ON, Machine

from models.control.compensation import first_inhibit, initial_memory
from models.control.probe_values import probe_inhibit, tool_setting_inhibit
from models.control.reference import count_from
from models.control.reference_records import ReferenceMemory, ReferenceRecord, ReferenceState
from models.control.reference_restart import resumed
from models.control.state import OperatorRequest
from models.records import Instant, OutputState, Phase, Reference

TOOLS = (1, 2, 3)
STANDS_UM = 0.1
"""Deadbands of the axes add up over a few settings [um]."""
MOVES = st.tuples(st.floats(-6.0, 6.0), st.floats(-6.0, 6.0))


class Truth(RuleBasedStateMachine):
    """A machine of which the true error is known."""

    @initialize()
    def start(self) -> None:
        self.machine = Machine()
        self.nose_um = np.zeros(2)
        self.at_reference_um = np.zeros(2)
        self.of_model_um: dict[str, np.ndarray] = {}
        """What the estimates of each model have beyond the nose's error, for as long as the reference lasts."""
        self.references = 0
        self.work_um = np.zeros(2)
        self.tools_um: dict[int, np.ndarray] = {}
        self.silent = False
        self.model = "m1"
        """Makes the estimates from the next one on."""
        self.machine.step(request=ON)
        self.position()

    def tell(self) -> None:
        if not self.silent:
            told_um = self.nose_um - self.at_reference_um + self.of_model_um.get(self.model, 0.0)
            self.machine.set(thermal_error_um=told_um, estimate_age_s=1.0, model_id=self.model)

    def stands_um(self) -> np.ndarray:
        return self.nose_um + self.machine.applied

    def means_um(self) -> np.ndarray:
        """Where the tool in the spindle was set to stand."""
        number = self.machine.state.tool_number
        tool = self.machine.memory.tools.get(number)
        if tool is None:
            return self.work_um
        return np.where(np.isfinite(tool.baseline_um), self.tools_um[number], self.work_um)

    def position(self) -> None:
        machine = self.machine
        self.references += 1
        name = f"r{self.references}"
        self.at_reference_um, self.of_model_um = self.nose_um.copy(), {self.model: np.zeros(2)}
        own = self.machine.memory.tools.get(machine.state.tool_number)
        machine.set(reference_id=name, estimate_reference_id=name, kept_reference_id=name, zero_first=False)
        age_s = machine.state.estimate_age_s
        machine.set(thermal_error_um=np.zeros(2), estimate_age_s=age_s)
        machine.step()
        self.work_um = self.stands_um()
        if own is not None:
            set_um = self.tools_um[machine.state.tool_number]
            self.tools_um[machine.state.tool_number] = np.where(np.isfinite(own.baseline_um), self.work_um, set_um)

    # --- what happens -----------------------------------------------------------------------

    @rule(by_um=MOVES, seconds=st.sampled_from([1.0, 5.0, 30.0]))
    def warms(self, by_um: tuple[float, float], seconds: float) -> None:
        self.nose_um = np.clip(self.nose_um + np.array(by_um), -12.0, 12.0)
        self.tell()
        self.machine.step(elapsed_s=seconds)

    @rule(silent=st.booleans())
    def sensors_go_silent(self, silent: bool) -> None:
        self.silent = silent
        if silent:
            self.machine.set(estimate_age_s=1000.0)
        self.tell()
        self.machine.step()

    @rule(confidence=st.sampled_from([0.0, 0.5, 0.65, 0.7, 0.75, 1.0]), phase=st.sampled_from(list(Phase)))
    def confidence(self, confidence: float, phase: Phase) -> None:
        self.machine.set(confidence=confidence, phase=phase).step()

    @rule(confidence=st.sampled_from([0.65, 0.75]))
    def sensors_return_within_a_cut(self, confidence: float) -> None:
        """The cut keeps the weight that the estimate had when it began."""
        self.machine.set(confidence=confidence, phase=Phase.SAFE_POINT).step()
        self.machine.set(phase=Phase.CUTTING).step().set(confidence=1.0).step()

    @rule(link=st.booleans())
    def link(self, link: bool) -> None:
        self.machine.set(link=link).step()

    @rule()
    def work_is_positioned(self) -> None:
        if self.machine.state.link:
            self.position()

    @rule(kept=st.booleans())
    def reference_ends(self, kept: bool) -> None:
        name = self.machine.state.kept_reference_id
        self.machine.set(reference_id=None, kept_reference_id=name if kept else None).step()

    @rule(number=st.sampled_from(TOOLS))
    def tool_comes(self, number: int) -> None:
        self.machine.set(tool_number=number).step(elapsed_s=10.0)

    @rule(axis=st.integers(0, 1))
    def tool_is_set(self, axis: int) -> None:
        machine = self.machine
        inputs = machine.inputs()
        if machine.memory.reference_id is None or machine.memory.reference_id != inputs.reference_id:
            return
        if tool_setting_inhibit(machine.memory, inputs, machine.limits, first_inhibit_of(machine)) is not None:
            return
        number = machine.state.tool_number
        machine.step(tool_setting=tuple(place == axis for place in range(len(AXES))))
        before_um = self.tools_um.get(number, np.full(2, np.nan))
        self.tools_um[number] = np.where(np.arange(2) == axis, self.stands_um(), before_um)

    @rule(axis=st.integers(0, 1))
    def probed(self, axis: int) -> None:
        machine = self.machine
        left_um = np.where(np.arange(2) == axis, self.stands_um() - self.means_um(), np.nan)
        if probe_inhibit(machine.memory, machine.inputs(), machine.limits, first_inhibit_of(machine), left_um) is None:
            machine.step(probe_um=left_um)

    @rule(model=st.sampled_from(["m1", "m2"]), of_model_um=MOVES)
    def model_is_released(self, model: str, of_model_um: tuple[float, float]) -> None:
        """A model that is released while sensors are silent waits; that is the thermal task's part."""
        if model != self.model and not self.silent:
            self.model = model
            self.of_model_um.setdefault(model, np.array(of_model_um))
            self.tell()
            self.machine.step()

    @rule(then=st.sampled_from(["", "set", "probed", "positioned"]))
    def daemon_restarts(self, then: str) -> None:
        """The output begins at the guard's echo, and goes on from what was kept with the reference."""
        machine = self.machine
        output = machine.memory
        counts_from = output.error_reference_id
        begun = initial_memory(now_s=machine.now_s, applied_um=machine.applied, wanted=output.wanted)
        if counts_from is not None and machine.state.kept_reference_id == counts_from:
            in_force = output.reference_id == counts_from == machine.state.reference_id
            state = ReferenceState.VALID if in_force else ReferenceState.ENDED
            kept = ReferenceMemory(state=state, record=ReferenceRecord(reference=reference(counts_from)))
            begun = resumed(begun, count_from(kept, output, AXES))
            if not in_force:
                machine.set(reference_id=None)
        else:
            machine.set(reference_id=None, kept_reference_id=None)
        machine.memory = begun
        if then == "set":
            self.tool_is_set(axis=1)
        elif then == "probed":
            self.probed(axis=1)
        elif then == "positioned":
            self.work_is_positioned()

    @rule(on=st.booleans())
    def switched(self, on: bool) -> None:
        self.machine.step(request=ON if on else OperatorRequest(disable=frozenset(AXES)))

    # --- what must hold ----------------------------------------------------------------------

    @rule()
    def all_is_well_again(self) -> None:
        machine = self.machine
        machine.set(confidence=1.0, link=True, phase=Phase.SAFE_POINT)
        self.silent = False
        self.tell()
        machine.step(request=ON).step(8, elapsed_s=30.0)
        if machine.memory.state is OutputState.ACTIVE:
            off_um = self.stands_um() - self.means_um()
            assert np.all(np.abs(off_um) <= STANDS_UM), f"{off_um} um off, T{machine.state.tool_number}"


def reference(reference_id: str) -> Reference:
    return Reference(
        reference_id=reference_id,
        time=Instant(utc_s=0.0, monotonic_s=0.0, real_s=0.0),
        source="N100",
        degc=np.zeros(1),
        program=1,
        work_offset=54,
        power_on_count=1,
    )


def first_inhibit_of(machine: Machine):
    return first_inhibit(machine.memory, machine.inputs(), machine.limits)


def test_after_any_history_the_tool_stands_where_it_was_set_to_stand(times_as_many: int) -> None:
    """CI plays the same histories each time; `make histories` others, and more of them."""
    drawn = settings(
        max_examples=100 * times_as_many, stateful_step_count=60, derandomize=times_as_many == 1, database=None
    )
    run_state_machine_as_test(Truth, settings=drawn)
