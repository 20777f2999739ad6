"""Spindle, holder and tool as one: the chain over all, and the tool point from the bearings alone."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from models.dynamics.beam import ComplexArray, Segment, Span, close
from models.dynamics.bearings import BearingProperties, CondensedShaft, inverse_rows
from models.dynamics.chain import Chain, Part, chain_span
from models.records import FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class SpindleAssembly:
    """A shaft on bearings and what stands in front of its nose."""

    shaft: Chain
    front: tuple[Part, ...] = ()
    """Tool, its joint, holder, its joint to the nose, from the front backwards; a joint may be absent (rigid)."""

    @property
    def front_length_m(self) -> float:
        """Length of what stands in front of the nose [m]."""
        return sum(part.length_m for part in self.front if isinstance(part, Segment))

    def whole(self) -> Chain:
        """Return the assembly as one chain; its positions count from the front of the tool."""
        ahead = self.front_length_m
        supports = tuple(replace(each, position_m=each.position_m + ahead) for each in self.shaft.supports)
        return Chain(parts=(*self.front, *self.shaft.parts), supports=supports)


class CondensedAssembly:
    """An assembly condensed at fixed frequencies; new bearing properties cost about a millisecond."""

    def __init__(self, assembly: SpindleAssembly, frequency_hz: FloatArray) -> None:
        """Condense the shaft to nose and bearings, and what is in front of it to its two ends.

        `assembly`: the assembly; properties of the supports are not used. `frequency_hz`: frequencies [Hz], shape (n,),
        positive.
        """
        self.shaft = CondensedShaft(assembly.shaft, frequency_hz)
        self.frequency_hz = self.shaft.frequency_hz
        parts = list(assembly.front)
        self._front = chain_span(parts, self.frequency_hz, damped=True) if parts else None

    def receptance(self, properties: BearingProperties) -> ComplexArray:
        """Return the receptance at the front (tool tip, or nose when nothing is clamped) [m/N], shape (n,).

        H_11 of 4-35 for the nose, of 4-38 for the holder and the tool.
        """
        a, b, d = self.stiffness(properties)
        return np.asarray(d / (a * d - b * b), dtype=np.complex128)

    def receptance_matrix(self, properties: BearingProperties) -> ComplexArray:
        """Return H, L (= N) and P at the front as rows, shape (3, n) [m/N, rad/N, rad/(Nm)]."""
        return inverse_rows(self.stiffness(properties))

    def stiffness(self, properties: BearingProperties) -> ComplexArray:
        """Return the dynamic stiffness at the front as rows (11, 12, 22), shape (3, n) [N/m, N/rad, Nm/rad]."""
        stiffness = self.shaft.nose_stiffness(properties)
        if self._front is not None:
            stiffness, _ = close(self._front, stiffness)
        return np.asarray(stiffness, dtype=np.complex128)

    def receptances(self, parameters: Mapping[str, FloatArray], lines: slice) -> ComplexArray:
        """Return `receptance` for several sets of bearing properties at some of the frequencies.

        Result: [m/N], shape (k, n).

        `parameters`: name -> values, shape (k,), of all parameters of the shaft's groups. `lines`: which of the
        frequencies.
        """
        stiffness = self.shaft.nose_stiffnesses(parameters, lines)
        if self._front is not None:
            stiffness, _ = close(Span(*(rows[:, None, lines] for rows in self._front)), stiffness)
        a, b, d = stiffness
        return np.asarray(d / (a * d - b * b), dtype=np.complex128)
