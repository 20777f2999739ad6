"""Prints free-free natural frequencies of a shaft of 5 mm finite elements by ROSS, as JSON.

    python tests/support/ross_modes.py < SEGMENTS.json

The input is a list of [length, outer, inner] in mm with E, G and density of one material.
"""

import json
import sys

import numpy as np
import ross
from scipy.linalg import eigh

ELEMENT_MM = 5.0


def main() -> None:
    told = json.load(sys.stdin)
    material = ross.Material(name="material", rho=told["density"], E=told["young"], G_s=told["shear"])
    elements = []
    for length, outer, inner in told["segments"]:
        count = int(np.ceil(length / ELEMENT_MM - 1e-9))
        elements += [
            ross.ShaftElement(
                length / count / 1e3,
                inner / 1e3,
                outer / 1e3,
                material=material,
                shear_effects=True,
                rotary_inertia=True,
                gyroscopic=False,
            )
            for _ in range(count)
        ]
    rotor = ross.Rotor(elements)
    # One plane: displacement along x and rotation about y of every node.
    plane = np.ravel([[rotor.number_dof * node, rotor.number_dof * node + 4] for node in range(len(elements) + 1)])
    squares = eigh(rotor.K(0)[np.ix_(plane, plane)], rotor.M(0)[np.ix_(plane, plane)], eigvals_only=True)
    frequencies = np.sqrt(np.abs(squares[: 2 + told["count"]])) / (2 * np.pi)
    print("\n" + json.dumps({"frequency_hz": frequencies[2:].tolist(), "mass_kg": float(rotor.m)}))


if __name__ == "__main__":
    main()
