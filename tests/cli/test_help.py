"""Help: what it teaches, and that it is there at once."""

import os
import re
import subprocess
import sys

import pytest

from ms_highway.cli import irl, options
from ms_highway.cli.main import build_parser, main
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


def test_help_texts_wrap_to_the_terminal_and_lose_no_word(monkeypatch):
    texts = {}
    for width in (80, 100):
        monkeypatch.setenv("COLUMNS", str(width))
        for name, parser in build_parser().names.items():
            text = re.search(r"\n\n(.*?)(\nexamples?:\n|$)", parser.format_help(), re.DOTALL)[1]
            assert max(map(len, text.splitlines())) <= width, name
            texts.setdefault(name, set()).add("".join(text.split()))
    assert not [name for name, different in texts.items() if len(different) > 1]


@pytest.mark.parametrize(("word", "commands"), [("irl", COMMANDS[-3:]), ("values", ["values learn"])])
def test_a_word_that_commands_begin_with_lists_them(word, commands, capsys, refused):
    with pytest.raises(SystemExit, match="0"):
        main([word, "--help"])
    rows = capsys.readouterr().out.splitlines()
    assert sorted(row[2:26].strip() for row in rows if row.startswith(f"  {word}")) == sorted(commands)
    for command in (word, f"{word} others"):
        assert f"{word} is no command; name one of {commands[0]}" in refused(command)


def test_the_names_in_help_texts_are_those_that_are_known():
    assert tuple(ENVIRONMENTS) == options.SCENARIO_NAMES
    assert tuple(DENSITIES) == irl.DENSITY_NAMES
    assert tuple(options.CONTROLLERS.split(", ")[: len(PAPER_MODELS)]) == tuple(PAPER_MODELS)


def test_the_keys_that_help_texts_explain_are_those_of_the_environments():
    known = {key for environment in ENVIRONMENTS.values() for key in environment.default_config()}
    keys = re.findall(r"\b([a-z]+(?:_[a-z]+)?)=[^=,\s]", options.KEYS)
    assert {"semantics", "horizon", "step_size", "costs", "way_out"} <= set(keys)
    assert set(keys) <= known | {"naive", "a", "b", "turn", "tom"}
