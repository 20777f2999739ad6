"""A type of machine as its fleet knows it: places of sensors, directions of features, and a model of each machine."""

from dataclasses import dataclass, field

import numpy as np

from models.model_file import ModelError, Numbers, Packed, family_of, file_text, record_of
from models.records import FloatArray
from models.thermal.family import MACHINE_TYPE
from models.thermal.start import StartDeviation
from models.thermal.training.fleet.places import Part
from models.thermal.training.fleet.products import Space

COUNTS = (0, 1, 3, 10)
"""Numbers of recordings of a sister for which it is told how good a model with and without the fleet is."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MachineType:
    """What many machines of a type teach."""

    type_id: str
    created: str
    """ISO 8601."""
    parts: tuple[Part, ...]
    """Where each sensor of the type sits; `space.layout` counts them in this order."""
    channels: tuple[str, ...]
    space: Space
    """Its directions are the principal ones of the whole fleet."""
    eigenvalues: Numbers
    """Of the fleet's cross products in the directions, of one machine in the mean, shape (k,)."""
    penalty: float
    """Of the machines' ridges in the middle, relative to the mean variance of the columns."""
    machines: tuple[str, ...]
    """Names of the machines whose models are kept."""
    members: Packed
    """Their models, each times its share and their number (`Sharing`), shape (n_machines, k * n_channels)."""
    lowest_degc: Numbers
    """Lowest temperature that each sensor of the type had, shape (layout.sensors,)."""
    highest_degc: Numbers
    highest_speed_rpm: float
    leverage_limit: float
    """Largest leverage of a change since the first row of a run."""
    band_um: Numbers
    """Half width of the band on machines that were left out, by `COUNTS`, shape (4, n_channels); NaN: not known."""
    pivots_mm: dict[str, float] = field(default_factory=dict)
    """Channels that are slopes along an axis, and where each adds nothing [mm]."""
    mean_leaves: Numbers | None = None
    """Share of the RMSE that the mean of the other machines left on each machine that was left out, shape
    (n_left_out, n_channels); None: not known."""
    start: StartDeviation | None = None
    """What its recordings say of lags that begin at equilibrium; None: a file of a version that did not keep it."""

    def __post_init__(self) -> None:
        """Check what belongs together; raises ModelError."""
        size, columns = self.space.directions.shape[1], self.space.layout.columns
        shapes = (
            ("space.gain", self.space.gain, (columns,)),
            ("space.directions", self.space.directions, (columns, size)),
            ("eigenvalues", self.eigenvalues, (size,)),
            ("members", self.members, (len(self.machines), size * len(self.channels))),
            ("lowest_degc", self.lowest_degc, (len(self.parts),)),
            ("highest_degc", self.highest_degc, (len(self.parts),)),
            ("band_um", self.band_um, (len(COUNTS), len(self.channels))),
        )
        if len(self.parts) != self.space.layout.sensors:
            raise ModelError("parts", f"{len(self.parts)} for {self.space.layout.sensors} sensors in space.layout")
        if len(self.machines) < 2:
            raise ModelError("machines", "a type has at least two machines")
        for key, array, shape in shapes:
            if array.shape != shape:
                raise ModelError(key, f"has shape {array.shape}, but {shape} is needed")
            if key != "band_um" and not np.isfinite(array).all():
                raise ModelError(key, "holds a number that is not finite")
        leaves = self.mean_leaves
        if leaves is not None and (
            leaves.ndim != 2 or leaves.shape[1] != len(self.channels) or not (leaves >= 0).all()
        ):
            raise ModelError("mean_leaves", "is not of shares of the RMSE, one column for each channel")

    @property
    def models(self) -> FloatArray:
        """Models of the machines in the directions, shape (n_machines, k, n_channels) [um]."""
        shape = (len(self.machines), self.space.directions.shape[1], len(self.channels))
        return np.asarray(self.members, dtype=np.float64).reshape(shape)

    def to_json(self) -> str:
        """Return the text of its file."""
        return file_text(MACHINE_TYPE, self)


def machine_type_from_json(content: bytes, source: str) -> MachineType:
    """Return the type that a file holds; raises ModelError naming source and key.

    `content`: of the file. `source`: its name, for messages.
    """
    try:
        family = family_of(content)
        if family != MACHINE_TYPE:
            kind = "no model file of format 3" if family is None else f"a model of the family {family!r}"
            raise ModelError("family", f"this is {kind}, not a type of machine; `toolpoint fleet train -o` writes one")
        return record_of(content, MachineType)
    except UnicodeDecodeError as error:
        raise ModelError("", f"this is no type of machine: byte {error.start} is not UTF-8 text", source) from error
    except ModelError as error:
        raise ModelError(error.key, error.sentence, source) from error
