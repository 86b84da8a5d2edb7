"""The command ``ms-highway validate``."""

import argparse
import json
from pathlib import Path
from typing import Any

from ms_highway.cli.console import add_command, print_tables

__all__ = ["add_validate"]

HELP = """\
Replay logged episodes of the paper's released code: plan from every logged state and compare controls, rewards, human
controls and switching decisions with the logs. Errors are quantiles over all steps, in the units of the logs."""

EXAMPLES = """\
example:
  ms-highway validate reference/episodes --json"""


def add_validate(commands: Any) -> None:
    """Add the command ``validate`` to a parser's subparsers."""
    parser = add_command(commands, "validate", "replay reference episodes", HELP, EXAMPLES)
    parser.add_argument("directory", type=Path, metavar="DIR", help="directory of reference files, SCENARIO__KIND.npz")
    parser.add_argument("--json", action="store_true", help="print JSON instead of a table")
    parser.set_defaults(run=_validate)


def _validate(options: argparse.Namespace) -> None:
    from rich.box import SIMPLE
    from rich.table import Table

    from ms_highway.experiments.validation import validate

    result = validate(options.directory)
    if options.json:
        print(json.dumps(result, indent=2))
        return
    grid = Table(box=SIMPLE, title="errors against the logs: median, 90 %, 99 %, largest", title_justify="left")
    for column in ("file", "robot's control", "reward", "human's control", "decisions"):
        grid.add_column(column, justify="left" if column == "file" else "right", no_wrap=column == "file")
    for name, errors in result["files"].items():
        cells = [
            " ".join(f"{value:.0e}" for value in errors[kind].values())
            for kind in ("action_error", "reward_error", "human_error")
        ]
        decisions = errors.get("decisions")
        grid.add_row(name, *cells, f"{decisions['agree']} of {decisions['all']}" if decisions else "")
    print_tables(grid)
