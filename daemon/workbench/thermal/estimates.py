"""What a thermal model would have estimated over a recording, from any row as reference."""

from collections.abc import Iterable

import numpy as np

from models.recordings.dataset import DatasetError, Recording
from models.records import FloatArray
from models.thermal.family import ThermalModel
from models.thermal.training.inputs import bridged


class RecordedEstimates:
    """A model run over a recording as the daemon runs it, without its watch over the sensors' faults."""

    def __init__(self, model: ThermalModel, recording: Recording) -> None:
        """Prepare it; raises DatasetError when a temperature of the model is not recorded, or is missing for long."""
        lacking = [name for name in model.sensor_names if name not in recording.temperature_names]
        if lacking:
            raise DatasetError(
                f"{recording.name}: the model needs temperatures that it lacks: {', '.join(lacking[:8])}"
            )
        places = [recording.temperature_names.index(name) for name in model.sensor_names]
        degc = recording.temperatures_degc[:, places]
        degc, missing = bridged(recording.time_s / 60.0, degc)
        if missing.any():
            row, column = np.argwhere(missing)[0]
            raise DatasetError(
                f"{recording.name}: column {model.sensor_names[column]}, row {row + 1} of its averages: "
                "the model needs a value, and none follows soon enough to bridge the gap; leave --model out, "
                "or cut the recording there"
            )
        self.model = model
        self._time_min = recording.time_s / 60.0
        self._degc = degc
        self._speed_rpm = recording.speed_rpm
        self._since: dict[int, FloatArray] = {}

    def since_um(self, channel: str, first: int, stop: int) -> FloatArray:
        """Return the estimated thermal error of rows `first` to `stop` since row `first` [um]."""
        if first not in self._since:
            self._since = {first: self.model.recorded_um(self._time_min, self._degc, self._speed_rpm, first)}
        return self._since[first][: stop - first, self.model.channels.index(channel)]

    def estimates(self, channels: Iterable[str]) -> tuple[str, ...]:
        """Return those of some channels that the model estimates."""
        return tuple(channel for channel in channels if channel in self.model.channels)
