"""The `toolpoint` command. Sub-commands are imported only when called, so that each starts quickly."""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from importlib import import_module
from importlib.metadata import version

import click

COMMANDS = {
    "run": "daemon.cli.operate.run:run",
    "demo": "daemon.cli.simulate.demo:demo",
    "simulate": "daemon.cli.simulate.simulate:simulate",
    "replay": "daemon.cli.simulate.replay:replay",
    "faults": "daemon.cli.simulate.faults:faults",
    "latency": "daemon.cli.simulate.latency:latency",
    "check": "daemon.cli.admin.doctor:check",
    "doctor": "daemon.cli.admin.doctor:doctor",
    "guard": "daemon.cli.admin.guard:guard",
    "sample-config": "daemon.cli.admin.configuration:sample_config",
    "config-schema": "daemon.cli.admin.configuration:config_schema",
    "status": "daemon.cli.operate.operate:status",
    "monitor": "daemon.cli.operate.operate:monitor",
    "reference": "daemon.cli.operate.operate:reference",
    "enable": "daemon.cli.operate.operate:enable",
    "disable": "daemon.cli.operate.operate:disable",
    "acknowledge": "daemon.cli.operate.operate:acknowledge",
    "commission": "daemon.cli.admin.commission:commission",
    "history": "daemon.cli.operate.history:history",
    "export": "daemon.cli.operate.history:export",
    "backup": "daemon.cli.admin.backup:backup",
    "restore": "daemon.cli.admin.backup:restore",
    "thermal": "daemon.cli.thermal.group:thermal",
    "model": "daemon.cli.admin.model:model",
    "stability": "daemon.cli.stability.group:stability",
    "dynamics": "daemon.cli.dynamics.group:dynamics",
}
"""Sub-command -> module:attribute."""
SUMMARIES = {
    "run": "Run the daemon until SIGTERM or Ctrl-C.",
    "demo": "See compensation at work on a simulated machine.",
    "simulate": "Run the simulated machine: sensors, displacements, CNC.",
    "replay": "Play a recording on serial lines and OPC UA.",
    "faults": "Let everything go wrong on the simulated machine.",
    "latency": "Measure the delay from the sensor to the CNC.",
    "check": "Check the configuration and everything it names.",
    "doctor": "Examine this computer and the installation.",
    "guard": "Print the NC programs for the control, or their sheet.",
    "sample-config": "Print a commented configuration to begin with.",
    "config-schema": "Print the JSON Schema of the configuration.",
    "status": "Say whether compensation is on, and why not.",
    "monitor": "Watch the daemon live in the terminal.",
    "reference": "Set the reference by hand, after positioning.",
    "enable": "Switch compensation on.",
    "disable": "Switch compensation off; the offset retreats.",
    "acknowledge": "Clear a latched FAULT after its cause is gone.",
    "commission": "Prove sign and scale of each axis on the machine.",
    "history": "Show what the daemon has recorded.",
    "export": "Export records as CSV or Parquet.",
    "backup": "Back up history, configuration, models and records.",
    "restore": "Restore a back-up while the daemon is stopped.",
    "thermal": "Train and evaluate thermal models.",
    "model": "Release thermal models, and take them back.",
    "stability": "Stability of milling: lobes and stable speeds.",
    "dynamics": "Spindle dynamics: modes, responses, bearings.",
}
"""What the list of commands says of each, within one line of an 80-column terminal."""


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

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """List the commands by their summaries, without importing them."""
        with formatter.section("Commands"):
            formatter.write_dl([(name, SUMMARIES.get(name, "")) for name in self.list_commands(ctx)])


@click.group(cls=LazyGroup, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(version("toolpoint"), prog_name="toolpoint")
def main() -> None:
    """Keep the tool point where the program says it is while the machine warms and cools."""


__all__ = ["COMMANDS", "SUMMARIES", "main"]
