"""`toolpoint run`: the daemon in the foreground, as systemd starts it."""

import asyncio
import signal
import sys
from pathlib import Path

import click
import structlog

from daemon.app import Daemon
from daemon.cli.common import FAILED, config_option, option, read_with_warnings, refuse
from daemon.cnc.cnc_lock import CncLockError
from daemon.history.database import HistoryError
from daemon.telemetry.logs import configure_logging
from drivers.clock import Clock, ScaledClock, SystemClock
from drivers.registry import import_drivers

log = structlog.get_logger(__name__)

THREAD_TURN_S = 0.0005
"""A thread that computes (store, serial lines) gives way to the loop after this; Python's own 5 ms are a whole
feedback [s]."""


def parse_simulated_clock(text: str) -> ScaledClock:
    """Return the clock that 'EPOCH_REAL:EPOCH_UTC:SPEED' describes."""
    try:
        epoch_real_s, epoch_utc_s, speed = (float(part) for part in text.split(":"))
        return ScaledClock(epoch_real_s=epoch_real_s, epoch_utc_s=epoch_utc_s, speed=speed)
    except ValueError as error:
        raise click.BadParameter(f"expected EPOCH_REAL:EPOCH_UTC:SPEED, got {text!r} ({error})") from error


def hold_reload_back() -> None:
    """Keep SIGHUP waiting until it can be served: without a handler it would end the daemon."""
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGHUP})


async def _live(daemon: Daemon) -> None:
    try:
        await daemon.run()
    finally:
        hold_reload_back()


@click.command()
@config_option
@option(
    "--simulated-clock",
    metavar="REAL:UTC:SPEED",
    help="Run on a scaled clock beside a simulated machine; any other CNC is then refused.",
)
def run(config_path: Path, simulated_clock: str | None) -> None:
    """Run the daemon until SIGTERM or Ctrl-C."""
    hold_reload_back()
    configuration, warnings = read_with_warnings(config_path)
    configure_logging(configuration.service.log_level)
    for warning in warnings:
        log.warning("configuration.renamed_key", problem=str(warning))
    clock: Clock = parse_simulated_clock(simulated_clock) if simulated_clock else SystemClock()
    sys.setswitchinterval(THREAD_TURN_S)
    import_drivers(configuration)
    try:
        asyncio.run(_live(Daemon(configuration, clock, config_path=config_path)))
    except (HistoryError, CncLockError) as error:  # of the surroundings: another start may help
        refuse(str(error), FAILED)
