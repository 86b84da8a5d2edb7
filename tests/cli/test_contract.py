"""What holds for every command: its help teaches and loads fast."""

import os
import re
from contextlib import suppress

import pytest
from commands import python

from ms_highway.cli import irl, options
from ms_highway.cli.main import COMMANDS, main, parse
from ms_highway.envs import ENVIRONMENTS
from ms_highway.envs.demonstration import DENSITIES
from ms_highway.planning.ladders import PAPER_MODELS
from ms_highway.runtime.names import SCENARIO_NAMES

HELP = """
import sys
sys.argv[0] = "ms-highway"
from ms_highway.cli.main import COMMANDS, main
for command in ([], *(name.split() for name in COMMANDS)):
    try:
        main([*command, "--help"])
    except SystemExit as ended:
        assert ended.code == 0
heavy = {"highway_env", "jax", "matplotlib", "pandas", "scipy"}
print(f"loaded: {sorted(heavy & set(sys.modules))}")
"""

ASCII = (
    {"PYTHONIOENCODING": "ascii"},
    {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"},
)
"""Environments of the process, each with an ASCII standard output."""


def test_help_of_every_command_loads_no_package_that_computes():
    wide = {**os.environ, "COLUMNS": "300"}
    output = python("-c", HELP, env=wide).stdout
    before, *texts = output.split("usage: ms-highway")
    assert (before, len(texts)) == ("", 1 + len(COMMANDS))
    assert min(map(len, texts)) > 250
    assert max(map(len, output.splitlines())) <= 120
    assert output.endswith("loaded: []\n")


@pytest.mark.parametrize("ascii_only", ASCII, ids=" ".join)
def test_help_of_every_command_prints_in_ascii(ascii_only):
    output = python("-c", HELP, env={**os.environ, **ascii_only}).stdout
    assert output.count("usage: ms-highway") == 1 + len(COMMANDS)
    # A question mark stands for ².
    assert "m/s? is the largest acceleration" in " ".join(output.split())
    assert output.isascii()


@pytest.mark.parametrize("name", COMMANDS)
def test_help_fits_the_terminal_and_its_examples_parse(name, monkeypatch, capsys):
    """No word is lost at any width."""
    texts = set()
    for width in (60, 80, 100):
        monkeypatch.setenv("COLUMNS", str(width))
        with suppress(SystemExit):
            main([*name.split(), "--help"])
        text, _, examples = capsys.readouterr().out.partition("\nexamples:\n")
        _, _, told = text.partition("\n\n")
        assert max(map(len, told.splitlines())) <= width
        texts.add(re.sub(r"\s", "", told))
    assert len(texts) == 1
    lines = examples.replace("\\\n", "").splitlines()
    commands = [line.split()[1:] for line in lines if line.startswith("  ms-highway")]
    assert commands
    monkeypatch.chdir("/tmp")
    assert name in {parse(words).command.name for words in commands}


def test_help_texts_name_what_the_package_has():
    assert tuple(ENVIRONMENTS) == SCENARIO_NAMES
    assert tuple(DENSITIES) == irl.DENSITY_NAMES
    controllers = options.CONTROLLER_NAMES.split(", ")
    assert controllers[: len(PAPER_MODELS)] == list(PAPER_MODELS)
    known = set()
    for environment in ENVIRONMENTS.values():
        known |= set(environment.default_config())
    keys = set(re.findall(r"\b([a-z]+(?:_[a-z]+)?)=[^=,\s]", options.SET_NOTES))
    assert {"semantics", "horizon", "step_size", "costs", "way_out"} <= keys
    assert keys <= known | {"naive", "a", "b", "turn", "tom"}
