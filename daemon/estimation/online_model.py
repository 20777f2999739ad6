"""What the thermal task asks of a thermal model on line, whichever its family."""

from collections.abc import Mapping
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from models.records import FloatArray, Reference
from models.thermal.estimate import Estimation
from models.thermal.family import AnyThermalModel

Answer = tuple[Estimation, Reference]
"""The estimate, and the reference it counts from: another record when returned sensors were set anew."""


class OnLineModel(Protocol):
    """One model in use; owned by the thermal task. Temperatures come in the machine's order."""

    @property
    def model(self) -> AnyThermalModel:
        """The model itself."""
        ...

    def prepare(self, now_s: float) -> None:
        """Fill the states from the history; called once, in a thread, before the first sample."""
        ...

    def take(self, now_s: float, degc: FloatArray, speed_rpm: float) -> None:
        """Take the means of the last minute: temperatures [degC] and spindle speed [1/min], NaN where unknown."""
        ...

    def refer(
        self,
        reference: Reference,
        now_s: float,
        excluded: Mapping[int, str] | None = None,
        kept: Mapping[str, Any] | None = None,
    ) -> None:
        """Count from this reference from now on.

        A new one admits every sensor. One that is taken up again comes with the sensors that were `excluded`
        since (ID: sign) and with what a model has `kept`, this one or another; it may be read up in the
        history, which takes its time: call it in a thread then.
        """
        ...

    def estimate(
        self, reference: Reference, now_s: float, degc: FloatArray, absent: npt.NDArray[np.bool_]
    ) -> Answer | None:
        """Return the thermal error since the reference; None without any usable sensor.

        `absent` says in the machine's order which sensors have been imputed until now.
        """
        ...

    @property
    def rebased(self) -> npt.NDArray[np.intp]:
        """Places in the machine's order of the sensors that are set anew when they return."""
        ...

    @property
    def excluded(self) -> dict[int, str]:
        """Sensors that must not count until the next reference, by ID, each with the sign by which it was found."""
        ...

    @property
    def kept(self) -> dict[str, Any] | None:
        """What sensors that returned count from, as JSON, where the reference itself does not hold it."""
        ...

    def obstacle(self) -> str:
        """Return why the model cannot be followed yet, '' when it can."""
        ...
