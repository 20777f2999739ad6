"""A group of commands that is listed whole."""

import click

LONGEST_SENTENCE = 1000


class Group(click.Group):
    """Commands that are listed with the whole first sentence of each: cut off after 45 letters it says little."""

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        named = ((name, self.get_command(ctx, name)) for name in self.list_commands(ctx))
        rows = [(name, each.get_short_help_str(LONGEST_SENTENCE)) for name, each in named if each and not each.hidden]
        with formatter.section("Commands"):
            formatter.write_dl(rows)
