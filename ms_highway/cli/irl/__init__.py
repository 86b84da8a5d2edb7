"""The command ``ms-highway irl``, a file per subcommand; `options` has what they share.

Imports what `ms_highway.cli` may import.
"""

from typing import Any

from ms_highway.cli.irl.evaluate import add_evaluate
from ms_highway.cli.irl.fit import add_fit
from ms_highway.cli.irl.record import add_record

HELP = "Learn what human drivers want from recordings of how they drive."


def add_irl(commands: Any) -> None:
    """Add the command ``irl`` with its subcommands to a parser's subparsers."""
    irl = commands.add_parser("irl", help="record driving and learn rewards from it", description=HELP)
    subcommands = irl.add_subparsers(title="commands", required=True, metavar="COMMAND")
    for add in (add_record, add_fit, add_evaluate):
        add(subcommands)
