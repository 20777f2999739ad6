"""The `toolpoint` command. Sub-commands are imported only when called, so that each starts quickly."""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from collections.abc import Callable, Mapping
from importlib.metadata import version
from types import ModuleType
from typing import Any

import click

from models.errors import RefusedInputError


def _run() -> ModuleType:
    from daemon.cli.operate import run

    return run


def _demo() -> ModuleType:
    from daemon.cli.simulate import demo

    return demo


def _simulate() -> ModuleType:
    from daemon.cli.simulate import simulate

    return simulate


def _replay() -> ModuleType:
    from daemon.cli.simulate import replay

    return replay


def _faults() -> ModuleType:
    from daemon.cli.simulate import faults

    return faults


def _latency() -> ModuleType:
    from daemon.cli.simulate import latency

    return latency


def _doctor() -> ModuleType:
    from daemon.cli.admin import doctor

    return doctor


def _guard() -> ModuleType:
    from daemon.cli.admin import guard

    return guard


def _configuration() -> ModuleType:
    from daemon.cli.admin import configuration

    return configuration


def _operate() -> ModuleType:
    from daemon.cli.operate import operate

    return operate


def _commission() -> ModuleType:
    from daemon.cli.admin import commission

    return commission


def _history() -> ModuleType:
    from daemon.cli.operate import history

    return history


def _backup() -> ModuleType:
    from daemon.cli.admin import backup

    return backup


def _thermal() -> ModuleType:
    from daemon.cli.thermal import group

    return group


def _keys() -> ModuleType:
    from daemon.cli.admin import keys

    return keys


def _model() -> ModuleType:
    from daemon.cli.admin import model

    return model


def _stability() -> ModuleType:
    from daemon.cli.stability import group

    return group


def _dynamics() -> ModuleType:
    from daemon.cli.dynamics import group

    return group


COMMANDS: Mapping[str, tuple[Callable[[], ModuleType], str]] = {
    "run": (_run, "Run the daemon until SIGTERM or Ctrl-C."),
    "demo": (_demo, "See compensation at work on a simulated machine."),
    "simulate": (_simulate, "Run the simulated machine: sensors, displacements, CNC."),
    "replay": (_replay, "Play a recording on serial lines and OPC UA."),
    "faults": (_faults, "Let everything go wrong on the simulated machine."),
    "latency": (_latency, "Measure the delay from the sensor to the CNC."),
    "check": (_doctor, "Check the configuration and everything it names."),
    "doctor": (_doctor, "Examine this computer and the installation."),
    "guard": (_guard, "Print the NC programs for the control, or their sheet."),
    "sample-config": (_configuration, "Print a commented configuration to begin with."),
    "config-schema": (_configuration, "Print the JSON Schema of the configuration."),
    "status": (_operate, "Say whether compensation is on, and why not."),
    "monitor": (_operate, "Watch the daemon live in the terminal."),
    "reference": (_operate, "Set the reference by hand, after positioning."),
    "enable": (_operate, "Switch compensation on."),
    "disable": (_operate, "Switch compensation off; the offset retreats."),
    "acknowledge": (_operate, "Clear a latched FAULT after its cause is gone."),
    "commission": (_commission, "Prove sign and scale of each axis on the machine."),
    "history": (_history, "Show what the daemon has recorded."),
    "export": (_history, "Export records as CSV or Parquet."),
    "backup": (_backup, "Back up history, configuration, models and records."),
    "restore": (_backup, "Restore a back-up while the daemon is stopped."),
    "thermal": (_thermal, "Train and evaluate thermal models."),
    "model": (_model, "Release thermal models, and take them back."),
    "keys": (_keys, "Whose signatures count; sign what stands here."),
    "stability": (_stability, "Stability of milling: lobes and stable speeds."),
    "dynamics": (_dynamics, "Spindle dynamics: modes, responses, bearings."),
}
"""Sub-command -> what imports the module whose function has its name, and a line for the list of commands."""
RENAMED_OPTIONS: Mapping[str, str] = {
    "--within-percent": "--max-change-percent",
    "--second-look": "--verify-with-sdm",
    "--no-second-look": "--no-verify-with-sdm",
}
"""Old name of an option -> the new one; an entry stays for one version."""


def _by_new_name(word: str) -> str:
    old, equals, value = word.partition("=")
    if (new := RENAMED_OPTIONS.get(old)) is None:
        return word
    click.echo(f"warning: {old} is called {new} now; the old name works in this version only", err=True)
    return f"{new}{equals}{value}"


class LazyGroup(click.Group):
    """A group whose commands are imported on first use."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        if cmd_name not in COMMANDS:
            return None
        load, _ = COMMANDS[cmd_name]
        command = getattr(load(), cmd_name.replace("-", "_"))
        assert isinstance(command, click.Command)
        return command

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Read the command line, old names of options as the new ones, with a warning."""
        return super().parse_args(ctx, [_by_new_name(word) for word in args])

    def invoke(self, ctx: click.Context) -> Any:
        """Run a command; input that is refused ends it with the sentence that says why."""
        try:
            return super().invoke(ctx)
        except RefusedInputError as error:
            click.echo(str(error), err=True)
            ctx.exit(2)

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """List the commands by their summaries, without importing them."""
        with formatter.section("Commands"):
            formatter.write_dl([(name, summary) for name, (_, summary) in COMMANDS.items()])


@click.group(cls=LazyGroup, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(version("toolpoint"), prog_name="toolpoint")
def main() -> None:
    """Keep the tool point where the program says it is while the machine warms and cools."""


__all__ = ["COMMANDS", "main"]
