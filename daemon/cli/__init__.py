"""The `toolpoint` command. Sub-commands are imported only when called, so that each starts quickly."""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from importlib import import_module
from importlib.metadata import version

import click

COMMANDS = {
    "run": "daemon.cli.run:run",
    "demo": "daemon.cli.demo:demo",
    "simulate": "daemon.cli.simulate:simulate",
    "replay": "daemon.cli.replay:replay",
    "faults": "daemon.cli.faults:faults",
    "latency": "daemon.cli.latency:latency",
    "check": "daemon.cli.check:check",
    "doctor": "daemon.cli.doctor:doctor",
    "guard": "daemon.cli.guard:guard",
    "sample-config": "daemon.cli.configuration:sample_config",
    "config-schema": "daemon.cli.configuration:config_schema",
    "status": "daemon.cli.operate:status",
    "monitor": "daemon.cli.operate:monitor",
    "reference": "daemon.cli.operate:reference",
    "enable": "daemon.cli.operate:enable",
    "disable": "daemon.cli.operate:disable",
    "acknowledge": "daemon.cli.operate:acknowledge",
    "commission": "daemon.cli.commission:commission",
    "history": "daemon.cli.history:history",
    "export": "daemon.cli.history:export",
    "backup": "daemon.cli.backup:backup",
    "restore": "daemon.cli.backup:restore",
    "thermal": "daemon.cli.thermal:thermal",
    "model": "daemon.cli.model:model",
    "stability": "daemon.cli.stability:stability",
    "dynamics": "daemon.cli.dynamics:dynamics",
}
"""Sub-command -> module:attribute."""


class LazyGroup(click.Group):
    """A group whose commands are imported on first use."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        if cmd_name not in COMMANDS:
            return None
        module, _, attribute = COMMANDS[cmd_name].partition(":")
        command = getattr(import_module(module), attribute)
        assert isinstance(command, click.Command)
        return command


@click.group(cls=LazyGroup, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(version("toolpoint"), prog_name="toolpoint")
def main() -> None:
    """Keep the tool point where the program says it is while the machine warms and cools."""


__all__ = ["COMMANDS", "main"]
