"""The NC programs of a machine in the language of its control (`cnc.guard.dialect`)."""

from collections.abc import Mapping

from config.schema import Configuration
from config.schema.cnc import CHECK_MISSING, MacroMapConfig
from config.schema.compensation import AxisConfig
from config.schema.guard import GuardConfig
from drivers.guard.text import GuardTextError, fanuc_text


def guard_program(configuration: Configuration) -> str:
    """Return the text of all NC programs for this machine; raises GuardTextError."""
    cnc = configuration.cnc
    if cnc.macros.check is None:
        raise GuardTextError(f"cnc.macros.check {CHECK_MISSING}")
    if cnc.guard.dialect == "linuxcnc":
        from drivers.guard.linuxcnc import linuxcnc_text

        return linuxcnc_text(cnc, configuration.compensation.outputs, machine=configuration.machine)
    return guard_text(cnc.macros, configuration.compensation.outputs, cnc.guard, machine=configuration.machine)


def guard_text(macros: MacroMapConfig, axes: Mapping[str, AxisConfig], guard: GuardConfig, *, machine: str = "") -> str:
    """Return the text of all NC programs: guard, initialise, and where the map has macros for them the others."""
    if guard.dialect == "linuxcnc":
        raise GuardTextError("the guard for LinuxCNC needs the pins of cnc.linuxcnc, and is run by LinuxCNC alone")
    if guard.dialect == "sinumerik":
        from drivers.guard.sinumerik import sinumerik_text

        return sinumerik_text(macros, axes, guard, machine=machine)
    return fanuc_text(macros, axes, guard, machine=machine)
