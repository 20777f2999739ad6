"""The reference page of all commands, made from the commands themselves by `make docs`."""

from collections.abc import Iterator

import click

from daemon.cli import main

WIDTH = 100
HEAD = """\
# Commands

<!-- Made from the commands by `make docs`; edit their help texts in daemon/cli/, not here. -->

Every command answers `--help`. Results go to standard output, everything said to a person to
standard error, so that `--json -` prints JSON and nothing else.

| exit status | meaning |
|---|---|
| 0 | done; a run that judges itself met its own checks |
| 1 | the run or its own checks failed, or the daemon refused the request |
| 2 | bad usage or configuration; nothing was done |
"""


def commands(group: click.Group, path: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], click.Command]]:
    """Yield every command below a group with the words that call it, groups before their commands."""
    context = click.Context(group, info_name=" ".join(path) or None)
    for name in group.list_commands(context):
        command = group.get_command(context, name)
        if command is None or command.hidden:
            continue
        yield (*path, name), command
        if isinstance(command, click.Group):
            yield from commands(command, (*path, name))


def commands_reference() -> str:
    """Return the reference page in Markdown."""
    lines = HEAD.splitlines()
    for path, command in commands(main):
        context = click.Context(command, info_name=" ".join(("toolpoint", *path)), terminal_width=WIDTH)
        usage = command.get_usage(context).removeprefix("Usage: ")
        lines += ["", f"## `toolpoint {' '.join(path)}`", "", _help(command), "", "```", usage, "```"]
        rows = [row for parameter in command.get_params(context) for row in _row(parameter, context)]
        if rows:
            lines += ["", "| argument or option | meaning |", "|---|---|", *rows]
    return "\n".join(lines) + "\n"


def _help(command: click.Command) -> str:
    text = (command.help or "").split("\f")[0].replace("\b\n", "")
    return "\n".join(line.strip() for line in text.strip().splitlines())


def _row(parameter: click.Parameter, context: click.Context) -> Iterator[str]:
    if isinstance(parameter, click.Option):
        if parameter.hidden or "--help" in parameter.opts:
            return
        record = parameter.get_help_record(context)
        names, text = record or (", ".join(parameter.opts), "")
        yield f"| `{_cell(names)}` | {_cell(text)} |"
    else:
        kind = f"one of {', '.join(parameter.type.choices)}" if isinstance(parameter.type, click.Choice) else ""
        yield f"| `{_cell(parameter.make_metavar(context))}` | {_cell(kind) or 'see above'} |"


def _cell(text: str) -> str:
    return " ".join(text.replace("|", "\\|").split())


if __name__ == "__main__":
    print(commands_reference(), end="")
