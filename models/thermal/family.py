"""The contract of a thermal model, and the registry of families: which reader makes a model of a file.

A family is a form of model with a file and a way to run of its own. It touches its own module and one line here.
"""

from collections.abc import Callable, Mapping
from typing import Any, Protocol

from models.model_file import ModelError, family_of, parse, record_from, unsigned
from models.records import FloatArray
from models.thermal.bias import Wander
from models.thermal.estimation import Machine, OnlineModel
from models.thermal.linear import LinearModel, linear_model
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
            return old_model(parse(data.decode()))
        if family == MACHINE_TYPE:
            raise ModelError("family", "is a type of machine: `toolpoint thermal train --prior` makes a model of it")
        if family not in FAMILIES:
            raise ModelError("family", f"{family!r} is unknown; this version knows {', '.join(FAMILIES)}")
        return FAMILIES[family](data)
    except UnicodeDecodeError as error:
        raise ModelError("", f"this is no thermal model: byte {error.start} is not UTF-8 text", source) from error
    except ModelError as error:
        raise ModelError(error.key, error.sentence, source) from error


SAME_1 = {"model_id", "kind", "channels", "sensor_ids", "sensor_names", "drift_um_per_min", "band_um", "training"}
SAME_1 |= {"created"}
OWN_1 = {"coefficients_um_per_k", "interval_min", "ridge_k2", "lowest_increment_k", "highest_increment_k"}
SAME_2 = {"model_id", "kind", "channels", "sensor_ids", "sensor_names", "layout", "speed_scale_rpm", "period_min"}
SAME_2 |= {"centre", "band_um", "watch", "hyper_parameters", "refused", "training", "created"}
OWN_2 = {"ridges", "leverage_limit", "lowest_degc", "highest_degc", "highest_speed_rpm"}
OPTIONAL = {"axis_positions"}


def old_model(content: Mapping[str, Any]) -> LinearModel:
    """Return the model that a file of format 1 (telescoped) or 2 (with lags) holds, as versions up to 0.1.0 wrote them.

    Raises ModelError naming the key: an unknown format version, missing or unknown keys, a checksum that differs, or
    what the model itself refuses.
    """
    version = content.get("format_version")
    if isinstance(version, bool) or version not in (1, 2):
        raise ModelError("format_version", f"{version!r} is unknown; this version of Toolpoint reads 1, 2 and 3")
    wanted = (SAME_1 | OWN_1 if version == 1 else SAME_2 | OWN_2) | {"format_version", "sha256", "test_vectors"}
    if missing := sorted(wanted - set(content)):
        raise ModelError(missing[0], "is missing")
    if unknown := sorted(set(content) - wanted - OPTIONAL):
        raise ModelError(unknown[0], "is not a key of this format")
    bare = unsigned(dict(content), "training")
    try:
        fields = _telescoped(bare) if version == 1 else _lagged(bare)
    except (TypeError, KeyError, IndexError, AttributeError) as error:
        raise ModelError("", f"does not hold what format {version} holds ({error!r:.80})") from error
    return record_from(fields | {key: bare[key] for key in OPTIONAL if key in bare}, LinearModel)


def _telescoped(old: dict[str, Any]) -> dict[str, Any]:
    sensors = len(old["sensor_ids"])
    layout = {"sensors": sensors, "lags_min": [], "speed_lags_min": []}
    solution = {
        "layout": layout,
        "design": {"departures": False},
        "gain": [1.0] * sensors,
        "weights": [list(column) for column in zip(*old["coefficients_um_per_k"], strict=True)],
    }
    own = {
        "layout": layout,
        "speed_scale_rpm": 1.0,
        "period_min": 1.0,
        "solutions": [solution],
        "centre": [0.0] * sensors,
        "domain": {
            "of_increments": True,
            "lowest": old["lowest_increment_k"],
            "highest": old["highest_increment_k"],
        },
        "watch": None,
        "hyper_parameters": {"interval_min": old["interval_min"], "ridge_k2": old["ridge_k2"]},
        "refused": None,
        "test_vectors": [
            {
                "features": vector["degc"],
                "reference": vector["reference_degc"],
                "elapsed_min": vector["elapsed_min"],
                "thermal_error_um": vector["thermal_error_um"],
            }
            for vector in old["test_vectors"]
        ],
    }
    return {key: old[key] for key in SAME_1} | own


def _lagged(old: dict[str, Any]) -> dict[str, Any]:
    own = {
        "solutions": [ridge | {"layout": old["layout"]} for ridge in old["ridges"]],
        "drift_um_per_min": [0.0] * len(old["channels"]),
        "domain": {
            "of_increments": False,
            "lowest": old["lowest_degc"],
            "highest": old["highest_degc"],
            "highest_speed_rpm": old["highest_speed_rpm"],
            "leverage_limit": old["leverage_limit"],
        },
        "test_vectors": [vector | {"elapsed_min": 0.0} for vector in old["test_vectors"]],
    }
    return {key: old[key] for key in SAME_2} | own
