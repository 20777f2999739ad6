"""Contact at an interface from a measured response in front of it (sections 4.3.2 and 5.3.3 of the dissertation)."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from models.dynamics.beam import ComplexArray
from models.dynamics.chain import Chain, chain_span
from models.dynamics.modes import dense_stiffness
from models.dynamics.response_fit import Identified, Model, nelder_mead, problem, report
from models.dynamics.response_search import Coarse, least_squares_fit, lines_of_search, one_by_one
from models.records import FloatArray

CONTACT = ("kt", "ct", "kr", "cr")
"""The parameters of a joint (4-37): translational and rotational stiffness and damping."""
INITIAL = {"kt": 2e8, "ct": 3e3, "kr": 4e5, "cr": 1e3}
"""Where to begin: of the size of Tables 5-1 to 5-3."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Interface:
    """What stands on either side of a joint, as receptances at fixed frequencies."""

    frequency_hz: FloatArray
    """[Hz], shape (n,)."""
    front: ComplexArray
    """Ends of what is in front, its rear end being the interface, shape (n, 4, 4), see `chain_receptance`."""
    rear: ComplexArray
    """What is behind, at the interface (with its bearings), shape (n, 2, 2)."""

    def response(self, values: Mapping[str, float]) -> tuple[ComplexArray, dict[str, ComplexArray]]:
        """Return the receptance at the front (4-38) and its derivative by each parameter, shape (n,).

        With the flexibility ``M = S_pp + K^-1 + S_11``, a change of K^-1 adds ``S_1p M^-1 d(K^-1) M^-1 S_p1``.
        """
        omega = 2.0 * np.pi * self.frequency_hz
        sliding = values["kt"] + 1j * omega * values["ct"]
        turning = values["kr"] + 1j * omega * values["cr"]
        total = self.front[:, 2:, 2:] + self.rear
        a, b, d = total[:, 0, 0] + 1.0 / sliding, total[:, 0, 1], total[:, 1, 1] + 1.0 / turning
        c = total[:, 1, 0]
        force, moment = self.front[:, 2, 0], self.front[:, 3, 0]
        scale = 1.0 / (a * d - b * c)
        y, theta = (d * force - b * moment) * scale, (a * moment - c * force) * scale
        back_y = (d * self.front[:, 0, 2] - c * self.front[:, 0, 3]) * scale
        back_theta = (a * self.front[:, 0, 3] - b * self.front[:, 0, 2]) * scale
        computed = self.front[:, 0, 0] - self.front[:, 0, 2] * y - self.front[:, 0, 3] * theta
        by_sliding, by_turning = -back_y * y / sliding**2, -back_theta * theta / turning**2
        slopes = {"kt": by_sliding, "ct": 1j * omega * by_sliding, "kr": by_turning, "cr": 1j * omega * by_turning}
        return computed, slopes


def chain_receptance(chain: Chain, frequency_hz: FloatArray) -> ComplexArray:
    """Return the receptance matrix of the two ends of a chain with its supports, shape (n, 4, 4)."""
    if not chain.supports:
        front, cross, rear = chain_span(list(chain.parts), frequency_hz, damped=True)
        stiffness = np.empty((len(frequency_hz), 4, 4), dtype=np.complex128)
        stiffness[:, 0, 0], stiffness[:, 0, 1], stiffness[:, 1, 1] = front
        stiffness[:, 0, 2], stiffness[:, 0, 3], stiffness[:, 1, 2], stiffness[:, 1, 3] = cross
        stiffness[:, 2, 2], stiffness[:, 2, 3], stiffness[:, 3, 3] = rear
        for row, column in ((1, 0), (2, 0), (3, 0), (2, 1), (3, 1), (3, 2)):
            stiffness[:, row, column] = stiffness[:, column, row]
        return np.asarray(np.linalg.inv(stiffness), dtype=np.complex128)
    each = []
    for at in frequency_hz:
        dense, _ = dense_stiffness(chain, float(at), 0.0, damped=True)
        ends = np.zeros((len(dense), 4))
        ends[[0, 1, -2, -1], [0, 1, 2, 3]] = 1.0
        each.append(ends.T @ np.linalg.solve(dense, ends))
    return np.array(each, dtype=np.complex128)


def identify_contact(
    interface: Interface,
    measured: ComplexArray,
    *,
    start: Mapping[str, float] | None = None,
    method: str = "lm",
) -> Identified:
    """Return the contact parameters of a joint that reproduce a measured response.

    Raises IdentificationError when the data cannot be fitted at all.

    `interface`: what stands on either side. `measured`: receptance at the front of what is in front [m/N], shape (n,).
    `start`: where to begin, by name. `method`: `lm`, or `nelder-mead` on the dissertation's cost.
    """
    begin = {**INITIAL, **(start or {})}
    free = list(CONTACT)

    def model_of(side: Interface) -> Model:
        """Return response and slopes with the fitted contact in the place of the first one."""
        return lambda values: side.response({**begin, **values})

    model = model_of(interface)
    task = problem(model, measured, free)
    if method == "nelder-mead":
        found = nelder_mead(lambda values: model(values)[0], measured, free, begin)
    else:
        lines = lines_of_search(len(measured))
        thin = model_of(
            Interface(
                frequency_hz=interface.frequency_hz[lines], front=interface.front[lines], rear=interface.rear[lines]
            )
        )
        coarse = Coarse(lines=lines, model=thin, many=one_by_one(thin, free))
        found = least_squares_fit(task, begin, coarse, INITIAL)
    return report(task, {**begin, **found.values}, found.evaluations, found.rivals)
