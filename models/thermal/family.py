"""What the thermal task asks of a thermal model on line, whichever its family."""

from models.thermal.lagged_model import LaggedModel
from models.thermal.model import ThermalModel

AnyThermalModel = ThermalModel | LaggedModel
