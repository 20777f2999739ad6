"""The output with a guard that a test lets run: `models.control.compensation` without clock and wire."""

from dataclasses import replace

import numpy as np
import pytest

from models.control.compensation import initial_memory, step
from models.control.state import OperatorRequest, OutputInputs, OutputLimits
from models.records import OutputState, Phase

AXES = ("y", "z")
LIMITS = OutputLimits(
    axes=AXES,
    absolute_bound_um=np.array([30.0, 60.0]),
    slew_um_per_min=np.array([60.0, 60.0]),
    step_um=np.array([5.0, 8.0]),
    rounding_um=np.array([0.05, 0.05]),
    deadband_um=np.array([0.01, 0.01]),
    stale_after_s=60.0,
    hold_limit_s=600.0,
    min_confidence=0.6,
    full_confidence=0.8,
    probe_bound_um=10.0,
)
ON = OperatorRequest(enable=frozenset(AXES))


def initial(applied=(0.0, 0.0)):
    return initial_memory(now_s=0.0, applied_um=np.array(applied), wanted=(False, False))


class Machine:
    """The output with a guard that a test lets run."""

    def __init__(self, applied=(0.0, 0.0), limits=LIMITS):
        self.memory = initial(applied)
        self.applied = np.array(applied)
        self.written = np.array(applied)
        self.now_s = 0.0
        self.limits = limits
        self.state = OutputInputs(
            now_s=0.0,
            phase=Phase.SAFE_POINT,
            link=True,
            applied_um=self.applied,
            written_um=self.written,
            thermal_error_um=np.zeros(2),
            estimate_age_s=1.0,
            confidence=1.0,
            in_domain=True,
            reference_id="r1",
            estimate_reference_id="r1",
            model_id="m1",
            tool_number=1,
        )

    def inputs(self, **changes):
        return replace(
            self.state, now_s=self.now_s, applied_um=self.applied.copy(), written_um=self.written.copy(), **changes
        )

    def step(self, count=1, *, guard=True, elapsed_s=1.0, **once):
        for _ in range(count):
            self.now_s += elapsed_s
            self.memory, self.command = step(self.memory, self.inputs(**once), self.limits)
            once = {}
            if self.command.write:
                self.written = self.command.compensation_um.copy()
            if guard:
                self.guard()
        return self

    def guard(self):
        self.applied = self.applied + np.clip(self.written - self.applied, -self.limits.step_um, self.limits.step_um)

    def set(self, **changes):
        self.state = replace(self.state, **changes)
        return self

    def following(self, y=-3.0, z=-20.0):
        self.set(thermal_error_um=np.array([y, z])).step(request=ON).step(120)
        assert self.memory.state is OutputState.ACTIVE
        assert self.applied == pytest.approx([-y, -z], abs=0.02)
        return self
