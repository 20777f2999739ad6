"""The `toolpoint` command. Sub-commands are imported only when called, so that each starts quickly."""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from collections.abc import Callable, Mapping
from importlib.metadata import version

import click


def _run() -> click.Command:
    from daemon.cli.operate.run import run

    return run


def _demo() -> click.Command:
    from daemon.cli.simulate.demo import demo

    return demo


def _simulate() -> click.Command:
    from daemon.cli.simulate.simulate import simulate

    return simulate


def _replay() -> click.Command:
    from daemon.cli.simulate.replay import replay

    return replay


def _faults() -> click.Command:
    from daemon.cli.simulate.faults import faults

    return faults


def _latency() -> click.Command:
    from daemon.cli.simulate.latency import latency

    return latency


def _check() -> click.Command:
    from daemon.cli.admin.doctor import check

    return check


def _doctor() -> click.Command:
    from daemon.cli.admin.doctor import doctor

    return doctor


def _guard() -> click.Command:
    from daemon.cli.admin.guard import guard

    return guard


def _sample_config() -> click.Command:
    from daemon.cli.admin.configuration import sample_config

    return sample_config


def _config_schema() -> click.Command:
    from daemon.cli.admin.configuration import config_schema

    return config_schema


def _status() -> click.Command:
    from daemon.cli.operate.operate import status

    return status


def _monitor() -> click.Command:
    from daemon.cli.operate.operate import monitor

    return monitor


def _reference() -> click.Command:
    from daemon.cli.operate.operate import reference

    return reference


def _enable() -> click.Command:
    from daemon.cli.operate.operate import enable

    return enable


def _disable() -> click.Command:
    from daemon.cli.operate.operate import disable

    return disable


def _acknowledge() -> click.Command:
    from daemon.cli.operate.operate import acknowledge

    return acknowledge


def _commission() -> click.Command:
    from daemon.cli.admin.commission import commission

    return commission


def _history() -> click.Command:
    from daemon.cli.operate.history import history

    return history


def _export() -> click.Command:
    from daemon.cli.operate.history import export

    return export


def _backup() -> click.Command:
    from daemon.cli.admin.backup import backup

    return backup


def _restore() -> click.Command:
    from daemon.cli.admin.backup import restore

    return restore


def _thermal() -> click.Command:
    from daemon.cli.thermal.group import thermal

    return thermal


def _model() -> click.Command:
    from daemon.cli.admin.model import model

    return model


def _stability() -> click.Command:
    from daemon.cli.stability.group import stability

    return stability


def _dynamics() -> click.Command:
    from daemon.cli.dynamics.group import dynamics

    return dynamics


COMMANDS: dict[str, Callable[[], click.Command]] = {
    "run": _run,
    "demo": _demo,
    "simulate": _simulate,
    "replay": _replay,
    "faults": _faults,
    "latency": _latency,
    "check": _check,
    "doctor": _doctor,
    "guard": _guard,
    "sample-config": _sample_config,
    "config-schema": _config_schema,
    "status": _status,
    "monitor": _monitor,
    "reference": _reference,
    "enable": _enable,
    "disable": _disable,
    "acknowledge": _acknowledge,
    "commission": _commission,
    "history": _history,
    "export": _export,
    "backup": _backup,
    "restore": _restore,
    "thermal": _thermal,
    "model": _model,
    "stability": _stability,
    "dynamics": _dynamics,
}
"""Sub-command -> what imports it."""
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
        load = COMMANDS.get(cmd_name)
        return load() if load else None

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Read the command line, old names of options as the new ones, with a warning."""
        return super().parse_args(ctx, [_by_new_name(word) for word in args])

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """List the commands by their summaries, without importing them."""
        with formatter.section("Commands"):
            formatter.write_dl([(name, SUMMARIES.get(name, "")) for name in self.list_commands(ctx)])


@click.group(cls=LazyGroup, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(version("toolpoint"), prog_name="toolpoint")
def main() -> None:
    """Keep the tool point where the program says it is while the machine warms and cools."""


__all__ = ["COMMANDS", "SUMMARIES", "main"]
