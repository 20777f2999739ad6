"""Free-free natural frequencies of a shaft, and its response on bearings, of 5 mm finite elements by ROSS, as JSON.

    python tests/support/ross_modes.py < SHAFT.json

The input has `segments` (lists of [length, outer, inner] in mm, a ring as a second [0, outer, inner]), E, G and
density of the one material, `structural_damping`, `bearings` ([position in mm, kt, ct, kr, cr]) and `frequency_hz`.
"""

import json
import sys
from itertools import pairwise
from typing import Any

import numpy as np
import ross
from scipy.linalg import eigh

ELEMENT_MM = 5.0


def plane_matrices(told: dict[str, Any], tubes: str) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """Return stiffness, mass and node positions [mm] of one plane (x and the rotation about y), and the mass [kg]."""
    material = ross.Material(name="material", rho=told["density"], E=told["young"], G_s=told["shear"])
    elements, places = [], [0.0]
    for segment in told[tubes]:
        length = segment[0][0]
        borders = sorted(
            {0.0, length, *(b[0] - places[-1] for b in told["bearings"] if 0 < b[0] - places[-1] < length)}
        )
        start = places[-1]
        for first, last in pairwise(borders):
            count = int(np.ceil((last - first) / ELEMENT_MM - 1e-9))
            for number in range(count):
                for _, outer, inner in segment:
                    elements.append(
                        ross.ShaftElement(
                            (last - first) / count / 1e3,
                            inner / 1e3,
                            outer / 1e3,
                            material=material,
                            n=len(places) - 1,
                            gyroscopic=False,
                        )
                    )
                places.append(start + first + (last - first) * (number + 1) / count)
    rotor = ross.Rotor(elements)
    plane = np.ravel([[rotor.number_dof * node, rotor.number_dof * node + 4] for node in range(len(places))])
    matrices = (matrix[np.ix_(plane, plane)] for matrix in (rotor.K(0), rotor.M(0)))
    return *matrices, np.array(places), float(rotor.m)


def main() -> None:
    told = json.load(sys.stdin)
    stiffness, mass, _, weight = plane_matrices(told, "bare")
    squares = eigh(stiffness, mass, eigvals_only=True)[2 : 2 + told["count"]]
    stiffness, mass, places, _ = plane_matrices(told, "unit")
    force = np.zeros(len(mass))
    force[0] = 1.0
    response = []
    for at in told["frequency_hz"]:
        omega = 2 * np.pi * at
        dynamic = stiffness * (1 + 1j * told["structural_damping"]) - omega**2 * mass
        for place, kt, ct, kr, cr in told["bearings"]:
            node = int(np.argmin(np.abs(places - place)))
            dynamic[2 * node, 2 * node] += kt + 1j * omega * ct
            dynamic[2 * node + 1, 2 * node + 1] += kr + 1j * omega * cr
        response.append(np.linalg.solve(dynamic, force)[0])
    found = {
        "frequency_hz": (np.sqrt(squares) / (2 * np.pi)).tolist(),
        "mass_kg": weight,
        "receptance_re": np.real(response).tolist(),
        "receptance_im": np.imag(response).tolist(),
    }
    print("\n" + json.dumps(found))


if __name__ == "__main__":
    main()
