"""The speed program of the control must be the text that the configuration prints; it tells its number."""

from config.guard.speed_text import speed_text_number
from config.guard.text import GuardTextError
from config.schema import Configuration
from daemon.commissioning.refusal import CommissioningRefusedError


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
