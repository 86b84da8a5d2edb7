"""The command ``ms-highway validate``."""

import argparse
import json
from pathlib import Path
from typing import Any

from ms_highway.cli.console import add_command, print_tables, say

HELP = """\
Replay logged episodes of the paper's released code: plan from every logged state and compare controls, rewards, human
controls and switching decisions with the logs. Errors are quantiles over all steps, in the units of the logs."""

EXAMPLES = """\
example:
  ms-highway validate reference/episodes --json"""

KINDS = {"action_error": "robot's control", "reward_error": "reward", "human_error": "human's control"}


def add_validate(commands: Any) -> None:
    """Add the command ``validate`` to a parser's subparsers."""
    parser = add_command(commands, "validate", "replay reference episodes", HELP, EXAMPLES)
    parser.add_argument("directory", type=Path, metavar="DIR", help="directory of reference files, SCENARIO__KIND.npz")
    parser.add_argument("--json", action="store_true", help="print JSON instead of a table")
    parser.set_defaults(run=_validate)


def _validate(options: argparse.Namespace) -> None:
    from ms_highway.experiments.validation import validate
    from ms_highway.visualization.tables import grid

    result = validate(options.directory)
    if options.json:
        say(json.dumps(result, indent=2))
        return
    rows = []
    for name, errors in result["files"].items():
        row = {"file": name}
        for kind, heading in KINDS.items():
            row[heading] = " ".join(f"{value:.0e}" for value in errors[kind].values())
        row["decisions"] = "{agree} of {all}".format(**errors["decisions"]) if "decisions" in errors else ""
        rows.append(row)
    print_tables(grid("errors against the logs: median, 90 %, 99 %, largest", rows))
