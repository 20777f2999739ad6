"""The twin of a fault campaign: where the tool stands while nothing goes wrong, worked out from the law alone.

The twin stands on the same machine and hears the same NC program, but reads every sensor itself, and nothing of the
control's code is used: what was applied at the reference becomes the baseline, from which the estimate since then is
taken; a tool counts from its own setting; another model contributes from now on; a probe's deviation is cancelled.
"""

import math
from collections import deque
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from config.schema import Configuration
from models.records import FloatArray
from models.thermal.estimation import Machine, OnlineModel, OnlineReference
from models.thermal.family import ThermalModel
from models.thermal.linear import LinearModel

MEAN_S = 60.0
"""Temperatures are means of the last minute [s]."""
SETTLING_S = 15.0
"""The guard may still take up the block of before for so long after a reference; that is the baseline then [s]."""


@dataclass(slots=True)
class _Setting:
    """Where the request counts from."""

    um: float
    """What was applied then [um]."""
    nose_um: float
    offset_um: float


@dataclass(slots=True)
class _Axis:
    """One axis that follows a channel of the model."""

    channel: str
    nose_um: float = 0.0
    """Thermal error of the spindle nose since the reference, over all models since [um]."""
    before_um: float = 0.0
    """Its part from before the model in use was released [um]."""
    offset_um: float = 0.0
    """What probes have found, as far as it has not returned."""
    reference: _Setting | None = None
    tools: dict[int, _Setting] = field(default_factory=dict)


class Twin:
    """Follows temperatures and events; asked for what would be applied now."""

    def __init__(
        self, configuration: Configuration, models: Mapping[str, ThermalModel], sensor_ids: Sequence[int]
    ) -> None:
        """`models` by identity; `sensor_ids`: of the machine, in the order in which temperatures come."""
        position = {sensor_id: index for index, sensor_id in enumerate(sensor_ids)}
        sensors = configuration.temperatures.sensors
        of_sensors = {sensor.id: sensor.component for sensor in sensors}
        told = Machine(components=of_sensors, steps_k=configuration.temperatures.steps_k)
        self._models = models
        self._online: dict[str, OnlineModel] = {name: _all_counted(m).runtime(told) for name, m in models.items()}
        self._places = {name: np.array([position[i] for i in m.sensor_ids]) for name, m in models.items()}
        self._labels: dict[str, list[int]] = {}
        for sensor in sensors:
            if sensor.label:
                self._labels.setdefault(sensor.label, []).append(position[sensor.id])
        axes = configuration.compensation.axes
        self._axes = {name: _Axis(channel=axis.estimate) for name, axis in axes.items() if axis.estimate is not None}
        self._tool_terms = {name: axes[name].tool_term for name in self._axes}
        self._bounds_um = {name: axes[name].absolute_bound_um for name in self._axes}
        self._recent: deque[tuple[float, FloatArray]] = deque()
        self._mean_degc: FloatArray = np.full(len(position), np.nan)
        self._label_means: dict[str, float] = {}
        self._labels_then: dict[str, dict[str, float]] = {}
        """Of each axis, means of the labels when the tool's expansion along it began to count [degC]."""
        self._model: str | None = None
        self._tool_number = 0
        self._reference_s = -math.inf
        self._time_s = 0.0
        self._offsets_return = True
        self.known = False
        """There is a reference, and a model that has counted from it."""

    # --- what happens ---------------------------------------------------------------------

    def sample(self, time_s: float, degc: FloatArray, speed_rpm: float, tool_number: int) -> None:
        """Take what the sensors read [degC] and the tool in the spindle."""
        self._recent.append((time_s, degc))
        while self._recent[0][0] <= time_s - MEAN_S:
            self._recent.popleft()
        self._mean_degc = np.mean([degc for _, degc in self._recent], axis=0)
        self._label_means = {label: float(self._mean_degc[places].mean()) for label, places in self._labels.items()}
        for name, online in self._online.items():
            online.on_sample(time_s / 60.0, self._mean_degc[self._places[name]], speed_rpm)
        if tool_number != self._tool_number:
            self.tool_changed(tool_number)
        self._renew(time_s)

    def reference(self, time_s: float, model: str | None, applied_um: Mapping[str, float]) -> None:
        """Take a new reference: nothing moves, and the tool in the spindle is set by it."""
        self._renew(time_s)
        self._reference_s, self._offsets_return = time_s, True
        self._labels_then = dict.fromkeys(self._axes, self._label_means)
        for name, axis in self._axes.items():
            here = self._tool_number in axis.tools
            axis.tools = {
                number: _Setting(um=tool.um, nose_um=tool.nose_um - axis.nose_um, offset_um=tool.offset_um)
                for number, tool in axis.tools.items()
            }
            for tool in axis.tools.values():
                tool.offset_um -= axis.offset_um
            axis.nose_um = axis.before_um = axis.offset_um = 0.0
            axis.reference = _Setting(um=applied_um[name], nose_um=0.0, offset_um=0.0)
            if here:
                axis.tools[self._tool_number] = _Setting(um=applied_um[name], nose_um=0.0, offset_um=0.0)
        self._count_from(time_s, model)

    def settled(self, time_s: float, applied_um: Mapping[str, float]) -> None:
        """Take what the guard applies: just after a reference it may have taken up the block of before."""
        if time_s - self._reference_s > SETTLING_S:
            return
        for name, axis in self._axes.items():
            setting = axis.tools.get(self._tool_number, axis.reference)
            if setting is not None:
                setting.um = applied_um[name]

    def model(self, time_s: float, model: str) -> None:
        """Another model makes the estimate: it contributes from now on."""
        if self.known and model != self._model:
            self._renew(time_s)
            for axis in self._axes.values():
                axis.before_um = axis.nose_um
            self._count_from(time_s, model)

    def tool_set(self, time_s: float, name: str, applied_um: float) -> None:
        """The tool in the spindle was set on an axis: what is applied there is its own baseline."""
        self._renew(time_s)
        axis = self._axes[name]
        axis.tools[self._tool_number] = _Setting(um=applied_um, nose_um=axis.nose_um, offset_um=axis.offset_um)
        self._labels_then[name] = self._label_means

    def tool_changed(self, number: int) -> None:
        """Another tool is in the spindle: its own setting counts, and its expansion from now."""
        self._tool_number = number
        self._labels_then = dict.fromkeys(self._axes, self._label_means)

    def probed(self, name: str, deviation_um: float, applied_um: float) -> None:
        """A probe found a deviation with what is applied: it is cancelled."""
        if (wanted := self._unbounded_um(name)) is not None:
            self._axes[name].offset_um += applied_um - deviation_um - wanted
            self._offsets_return = True

    def restarted(self) -> None:
        """The daemon is started anew: what probes found stays as it is until the next one."""
        self._offsets_return = False

    def forget(self, *, but_for: Collection[int] = ()) -> None:
        """The control was switched off, or the daemon was away: no setting counts any more, `but_for` these tools'."""
        self.known = False
        for axis in self._axes.values():
            axis.tools = {number: tool for number, tool in axis.tools.items() if number in but_for}
            axis.reference = None

    # --- what follows ---------------------------------------------------------------------

    @property
    def axes(self) -> tuple[str, ...]:
        """Axes that follow a model."""
        return tuple(self._axes)

    def request_um(self, name: str) -> float | None:
        """Return what is to be applied on an axis [um], inside the bound; None while nothing can be said."""
        request_um, bound_um = self._unbounded_um(name), self._bounds_um[name]
        return None if request_um is None else min(max(request_um, -bound_um), bound_um)

    def _unbounded_um(self, name: str) -> float | None:
        axis = self._axes[name]
        setting = axis.tools.get(self._tool_number, axis.reference)
        if not self.known or setting is None:
            return None
        counted_um = axis.nose_um - setting.nose_um + self._tool_um(name)
        return setting.um + axis.offset_um - setting.offset_um - counted_um

    def _tool_um(self, name: str) -> float:
        """Linear expansion of the tool since its term began [um]: direction times length, coefficient and increment."""
        term = self._tool_terms[name]
        if term is None:
            return 0.0
        now, then = self._label_means, self._labels_then[name]
        increment_k = sum(weight * (now[label] - then[label]) for label, weight in term.temperatures.items())
        return float(term.direction * term.length_mm * 1e-3 * term.expansion_um_per_m_k * increment_k)

    def _count_from(self, time_s: float, model: str | None) -> None:
        self._model = model
        self.known = model in self._online
        if model is not None and model in self._online:
            degc = self._mean_degc[self._places[model]]
            time_min = time_s / 60.0
            self._online[model].set_reference(OnlineReference(time_min=time_min, now_min=time_min, degc=degc))

    def _renew(self, time_s: float) -> None:
        """Renew the nose's error by the model in use; what probes found returns as what it misses does."""
        past_min, self._time_s = (time_s - self._time_s) / 60.0, time_s
        if not self.known or self._model is None:
            return
        probing = self._models[self._model].probing
        if probing is not None and self._offsets_return:
            returns_min = dict(zip(self._models[self._model].channels, probing.correlation_min.tolist(), strict=True))
            for axis in self._axes.values():
                axis.offset_um *= math.exp(-past_min / returns_min.get(axis.channel, math.inf))
        degc = self._mean_degc[self._places[self._model]]
        found, _ = self._online[self._model].estimate(time_s / 60.0, degc, np.zeros(len(degc), dtype=bool))
        if found is None:
            self.known = False
            return
        errors_um = dict(zip(self._models[self._model].channels, found.thermal_error_um.tolist(), strict=True))
        for axis in self._axes.values():
            axis.nose_um = axis.before_um + errors_um.get(axis.channel, math.nan)


def _all_counted(model: ThermalModel) -> ThermalModel:
    """Return the model without the watch of its sensors."""
    return replace(model, watch=None) if isinstance(model, LinearModel) else model
