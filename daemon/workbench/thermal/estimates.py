"""What a thermal model would have estimated over a recording, from any row as reference."""

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from models.recordings.dataset import DatasetError, Recording
from models.records import FloatArray
from models.thermal.family import AnyThermalModel
from models.thermal.lagged import LaggedEstimator
from models.thermal.lagged_model import LaggedModel
from models.thermal.model import thermal_error_um
from models.thermal.training.inputs import bridged


class RecordedEstimates:
    """A model run over a recording as the daemon runs it, without its watch over the sensors' faults."""

    def __init__(self, model: AnyThermalModel, recording: Recording) -> None:
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
        self._states = None
        if isinstance(model, LaggedModel):
            bare = replace(model, watch=None)
            estimator = LaggedEstimator(bare)
            speed = np.full(len(degc), np.nan) if recording.speed_rpm is None else recording.speed_rpm
            state = estimator.begin(float(self._time_min[0]), degc[0], float(speed[0]))
            self._states = [estimator.features(state)]
            for time_min, row, rpm in zip(self._time_min[1:], degc[1:], speed[1:], strict=True):
                state = estimator.advance(state, float(time_min), row, float(rpm))
                self._states.append(estimator.features(state))

    def since_um(self, channel: str, first: int, stop: int) -> FloatArray:
        """Return the estimated thermal error of rows `first` to `stop` since row `first` [um]."""
        place = self.model.channels.index(channel)
        if self._states is not None:
            assert isinstance(self.model, LaggedModel)
            features = np.array(self._states[first:stop])
            change: FloatArray = (features - features[0]) @ self.model.coefficients()[:, place]
            return change
        assert not isinstance(self.model, LaggedModel)
        error = thermal_error_um(
            self.model.coefficients_um_per_k,
            self.model.drift_um_per_min,
            self._degc[first:stop] - self._degc[first],
            self._time_min[first:stop] - self._time_min[first],
        )
        return error[:, place]

    def estimates(self, channels: Iterable[str]) -> tuple[str, ...]:
        """Return those of some channels that the model estimates."""
        return tuple(channel for channel in channels if channel in self.model.channels)
