"""The NC programs of a machine in the language of its control (`cnc.guard.dialect`)."""

from collections.abc import Mapping, Sequence

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
    tuning = configuration.spindle_speed
    return guard_text(
        cnc.macros,
        configuration.compensation.outputs,
        cnc.guard,
        machine=configuration.machine,
        cleared=() if tuning is None else (tuning.macros.valid_until,),
    )


def guard_text(
    macros: MacroMapConfig,
    axes: Mapping[str, AxisConfig],
    guard: GuardConfig,
    *,
    machine: str = "",
    cleared: Sequence[int] = (),
) -> str:
    """Return the text of all NC programs: guard, initialise, and where the map has macros for them the others.

    `cleared` are macro variables beside the guard's own that must not outlive power-off; only a SINUMERIK's do.
    """
    if guard.dialect == "linuxcnc":
        raise GuardTextError("the guard for LinuxCNC needs the pins of cnc.linuxcnc, and is run by LinuxCNC alone")
    if guard.dialect == "sinumerik":
        from drivers.guard.sinumerik import sinumerik_text

        return sinumerik_text(macros, axes, guard, machine=machine, cleared=cleared)
    return fanuc_text(macros, axes, guard, machine=machine)
