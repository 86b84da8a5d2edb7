"""The command ``ms-highway validate``."""

import argparse
import json
from pathlib import Path

from ms_highway.cli.command import command, option
from ms_highway.cli.console import print_tables, say

KINDS = {"action_error": "robot's control", "reward_error": "reward", "human_error": "human's control"}


@command(
    "validate",
    "replay reference episodes",
    option("directory", "directory of reference files, SCENARIO__KIND.npz", type=Path, metavar="DIR"),
    option("--json", "print JSON instead of a table", action="store_true"),
)
def validate(options: argparse.Namespace) -> None:
    """Replay logged episodes of the paper's released code: plan from every logged state and compare controls, rewards,
    human controls and switching decisions with the logs. Errors are quantiles over all steps, in the units of the logs.

    Examples:
      ms-highway validate reference/episodes --json
    """
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
