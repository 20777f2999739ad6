"""What of the configuration alone stands against commissioning: known before anything is asked of the machine."""

from config.schema import Configuration
from config.schema.cnc import CHECK_MISSING
from drivers.guard.programs import guard_program
from drivers.guard.speed_text import speed_text_number
from drivers.guard.text import GuardTextError


def insecure(configuration: Configuration) -> str:
    """Return why nothing is written over the connection, '' when it may be."""
    cnc = configuration.cnc
    if cnc.connection.read_only:
        return f"nothing is written to this control: {cnc.insecure_advice}"
    if cnc.connection.encrypted or cnc.allow_insecure_writes:
        return ""
    return f"nothing is written over an unencrypted, anonymous connection: {cnc.insecure_advice}"


def unchecked(configuration: Configuration) -> str:
    """Return that the block has no check, without which no axis is enabled; '' when it has one."""
    return f"cnc.macros.check {CHECK_MISSING}" if configuration.cnc.macros.check is None else ""


def without_text(configuration: Configuration) -> str:
    """Return why the control's programs cannot be made from the configuration, '' when they can."""
    if unchecked(configuration):
        return ""
    try:
        guard_program(configuration)
        if configuration.spindle_speed is not None:
            speed_text_number(configuration)
    except GuardTextError as error:
        return str(error)
    return ""
