"""`toolpoint fleet`: many machines together."""

import click

from daemon.cli.fleet.simulate import simulate
from daemon.cli.fleet.store import store
from daemon.cli.fleet.train import train


@click.group()
def fleet() -> None:
    """Many machines together."""


for _command in (simulate, store, train):
    fleet.add_command(_command)
