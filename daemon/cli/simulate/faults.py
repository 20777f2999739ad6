"""`toolpoint faults`: days of the simulated machine under faults, in minutes."""

import os
import random
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import click

from daemon.cli.common import option, say, write_json
from daemon.cli.options import FiniteFloat, directory_option, json_option
from daemon.cli.simulate.demo import simulation_folder


@click.command()
@option(
    "--days",
    type=FiniteFloat(min=0.01, max=366),
    default=1.0,
    help="Simulated days, about two minutes each. Every kind of fault has come once after the first.",
)
@option(
    "--seed",
    type=click.IntRange(min=0, max=2**31 - 1),
    default=None,
    help="Day, faults and their times; the same seed gives the same. Drawn and printed when it is not given.",
)
@directory_option
@json_option
def faults(days: float, seed: int | None, directory: Path | None, json_path: str | None) -> None:
    """Run the daemon beside a simulated machine on which everything goes wrong, and check what must hold.

    A simulated day takes about two minutes on an idle computer of two cores, several times as long on a busy one.
    Ctrl-C ends the campaign early and reports the days so far. Time passes as fast as the computer can. Progress
    is on standard error. Exit status 0 when everything held, 1 when something did not or the run broke off, 2 for
    bad usage.
    """
    from daemon.cli.simulate.demo import demo_machine
    from daemon.simulation.faults.result import failures, numbers, summary
    from daemon.simulation.faults.run import run_campaign

    if seed is None:
        seed = random.SystemRandom().randrange(2**31)
        say(f"seed {seed}")
    with simulation_folder(directory) as folder, on_one_core(seed):
        result = run_campaign(demo_machine(), folder, days=days, seed=seed, progress=say)
    write_json(json_path, numbers(result))
    if json_path != "-":
        click.echo(summary(result))
    found = failures(result)
    for failure in found:
        say(failure)
    sys.exit(1 if found else 0)


@contextmanager
def on_one_core(seed: int) -> Iterator[None]:
    """Keep this process and the daemon, which work in turn and never both, on one core: its caches hold both."""
    cores = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {sorted(cores)[seed % len(cores)]})
    try:
        yield
    finally:
        os.sched_setaffinity(0, cores)
