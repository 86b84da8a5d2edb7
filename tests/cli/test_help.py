"""Help: what it teaches, and that it is there at once."""

import os
import re
import subprocess
import sys

from ms_highway.cli import irl, options
from ms_highway.envs import ENVIRONMENTS
from ms_highway.envs.demonstration import DENSITIES
from ms_highway.planning.human_models import PAPER_MODELS

COMMANDS = ["compare", "sweep", "frontier", "video", "report", "bench", "validate"]
COMMANDS += ["bench road", "values learn", "irl record", "irl fit", "irl evaluate"]


HELP = """
import sys
sys.argv[0] = "ms-highway"
from ms_highway.cli.main import main
for command in ([], *(name.split() for name in sys.argv[1:])):
    try:
        main([*command, "--help"])
    except SystemExit as ended:
        assert ended.code == 0
print(f"loaded: {sorted({'highway_env', 'jax', 'matplotlib', 'pandas', 'rich', 'scipy'} & set(sys.modules))}")
"""


def test_help_teaches_every_command_and_loads_neither_jax_nor_highway_env_nor_what_draws():
    wide = {**os.environ, "COLUMNS": "300"}
    run = subprocess.run([sys.executable, "-c", HELP, *COMMANDS], capture_output=True, text=True, check=True, env=wide)
    before, *texts = run.stdout.split("usage: ms-highway")
    assert (before, len(texts)) == ("", 1 + len(COMMANDS))
    assert min(map(len, texts)) > 250
    assert max(map(len, run.stdout.splitlines())) <= 120
    assert run.stdout.endswith("loaded: []\n")


def test_the_names_in_help_texts_are_those_that_are_known():
    assert tuple(ENVIRONMENTS) == options.SCENARIO_NAMES
    assert tuple(DENSITIES) == irl.DENSITY_NAMES
    assert tuple(options.CONTROLLERS.split(", ")[: len(PAPER_MODELS)]) == tuple(PAPER_MODELS)


def test_the_keys_that_help_texts_explain_are_those_of_the_environments():
    known = {key for environment in ENVIRONMENTS.values() for key in environment.default_config()}
    keys = re.findall(r"\b([a-z]+(?:_[a-z]+)?)=[^=,\s]", options.KEYS)
    assert {"semantics", "horizon", "step_size", "costs", "way_out"} <= set(keys)
    assert set(keys) <= known | {"naive", "a", "b", "turn", "tom"}
