"""The contract of a thermal model, and the registry of families: which reader makes a model of a file.

A family is a form of model with a file and a way to run of its own. It touches its own module and one line here.
"""

from collections.abc import Callable, Mapping
from typing import Any, Protocol

from models.model_file import ModelError, family_of
from models.records import FloatArray
from models.thermal.bias import Wander
from models.thermal.estimation import Machine, OnlineModel
from models.thermal.linear import linear_model
from models.thermal.model import HyperParameters


class ThermalModel(Protocol):
    """A fitted thermal model, which proves itself whenever it is made."""

    @property
    def model_id(self) -> str:
        """Its name in history, audit and records."""

    @property
    def kind(self) -> str:
        """How it was fitted."""

    @property
    def channels(self) -> tuple[str, ...]:
        """Displacement channels that it estimates."""

    @property
    def sensor_ids(self) -> tuple[int, ...]:
        """Sensor IDs of the machine, in the order in which it takes temperatures."""

    @property
    def sensor_names(self) -> tuple[str, ...]:
        """Column names of the same sensors in the training data."""

    @property
    def axis_positions(self) -> tuple[str, ...]:
        """The last of `sensor_names`, when they are axis positions [mm], which the control must give."""

    @property
    def needs_speed(self) -> bool:
        """Whether it estimates from spindle speed, which the control must give."""

    @property
    def pivots_mm(self) -> Mapping[str, float]:
        """Channels that are slopes along an axis [um/m], and where each adds nothing [mm]."""

    @property
    def band_um(self) -> FloatArray:
        """Half width of the prediction band inside the domain [um], shape (n_channels,); NaN: nothing was held out."""

    @property
    def probing(self) -> Wander | None:
        """How what it misses wanders between probes, per channel; None: not known."""

    @property
    def refused(self) -> str | None:
        """Why its training refused it; None when it may be activated."""

    @property
    def hyper_parameters(self) -> HyperParameters:
        """How it was fitted, by name; `held_out_relative_rmse` where something was held out."""

    @property
    def created(self) -> str:
        """Date and time of the fit, ISO 8601."""

    @property
    def period_s(self) -> float | None:
        """Time over which its inputs must be means [s]; None where it does not matter."""

    @property
    def training(self) -> tuple[Any, ...]:
        """What each recording contributed, see `TrainingData`."""

    @property
    def test_vectors(self) -> tuple[Any, ...]:
        """Inputs and outputs of the fit, which were checked when it was made."""

    def runtime(self, machine: Machine) -> OnlineModel:
        """Return the model in use on a machine."""

    def recorded_um(
        self, time_min: FloatArray, degc: FloatArray, speed_rpm: FloatArray | None, first: int
    ) -> FloatArray:
        """Return what it estimates over a recording since its row `first` [um], shape (n - first, n_channels).

        `time_min` is of shape (n,) [min], `degc` of shape (n, n_sensors), finite [degC], and `speed_rpm` of shape
        (n,) [1/min], NaN where it is not known.
        """

    def to_json(self) -> str:
        """Return the text of its file."""


Loader = Callable[[bytes], ThermalModel]
"""Content of a file, whose checksum was found right -> the model; raises ModelError."""


def _gaussian_model(content: bytes) -> ThermalModel:
    from models.thermal.gaussian import gaussian_model  # noqa: PLC0415 - loaded only where such a model is

    return gaussian_model(content)


MACHINE_TYPE = "machine-type"
"""Family of a file that holds what many machines of a type teach."""
FAMILIES: dict[str, Loader] = {
    "linear": linear_model,
    "gaussian": _gaussian_model,
}
"""Family that a file names -> what reads the file."""


def model_from_json(content: str | bytes, source: str) -> ThermalModel:
    """Return the model that a file holds, of whatever family and format.

    Raises ModelError naming source and key: not JSON, an unknown family or format version, missing or unknown keys,
    wrong types or shapes, numbers that are not finite, a checksum or a test vector that differs.

    `content`: content of the file. `source`: its name, for messages.
    """
    try:
        data = content.encode() if isinstance(content, str) else content
        family = family_of(data)
        if family is None:
            from models.thermal.old_formats import old_model  # noqa: PLC0415 - loaded only where such a model is

            return old_model(data.decode())
        if family == MACHINE_TYPE:
            raise ModelError("family", "is a type of machine: `toolpoint thermal train --prior` makes a model of it")
        if family not in FAMILIES:
            raise ModelError("family", f"{family!r} is unknown; this version knows {', '.join(FAMILIES)}")
        return FAMILIES[family](data)
    except UnicodeDecodeError as error:
        raise ModelError("", f"this is no thermal model: byte {error.start} is not UTF-8 text", source) from error
    except ModelError as error:
        raise ModelError(error.key, error.sentence, source) from error
