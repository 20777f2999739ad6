"""Inputs and results of a thermal model on line, whichever its family."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from models.records import FloatArray

UNSURE_UM = 1.0
"""An estimate that may be wrong by more since its reference is not followed [um]."""
Samples = Iterable[tuple[float, FloatArray, float]]
"""Time [min], temperatures in the model's order [degC], spindle speed [1/min]; NaN where unknown."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Machine:
    """What a model on line is told of the machine."""

    components: Mapping[int, str]
    """Component of each sensor, by its ID."""
    steps_k: Mapping[int, float] = field(default_factory=dict[int, float])
    """Step in which each sensor counts [K], by its ID, where it is known."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Estimation:
    """Thermal error since the reference, and how far it may be trusted."""

    thermal_error_um: FloatArray
    """Actual minus nominal [um], shape (n_channels,); always finite."""
    confidence: float
    """How far it may be followed, 0..1."""
    in_domain: bool
    """Every usable sensor, and the change since the reference, lie within what training covered."""
    imputed: tuple[int, ...]
    """IDs of the sensors that do not count; they are imputed from the others."""
    outside: tuple[int, ...]
    """IDs of the sensors outside the range that training covered."""
    band_factor: FloatArray | float = 1.0
    """By how much the model's band is widened here, beyond the domain of training or while the past is not known, of
    each channel or of all; at least 1."""
    share: float = 1.0
    """What is left of confidence for the sensors that do not count, 0..1."""
    imputed_um: float = 0.0
    """By how much what is imputed, now or when a sensor was set anew, may be off, of the worst channel [um]."""
    speed_unread_um: float = 0.0
    """By how much it may be off because spindle speed was not read, since the reference or shortly before it, of the
    worst channel [um]."""
    found_wrong_um: float = 0.0
    """What sensors that were found wrong since the latest estimate were worth until then, of the worst channel [um]."""


@dataclass(frozen=True, slots=True, kw_only=True)
class OnlineReference:
    """What a model on line counts from."""

    time_min: float
    now_min: float
    """When it is set: later than the reference itself when it is resumed."""
    degc: FloatArray
    """Temperatures at the reference [degC], in the model's order, NaN where there is none."""
    history: Samples | None = None
    """Samples up to the reference, when it lies back and states must be rebuilt."""
    excluded: Mapping[int, str] | None = None
    """Of a reference that is resumed: sensors found wrong since (ID: sign). None: a new one admits all."""
    kept: Mapping[str, Any] | None = None
    """What this or another model kept since, see `OnlineModel.kept`."""
    jumped_k: FloatArray | None = None
    """By how much inputs have jumped since the lags were last put right [K], in the model's order; None: none has."""
    shift_k: FloatArray | float = 0.0
    """What is taken off inputs that came back at another level [K]: perhaps they had only warmed by it."""


class OnlineModel(Protocol):
    """A model in use. Times [min] are on the caller's clock, temperatures in the model's sensor order."""

    @property
    def history_min(self) -> float:
        """So much history the states need [min]; 0 for a model without states."""

    @property
    def memory_min(self) -> float:
        """So much of the past the states, or a watch of the sensors alone, remember [min]; at least `history_min`."""

    @property
    def filled(self) -> float:
        """How far the states are known, 0..1: what a reference now would be worth."""

    def rebuild(self, history: Samples, wrong: Mapping[int, str] = MappingProxyType({})) -> None:
        """Fill what remembers the past from the history, in which sensors may have been wrong (ID: sign); once."""

    def on_sample(self, time_min: float, degc: FloatArray, speed_rpm: float) -> None:
        """Take temperatures [degC] and spindle speed [1/min], NaN where unknown."""

    def jumped(self, jump_k: FloatArray) -> None:
        """Take that inputs count at other levels from now on [K]: what is remembered of them is at these."""

    def set_reference(self, reference: OnlineReference) -> tuple[int, ...]:
        """Count from this reference from now on; return the IDs of the sensors that count again by that."""

    def estimate(
        self, time_min: float, degc: FloatArray, absent: npt.NDArray[np.bool_]
    ) -> tuple[Estimation | None, tuple[int, ...]]:
        """Return the thermal error since the reference, and the IDs of sensors that were set anew for it.

        Without any usable sensor there is None. `absent` says which sensors have been imputed until now. One that
        returns counts from the reference again, with lags of its own; one that the reference does not know counts
        on from where it was imputed.
        """

    def contributions_um(self) -> Callable[[], FloatArray] | None:
        """Return what works out what each sensor adds to the latest estimate; None before one.

        Result of the call: of shape (n_sensors, n_channels) [um], whatever has been estimated since.
        """

    def level_um(self, uncertainty_k: FloatArray) -> float:
        """Return by how much the thermal error may be wrong if sensors' levels are wrong by so much [K]."""

    @property
    def reference_degc(self) -> FloatArray | None:
        """Temperatures that a reference holds with sensors set anew [degC]; None where `kept` tells that instead."""

    @property
    def excluded(self) -> dict[int, str]:
        """Sensors that must not count until the next reference, by ID, each with the sign by which it was found."""

    @property
    def kept(self) -> dict[str, Any] | None:
        """What sensors that returned count from, as JSON, where the reference itself does not hold it."""
