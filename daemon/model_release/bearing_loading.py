"""Loads the released bearing model for the tuning of the spindle speed, after the daemon's own checks."""

from config.schema import Configuration
from daemon.model_release.file_access import Account
from daemon.model_release.loading import LoadedModel, WantedModel, load_checked
from models.model_file import ModelError
from models.thermomechanics.artifact import model_from_json
from models.thermomechanics.regression import ThermomechanicalModel


def load_released_bearings(configuration: Configuration, account: Account) -> LoadedModel[ThermomechanicalModel]:
    """Return the bearing model of the spindle-speed tuning as this account may use it; deny by default."""
    tuning = configuration.spindle_speed
    if tuning is None:
        return LoadedModel(model=None, inhibit="no bearing model is configured (there is no section spindle_speed)")
    wanted = WantedModel(kind="bearing model", option="--bearings ")
    return load_checked(wanted, tuning.thermomechanical_model, configuration, account, _read_bearings)


def bearings_from_text(content: bytes, source: str) -> tuple[ThermomechanicalModel | None, str]:
    """Return the bearing model that a file's bytes hold, or why they hold none."""
    try:
        return model_from_json(content.decode("utf-8"), source), ""
    except UnicodeDecodeError as error:
        return None, f"{source}: this is no bearing model: byte {error.start} is not UTF-8 text"
    except ModelError as error:
        return None, str(error)


def _read_bearings(content: bytes, source: str) -> tuple[ThermomechanicalModel | None, str, str]:
    return (*bearings_from_text(content, source), "")
