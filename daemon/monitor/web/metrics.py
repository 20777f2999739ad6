"""The metrics that are read from the snapshots when Prometheus asks: temperatures, errors, bands, state as a number."""

import math
from collections.abc import Iterator

from prometheus_client.core import GaugeMetricFamily, Metric
from prometheus_client.registry import Collector

from config.schema import Configuration
from daemon.monitor.web.documents import STATES, Documents
from daemon.snapshots import SnapshotBoard

OF_AXES = {
    "estimated": (
        "toolpoint_thermal_error_micrometres",
        "Estimated thermal error since the reference, of a slope in um/m",
    ),
    "remaining": (
        "toolpoint_remaining_error_micrometres",
        "What of the error is left with what is applied, of a slope in um/m",
    ),
    "band": ("toolpoint_thermal_error_band_micrometres", "Half width of the estimate's band, of a slope in um/m"),
    "bound": ("toolpoint_compensation_bound_micrometres", "The compensation never exceeds this, of a slope in um/m"),
}
"""Value of an axis in the status -> name and meaning of its metric."""


class PresentMetrics(Collector):
    """What the snapshots say now; a number that is not known is left out."""

    def __init__(self, configuration: Configuration, board: SnapshotBoard, documents: Documents) -> None:
        self._configuration, self._board, self._documents = configuration, board, documents

    def describe(self) -> Iterator[Metric]:
        """Name the metrics without reading anything."""
        return iter(())

    def collect(self) -> Iterator[Metric]:
        state = GaugeMetricFamily(
            "toolpoint_output_state_number",
            f"State of the output: {', '.join(f'{number} {name}' for name, number in STATES.items())}",
        )
        state.add_metric([], STATES[self._board.control.state])
        yield state
        axes = self._documents.axes()
        for value, (name, meaning) in OF_AXES.items():
            family = GaugeMetricFamily(name, meaning, labels=["axis"])
            for axis, now in axes.items():
                if (number := now[f"{value}_um"]) is not None and math.isfinite(number):
                    family.add_metric([axis], float(number))
            yield family
        age = GaugeMetricFamily("toolpoint_temperatures_age_seconds", "Age of the newest temperatures")
        if (age_s := self._documents.age_s()) is not None:
            age.add_metric([], age_s)
        yield age
        yield self._temperatures()

    def _temperatures(self) -> Metric:
        family = GaugeMetricFamily("toolpoint_temperature_celsius", "Mean of the sensors of a label", labels=["label"])
        latest = self._board.thermal.temperatures
        if latest is not None:
            for label, indices in self._configuration.temperatures.labels.items():
                known = [value for value in latest.degc[list(indices)].tolist() if math.isfinite(value)]
                if known:
                    family.add_metric([label], sum(known) / len(known))
        return family
