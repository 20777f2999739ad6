"""A shaft condensed once to its nose and bearings; after that a nose response costs well under a millisecond.

The same as 4-35 with K used directly (4-32 inverts a singular matrix wherever K is zero), but nothing is
inverted: the bearings are nodes of a chain, and the chain is closed from its rear end to the nose.
"""

from collections.abc import Iterable, Mapping
from copy import copy
from dataclasses import dataclass, replace

import numpy as np

from models.dynamics.beam import ComplexArray, Values, close
from models.dynamics.chain import Chain, Part, SpringDamper, chain_span, divide
from models.records import FloatArray

GROUPS = ("12", "34", "5")
"""The published spindle's: front bearings at the nose, front bearings behind them, rear bearing."""
KINDS = ("kt", "ct", "kr", "cr")
"""Translational stiffness [N/m] and damping [N s/m], rotational stiffness [N m/rad] and damping [N m s/rad]."""
UNITS = dict(zip(KINDS, ("N/m", "N s/m", "N m/rad", "N m s/rad"), strict=True))
"""Kind -> unit."""

BearingProperties = Mapping[str, SpringDamper]
"""Group -> properties."""


def parameters_of(groups: Iterable[str]) -> tuple[str, ...]:
    """Return the names of the parameters of groups of bearings: kt_12, ct_12, kr_12, cr_12, kt_34, ..."""
    return tuple(f"{kind}_{group}" for group in groups for kind in KINDS)


PARAMETERS = parameters_of(GROUPS)
"""Names of the published spindle's twelve parameters."""


def groups_of(names: Iterable[str]) -> tuple[str, ...]:
    """Return the groups of bearings that parameters belong to, in their order."""
    return tuple(dict.fromkeys(name.partition("_")[2] for name in names))


def properties_from_parameters(values: Mapping[str, float]) -> dict[str, SpringDamper]:
    """Return the properties of every group from its four parameters by name."""
    return {group: SpringDamper(**_of_group(values, group)) for group in groups_of(values)}


def _of_group(values: Mapping[str, float], group: str) -> dict[str, float]:
    return {
        "kt_n_per_m": values[f"kt_{group}"],
        "ct_ns_per_m": values[f"ct_{group}"],
        "kr_nm_per_rad": values[f"kr_{group}"],
        "cr_nms_per_rad": values[f"cr_{group}"],
    }


def parameters_from_properties(properties: BearingProperties) -> dict[str, float]:
    """Return the parameters by name of the groups that are there."""
    values = {}
    for group, spring in properties.items():
        numbers = (spring.kt_n_per_m, spring.ct_ns_per_m, spring.kr_nm_per_rad, spring.cr_nms_per_rad)
        values.update({f"{kind}_{group}": number for kind, number in zip(KINDS, numbers, strict=True)})
    return values


@dataclass(frozen=True, slots=True)
class _Station:
    """A place with bearings, and the stretch of shaft in front of it."""

    groups: tuple[str, ...]
    """Groups of the bearings there, usually one."""
    front: ComplexArray
    """Stiffness at the front end of the stretch, rows (11, 12, 22), shape (3, n)."""
    rear: ComplexArray
    """Stiffness at the bearing: the rear end of the stretch, and of the last one what hangs behind it, too."""
    products: ComplexArray
    """Products of the cross block that take adj(pivot) through the stretch, shape (3, 3, n)."""
    cross: ComplexArray
    """Cross block, rows (11, 12, 21, 22), shape (4, n)."""


class CondensedShaft:
    """Dynamic stiffness of a free shaft between its nose and its bearings, at fixed frequencies."""

    def __init__(self, chain: Chain, frequency_hz: FloatArray) -> None:
        """Condense a chain.

        `chain`: the shaft; the positions and groups of its supports are used, their properties are not. `frequency_hz`:
        frequencies [Hz], shape (n,), positive.
        """
        self.frequency_hz = np.asarray(frequency_hz, dtype=np.float64)
        self.omega = 2.0 * np.pi * self.frequency_hz
        supports = sorted(chain.supports, key=lambda support: support.position_m)
        parts, nodes = divide(chain, [support.position_m for support in supports])
        stops: dict[int, list[str]] = {}
        for node, support in zip(nodes, supports, strict=True):
            stops.setdefault(node, []).append(support.group)
        self.groups = tuple(dict.fromkeys(support.group for support in supports))
        self._nose_groups = stops.pop(0, [])
        tail = self._tail(parts[max(stops, default=0) :])
        self._bare_nose = np.zeros_like(tail) if stops else tail
        self._stations: list[_Station] = []
        start = 0
        for node, groups in stops.items():
            span = chain_span(parts[start:node], self.frequency_hz, damped=True)
            front, cross, rear = (np.ascontiguousarray(block, dtype=np.complex128) for block in span)
            rear = rear + tail if node == max(stops) else rear
            self._stations.append(_Station(tuple(groups), front, rear, _products(cross), cross))
            start = node

    def thinned(self, lines: slice) -> "CondensedShaft":
        """Return the shaft at some of its frequencies."""
        thin = copy(self)
        thin.frequency_hz, thin.omega = self.frequency_hz[lines], self.omega[lines]
        thin._bare_nose = self._bare_nose[:, lines]
        thin._stations = [
            replace(
                station,
                front=np.ascontiguousarray(station.front[:, lines]),
                rear=np.ascontiguousarray(station.rear[:, lines]),
                products=np.ascontiguousarray(station.products[:, :, lines]),
                cross=np.ascontiguousarray(station.cross[:, lines]),
            )
            for station in self._stations
        ]
        return thin

    def _tail(self, parts: list[Part]) -> ComplexArray:
        """Return the stiffness of the free stretch behind the last bearing."""
        nothing = np.zeros((3, len(self.frequency_hz)), dtype=np.complex128)
        if not parts:
            return nothing
        span = chain_span(parts, self.frequency_hz, damped=True)
        return np.asarray(close(span, nothing)[0], dtype=np.complex128)

    def nose_stiffness(self, properties: BearingProperties) -> ComplexArray:
        """Return the dynamic stiffness at the nose as rows (11, 12, 22), shape (3, n) [N/m, N/rad, Nm/rad].

        `properties`: of every group in `groups`.
        """
        stiffness, _ = self._close(properties, keep=False)
        return stiffness

    def nose_receptance(self, properties: BearingProperties) -> ComplexArray:
        """Return H_11 of 4-35 at the nose [m/N], shape (n,)."""
        a, b, d = self.nose_stiffness(properties)
        return np.asarray(d / (a * d - b * b), dtype=np.complex128)

    def nose_stiffnesses(self, parameters: Mapping[str, FloatArray], lines: slice) -> ComplexArray:
        """Return `nose_stiffness` for several sets of bearing properties at some of the frequencies.

        Result: rows (11, 12, 22), shape (3, k, n) [N/m, N/rad, Nm/rad].

        `parameters`: name -> values, shape (k,), of all parameters of the groups in `groups`. `lines`: which of the
        frequencies.
        """
        j_omega = 1j * self.omega[lines]
        added = {
            group: tuple(
                parameters[f"k{kind}_{group}"][:, None] + parameters[f"c{kind}_{group}"][:, None] * j_omega
                for kind in "tr"
            )
            for group in self.groups
        }
        sets = len(next(iter(parameters.values())))
        stiffness = np.repeat(self._bare_nose[:, None, lines], sets, axis=1)
        behind = np.zeros_like(stiffness)
        for station in reversed(self._stations):
            pivot = station.rear[:, None, lines] + behind
            for group in station.groups:
                pivot[0] += added[group][0]
                pivot[2] += added[group][1]
            scale = 1.0 / (pivot[0] * pivot[2] - pivot[1] * pivot[1])
            products, front = station.products[:, :, None, lines], station.front[:, None, lines]
            through = products[0] * pivot[0]
            through += products[1] * pivot[1]
            through += products[2] * pivot[2]
            through *= scale
            behind = np.subtract(front, through, out=through)
        if self._stations:
            stiffness = behind
        for group in self._nose_groups:
            stiffness[0] += added[group][0]
            stiffness[2] += added[group][1]
        return stiffness

    def nose_receptance_and_derivatives(
        self, properties: BearingProperties
    ) -> tuple[ComplexArray, dict[str, ComplexArray]]:
        """Return H_11 at the nose and its derivative by every parameter, each of shape (n,).

        A spring k at a coordinate i adds k to the stiffness, so dH_11/dk = -S_i1^2; a damper likewise with
        j omega. The receptances S_i1 from the nose to the bearings come out of the same elimination.
        """
        stiffness, pivots = self._close(properties, keep=True)
        rows = inverse_rows(stiffness)
        y, theta = rows[0], rows[1]
        nose = y
        derivatives = {name: np.zeros_like(y) for name in parameters_of(self.groups)}
        for group in self._nose_groups:
            self._add_derivatives(derivatives, group, y, theta)
        for station, inverse in zip(self._stations, reversed(pivots), strict=True):
            a, b, c, d = station.cross
            force, moment = a * y + c * theta, b * y + d * theta
            y, theta = -(inverse[0] * force + inverse[1] * moment), -(inverse[1] * force + inverse[2] * moment)
            for group in station.groups:
                self._add_derivatives(derivatives, group, y, theta)
        return nose, derivatives

    def _add_derivatives(
        self, derivatives: dict[str, ComplexArray], group: str, y: ComplexArray, theta: ComplexArray
    ) -> None:
        sliding, turning = y * y, theta * theta
        derivatives[f"kt_{group}"] -= sliding
        derivatives[f"ct_{group}"] -= 1j * self.omega * sliding
        derivatives[f"kr_{group}"] -= turning
        derivatives[f"cr_{group}"] -= 1j * self.omega * turning

    def _close(self, properties: BearingProperties, *, keep: bool) -> tuple[ComplexArray, list[ComplexArray]]:
        """Return the stiffness at the nose and, if kept, the inverse pivots of the bearings from the rear."""
        pivots: list[ComplexArray] = []
        added = {group: self._springs(properties[group]) for group in self.groups}
        behind: ComplexArray | None = None
        for station in reversed(self._stations):
            pivot = station.rear.copy() if behind is None else station.rear + behind
            for group in station.groups:
                sliding, turning = added[group]
                pivot[0] += sliding
                pivot[2] += turning
            scale = 1.0 / (pivot[0] * pivot[2] - pivot[1] * pivot[1])
            if keep:
                pivots.append(np.stack([pivot[2] * scale, -pivot[1] * scale, pivot[0] * scale]))
            through = station.products[0] * pivot[0]
            through += station.products[1] * pivot[1]
            through += station.products[2] * pivot[2]
            through *= scale
            behind = np.subtract(station.front, through, out=through)
        stiffness = self._bare_nose.copy() if behind is None else behind
        for group in self._nose_groups:
            sliding, turning = added[group]
            stiffness[0] += sliding
            stiffness[2] += turning
        return stiffness, pivots

    def _springs(self, spring: SpringDamper) -> tuple[Values | float, Values | float]:
        sliding = spring.kt_n_per_m + (1j * spring.ct_ns_per_m) * self.omega
        turning = spring.kr_nm_per_rad + (1j * spring.cr_nms_per_rad) * self.omega
        return sliding, turning


def inverse_rows(rows: ComplexArray) -> ComplexArray:
    """Return the inverse of symmetric 2 x 2 matrices, rows (11, 12, 22), shape (3, n)."""
    a, b, d = rows
    scale = 1.0 / (a * d - b * b)
    return np.stack([d * scale, -b * scale, a * scale])


def _products(cross: ComplexArray) -> ComplexArray:
    """Return what multiplies the pivot's (11, 12, 22) to give cross adj(pivot) cross^T, shape (3, 3, n)."""
    a, b, c, d = cross
    return np.stack(
        [
            np.stack([b * b, b * d, d * d]),
            np.stack([-2.0 * a * b, -(a * d + b * c), -2.0 * c * d]),
            np.stack([a * a, a * c, c * c]),
        ]
    )
