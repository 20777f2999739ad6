"""What the thermal task asks of a thermal model on line, whichever its family."""

from typing import Protocol

from models.records import FloatArray, Reference
from models.thermal.estimate import Estimation
from models.thermal.lagged_model import LaggedModel
from models.thermal.model import ThermalModel

AnyThermalModel = ThermalModel | LaggedModel
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

    def refer(self, reference: Reference, now_s: float) -> None:
        """Count from this reference from now on."""
        ...

    def estimate(self, reference: Reference, now_s: float, degc: FloatArray) -> Answer | None:
        """Return the thermal error since the reference; None without any usable sensor."""
        ...

    def obstacle(self) -> str:
        """Return why the model cannot be followed yet, '' when it can."""
        ...
