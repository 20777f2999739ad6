"""`toolpoint fleet`: many machines together."""

import click

from daemon.cli.fleet.simulate import simulate


@click.group()
def fleet() -> None:
    """Many machines together."""


for _command in (simulate,):
    fleet.add_command(_command)
