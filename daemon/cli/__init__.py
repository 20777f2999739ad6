"""The `toolpoint` command. Sub-commands are imported only when called, so that each starts quickly."""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("PYDANTIC_DISABLE_PLUGINS", "1")  # nobody here has any, and looking takes a twentieth of a start

import difflib
import errno
import gc
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import click

from models.errors import RefusedInputError

COMMANDS: Mapping[str, str] = {
    "run": "Run the daemon until SIGTERM or Ctrl-C.",
    "demo": "See compensation at work on a simulated machine.",
    "simulate": "Simulate one's own machine, any configuration.",
    "replay": "Play a recording on serial lines and OPC UA.",
    "faults": "Let everything go wrong on the simulated machine.",
    "latency": "Measure the delay from the sensor to the CNC.",
    "check": "Check the configuration and everything it names.",
    "doctor": "Examine this computer and the installation.",
    "sources": "Read temperature sources, and find what is on a bus.",
    "cnc": "Say what the control gives and takes.",
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
    "sink": "Send the history to other systems; say how far it is.",
    "fleet": "Many machines: learn a type, simulate a plant.",
    "alarm": "Send a test message to those whom alarms reach.",
    "backup": "Back up history, configuration, models and records.",
    "restore": "Restore a back-up while the daemon is stopped.",
    "thermal": "Train and evaluate thermal models.",
    "model": "Release thermal models, and take them back.",
    "keys": "Whose signatures count; sign what stands here.",
    "users": "Accounts of the monitor: who may look, who may act.",
    "stability": "Stability of milling: lobes and stable speeds.",
    "dynamics": "Spindle dynamics: modes, responses, bearings.",
}
"""Sub-command -> a line for the list of commands."""


RENAMED_OPTIONS: Mapping[str, str] = {
    "--within-percent": "--max-change-percent",
    "--second-look": "--verify-with-sdm",
    "--no-second-look": "--no-verify-with-sdm",
}
"""Old name of an option -> the new one; an entry stays for one version."""


@contextmanager
def _without(package: str) -> Iterator[None]:
    """Let imports go on as if this package, which is used where it is installed, were not."""
    loaded = sys.modules.get(package)
    sys.modules[package] = None  # type: ignore[assignment]
    try:
        yield
    finally:
        del sys.modules[package]
        if loaded is not None:
            sys.modules[package] = loaded


@contextmanager
def _loading_the_daemon() -> Iterator[None]:
    """Load what runs day and night: soon, and no more than it needs. The daemon enables the collector when ready."""
    if sys.argv[1:2] == ["run"]:  # a process of its own
        gc.disable()  # nothing that is loaded now goes away: looking for it would take a tenth of the start
    with _without("rich"):  # structlog would load it for coloured tracebacks: 4.5 MiB
        yield


def _open_standard_streams() -> None:
    """Open what whoever started this has closed, or a question would read the connection that takes its number."""
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:
            setattr(sys, name, os.fdopen(os.open(os.devnull, os.O_RDWR), mode))


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
        if cmd_name == "run":
            with _loading_the_daemon():
                from daemon.cli.operate import run as module
        else:
            from daemon.cli.commands import module_of

            module = module_of(cmd_name)
        command = getattr(module, cmd_name.replace("-", "_"))
        assert isinstance(command, click.Command)
        return command

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """Find a command; an unknown name ends with the nearest one there is."""
        name = args[0]
        if name not in COMMANDS and not name.startswith("-") and not ctx.resilient_parsing:
            close = difflib.get_close_matches(name, COMMANDS, n=1)
            hint = f"did you mean {close[0]!r}?" if close else "`toolpoint --help` lists all."
            ctx.fail(f"No such command {name!r}; {hint}")
        return super().resolve_command(ctx, args)

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Read the command line, old names of options as the new ones, with a warning."""
        return super().parse_args(ctx, [_by_new_name(word) for word in args])

    def main(self, *args: Any, **extra: Any) -> Any:
        """Run the command line; what a terminal's encoding does not have never ends it in the middle."""
        _open_standard_streams()
        if hasattr(sys.stdout, "reconfigure"):
            sys.stdout.reconfigure(errors="replace" if sys.stdout.isatty() else "backslashreplace")
        try:
            return super().main(*args, **extra)
        except OSError as error:
            if error.errno not in (errno.ENOSPC, errno.EDQUOT):
                if error.filename is None or error.errno == errno.ENOENT:
                    raise
                click.echo(f"{error.filename}: {error.strerror}", err=True)  # this account may not use what was named
                sys.exit(1)
            click.echo(f"{error.filename or 'what was written'} ends in the middle: {error.strerror}", err=True)
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # what waits to be written is lost anyway
            sys.exit(1)

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
            formatter.write_dl(list(COMMANDS.items()))


@click.group(cls=LazyGroup, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(package_name="toolpoint", prog_name="toolpoint")
def main() -> None:
    """Keep the tool point where the program says it is while the machine warms and cools."""


__all__ = ["COMMANDS", "main"]
