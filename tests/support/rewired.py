"""A machine whose configuration names its sensors otherwise than before."""

from config.schema import Configuration
from config.schema.temperatures import LineConfig, TemperaturesConfig

EXCHANGED: list[int | str] = [2, 1, 3]


def rewired(whole: Configuration, chain: list[int | str]) -> Configuration:
    """Return the machine with this order of the sensors on its first line."""
    of = whole.temperatures
    first = LineConfig(**(of.lines[0].model_dump(exclude_unset=True) | {"chain": chain}))
    temperatures = TemperaturesConfig(lines=[first, *of.lines[1:]], sensors=of.sensors, cleansing=of.cleansing)
    return whole.model_copy(update={"temperatures": temperatures})
