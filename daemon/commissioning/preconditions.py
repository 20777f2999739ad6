"""Checks what must hold before the machine is asked for anything."""

import socket
from pathlib import Path

import numpy as np

import config
from config.records.commissioning import LEAST_PROOF_UM
from config.schema import Configuration
from daemon.cnc.commissionable import insecure, unchecked
from daemon.commissioning.initialising import CommissioningRefusedError
from daemon.commissioning.station import INCREMENT_SLACK, UM_PER_MM, refuse_unsafe
from drivers.clock import Clock
from drivers.contract import SIMULATED_CNC_IDENTITY
from drivers.guard.speed_text import speed_text_number
from drivers.guard.text import GuardTextError
from models.control.program import phase_of
from models.records import CncMode, CncSample, Phase

ANSWER_S = 1.0
"""A daemon takes a connection at its socket within this [s]."""
GUARD_MODES = (CncMode.MDI, CncMode.MEMORY, CncMode.REMOTE)
"""Modes in which the guard can be called."""


def refuse_running_daemon(path: Path) -> None:
    """Refuse while a daemon serves its socket: the control has one session, the store one writer."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
        probe.settimeout(ANSWER_S)
        try:
            probe.connect(str(path))
        except (FileNotFoundError, ConnectionRefusedError):
            return
        except PermissionError as error:
            raise CommissioningRefusedError(
                f"{path}: permission denied, so whether the daemon runs is unknown; run this as the daemon's user"
            ) from error
        except OSError as error:
            raise CommissioningRefusedError(f"{path}: whether the daemon runs is unknown ({error.strerror})") from error
    raise CommissioningRefusedError(
        f"the daemon is running ({path} answers), and it would find the commissioning's values foreign: "
        "switch compensation off (`toolpoint disable --zero`), wait for OFF, stop it (`systemctl stop toolpoint`), "
        "and begin again"
    )


def refuse_insecure(configuration: Configuration) -> None:
    """Refuse a connection over which nothing may be written."""
    if problem := insecure(configuration):
        raise CommissioningRefusedError(problem)


def refuse_unchecked(configuration: Configuration) -> None:
    """Refuse a block without a check: no axis would be enabled with it."""
    if problem := unchecked(configuration):
        raise CommissioningRefusedError(problem)


def refuse_shipped(record_file: Path | None) -> None:
    """Refuse a record that ships with Toolpoint: readings against it would rename it, and a new one replace it."""
    if record_file is not None and record_file.resolve().is_relative_to(Path(config.__file__).resolve().parent):
        raise CommissioningRefusedError(
            f"{record_file} ships with Toolpoint and stays as it is: copy it, and name the copy in "
            "compensation.commissioning_file (and --record)"
        )


def refuse_clock(clock: Clock, identity: str) -> None:
    """Refuse a simulated clock at anything but the simulated control."""
    if clock.speed != 1.0 and identity != SIMULATED_CNC_IDENTITY:
        raise CommissioningRefusedError(
            f"the clock is simulated but the control is not ({identity}): leave --simulated-clock away"
        )


def refuse_state(sample: CncSample, configuration: Configuration) -> None:
    """Refuse a machine that is busy, or in a mode in which no guard can be called."""
    refuse_unsafe(sample)
    if sample.mode not in GUARD_MODES:
        raise CommissioningRefusedError(
            f"the control is in mode {sample.mode.value}, in which no guard can be called: choose MDI or MEM"
        )
    if phase_of(sample, configuration.compensation.output.safe_sequence_numbers) is Phase.CUTTING:
        raise CommissioningRefusedError(
            f"a program is running (O{sample.program}, N{sample.sequence_number}, {sample.run.value}) and is not at a "
            "configured safe point (compensation.output.safe_sequence_numbers): end it, or let it stand at one"
        )


def refuse_offset(configuration: Configuration, axes: tuple[str, ...], offset_um: float) -> None:
    """Refuse an offset that proves nothing, or that an axis may not have."""
    if not np.isfinite(offset_um) or abs(offset_um) < LEAST_PROOF_UM:
        raise CommissioningRefusedError(
            f"an offset of {offset_um:g} um is too small to prove anything: at least {LEAST_PROOF_UM:g} um"
        )
    increment_um = configuration.cnc.guard.increment_mm * UM_PER_MM
    if abs(offset_um / increment_um - round(offset_um / increment_um)) > INCREMENT_SLACK:
        raise CommissioningRefusedError(
            f"an offset of {offset_um:g} um is no whole number of the control's increments of {increment_um:g} um "
            "(cnc.guard.increment_mm), so the guard could not apply it exactly; choose another --offset-um"
        )
    for axis in (each for each in axes if each not in configuration.compensation.slopes):
        bound_um = configuration.compensation.outputs[axis].absolute_bound_um
        if abs(offset_um) > bound_um:
            raise CommissioningRefusedError(
                f"axis {axis}: an offset of {offset_um:g} um is outside its absolute bound of {bound_um:g} um; choose "
                "a smaller --offset-um"
            )


def told_text(configuration: Configuration) -> int | None:
    """Return the variable in which the speed program tells its text; None where no speed is tuned."""
    tuning = configuration.spindle_speed
    return None if tuning is None else tuning.macros.called_text


def refuse_other_speed_program(configuration: Configuration, told: float | None) -> None:
    """Refuse a speed program that has not run, or whose text is another; `told` is what its variable holds."""
    tuning = configuration.spindle_speed
    if tuning is None:
        return
    try:
        number = speed_text_number(configuration)
    except GuardTextError as error:
        raise CommissioningRefusedError(f"the configuration has no speed program: {error}") from error
    load = f"load what `toolpoint guard --speed` prints into the control as O{tuning.program}"
    if told is None or told == 0.0:
        raise CommissioningRefusedError(
            f"the speed program has not told its text (#{tuning.macros.called_text} is vacant): {load}, and call it "
            f"once, tool clear of the work: G65 P{tuning.program} S{tuning.lowest_rpm:.0f}. F100. K0."
        )
    if told != number:
        raise CommissioningRefusedError(
            f"the control runs another speed program: it told text {told:g} (#{tuning.macros.called_text}), the "
            f"configuration's is {number}, with its limits and macro numbers: {load}, and call it once"
        )
