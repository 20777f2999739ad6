"""What ROSS says about the bare steel shaft and the steel unit on its bearings, of 5 mm finite elements, as JSON.

Run by `make_ross_figures.sh` in an environment of its own; nothing of Toolpoint is imported. The JSON holds the
free-free natural frequencies of the bare shaft, its mass, the response at the unit's nose, and its undamped whirls at
12000 1/min on the same bearings in both planes, and the response at its nose then on bearings half as stiff again in y.
"""

import json
import sys
import time
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import ross
import yaml
from scipy.linalg import eigh

ELEMENT_MM = 5.0
SPINDLES = Path(__file__).parents[2] / "config" / "machine" / "data" / "spindles"
FREQUENCY_HZ = np.arange(300.0, 2501.0, 20.0)
COUNT = 3
WHIRL_RPM, WHIRLS = 12000.0, 4
STIFFER_IN_Y = 1.5
TURNING_HZ = [400.0, 700.0, 748.0, 757.0, 765.0, 900.0, 985.0, 995.0, 1400.0]
OUTPUT = Path(__file__).with_suffix(".json")


def told(name: str) -> dict[str, Any]:
    """Return a shipped spindle: its tubes as [length, outer, inner] in mm, a ring as a second [0, outer, inner]."""
    content = yaml.safe_load((SPINDLES / f"{name}.yaml").read_text("utf-8"))
    content["tubes"] = [
        [[each["length_mm"], each["outer_mm"], each["inner_mm"]]]
        + ([[0.0, each["ring"]["outer_mm"], each["outer_mm"]]] if "ring" in each else [])
        for each in content["segments"]
    ]
    return content


def plane_matrices(spindle: dict[str, Any]) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """Return stiffness, mass and node positions [mm] of one plane (x and the rotation about y), and the mass [kg]."""
    rotor, places = meshed(spindle, gyroscopic=False)
    plane = np.ravel([[rotor.number_dof * node, rotor.number_dof * node + 4] for node in range(len(places))])
    matrices = (matrix[np.ix_(plane, plane)] for matrix in (rotor.K(0), rotor.M(0)))
    return *matrices, np.array(places), float(rotor.m)


def turning_matrices(spindle: dict[str, Any]) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[float]]:
    """Return stiffness, mass, gyroscopic matrix and node positions [mm]; four coordinates each: x, y, their slopes."""
    rotor, places = meshed(spindle, gyroscopic=True)
    dof = rotor.number_dof
    bending = np.ravel([[dof * node, dof * node + 1, dof * node + 3, dof * node + 4] for node in range(len(places))])
    matrices = (matrix[np.ix_(bending, bending)] for matrix in (rotor.K(0), rotor.M(0), rotor.G()))
    return *matrices, places


def bearings_of(spindle: dict[str, Any], places: list[float]) -> Iterator[tuple[int, float, float, bool]]:
    """Yield coordinate, spring and damper of every bearing, and whether it acts in the plane of y.

    The slope of x turns about y: it is the fourth coordinate of a node, the slope of y the third.
    """
    for each in spindle["bearings"]:
        node = int(np.argmin(np.abs(np.array(places) - each["position_mm"])))
        sliding = float(each["kt_n_per_m"]), float(each["ct_ns_per_m"])
        turning = float(each["kr_nm_per_rad"]), float(each["cr_nms_per_rad"])
        yield 4 * node, *sliding, False
        yield 4 * node + 1, *sliding, True
        yield 4 * node + 3, *turning, False
        yield 4 * node + 2, *turning, True


def turning_response(spindle: dict[str, Any]) -> dict[str, Any]:
    """Return the response at the nose [m/N] of xx, xy, yx and yy, as pairs of numbers, turning from x to y."""
    stiffness, mass, gyroscopic, places = turning_matrices(spindle)
    found = []
    for omega in (2.0 * np.pi * np.array(TURNING_HZ)).tolist():
        dynamic = stiffness * (1 + 1j * spindle["structural_damping"]) - omega**2 * mass
        dynamic = dynamic + 1j * omega * WHIRL_RPM * np.pi / 30.0 * gyroscopic
        for place, spring, damper, in_y in bearings_of(spindle, places):
            dynamic[place, place] += (STIFFER_IN_Y if in_y else 1.0) * spring + 1j * omega * damper
        moved = np.linalg.solve(dynamic, np.eye(len(mass))[:, :2])[:2].ravel()
        found.append([[float(f"{each.real:.7g}"), float(f"{each.imag:.7g}")] for each in moved])
    return {"frequency_hz": TURNING_HZ, "stiffer_in_y": STIFFER_IN_Y, "receptance_m_per_n": found}


def whirls(spindle: dict[str, Any]) -> dict[str, Any]:
    """Return the lowest undamped whirls against and with the rotation [Hz]; each bearing holds both planes alike."""
    stiffness, mass, gyroscopic, places = turning_matrices(spindle)
    for place, spring, _, _ in bearings_of(spindle, places):
        stiffness[place, place] += spring
    size = len(mass)
    turning = WHIRL_RPM * np.pi / 30.0 * gyroscopic
    left = np.block([[np.zeros((size, size)), np.eye(size)], [-np.linalg.solve(mass, np.hstack((stiffness, turning)))]])
    values, vectors = np.linalg.eig(left)
    order = [int(k) for k in np.argsort(values.imag) if values[k].imag > 2.0 * np.pi]
    found: dict[str, list[float]] = {"backward": [], "forward": []}
    for k in order:
        x, y = vectors[0:size:4, k], vectors[1:size:4, k]
        turns = float(np.sum(np.abs(x + 1j * y) ** 2) - np.sum(np.abs(x - 1j * y) ** 2))
        # Where x + j y is the larger, the whirl at +w goes from x to y, in the sense of the rotation about z.
        found["forward" if turns > 0.0 else "backward"].append(round(float(values[k].imag) / (2.0 * np.pi), 4))
    return {"speed_rpm": WHIRL_RPM, **{f"{sense}_hz": each[:WHIRLS] for sense, each in found.items()}}


def meshed(spindle: dict[str, Any], *, gyroscopic: bool) -> tuple[Any, list[float]]:
    """Return the rotor and the positions of its nodes [mm]."""
    material = ross.Material(name="material", rho=7850.0, E=200e9, G_s=76.9e9)
    bearings_mm = [each["position_mm"] for each in spindle.get("bearings", ())]
    elements, places = [], [0.0]
    for segment in spindle["tubes"]:
        length = segment[0][0]
        inside = {place - places[-1] for place in bearings_mm if 0 < place - places[-1] < length}
        borders = sorted({0.0, length, *inside})
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
                            gyroscopic=gyroscopic,
                        )
                    )
                places.append(start + first + (last - first) * (number + 1) / count)
    return ross.Rotor(elements), places


def main() -> None:
    stiffness, mass, _, weight = plane_matrices(told("steel"))
    squares = eigh(stiffness, mass, eigvals_only=True)[2 : 2 + COUNT]
    unit = told("unit_model_6_y")
    stiffness, mass, places, _ = plane_matrices(unit)
    force = np.zeros(len(mass))
    force[0] = 1.0
    response, begun = [], time.process_time()
    for omega in (2 * np.pi * FREQUENCY_HZ).tolist():
        dynamic = stiffness * (1 + 1j * unit["structural_damping"]) - omega**2 * mass
        for each in unit["bearings"]:
            node = int(np.argmin(np.abs(places - each["position_mm"])))
            dynamic[2 * node, 2 * node] += float(each["kt_n_per_m"]) + 1j * omega * float(each["ct_ns_per_m"])
            dynamic[2 * node + 1, 2 * node + 1] += float(each["kr_nm_per_rad"]) + 1j * omega * float(
                each["cr_nms_per_rad"]
            )
        response.append(complex(np.linalg.solve(dynamic, force)[0]))
    per_frequency_ms = 1e3 * (time.process_time() - begun) / len(FREQUENCY_HZ)
    print(f"{per_frequency_ms:.2f} ms of processor for each frequency, in one plane", file=sys.stderr)
    found = {
        "whirl": whirls(unit),
        "turning": turning_response(unit),
        "made_by": f"ross-rotordynamics {ross.__version__}, elements of {ELEMENT_MM:g} mm",
        "natural_frequency_hz": [round(each, 4) for each in (np.sqrt(squares) / (2 * np.pi)).tolist()],
        "mass_kg": weight,
        "frequency_hz": FREQUENCY_HZ.tolist(),
        "receptance_m_per_n": [[float(f"{each.real:.7g}"), float(f"{each.imag:.7g}")] for each in response],
    }
    OUTPUT.write_text(json.dumps(found, indent=None) + "\n", "utf-8")


if __name__ == "__main__":
    main()
