"""What holds for every command: its help teaches and loads fast, and wrong options are refused in one line."""

import os
import re
import subprocess
import sys
from contextlib import suppress

import pytest

from ms_highway.cli import irl, options
from ms_highway.cli.main import COMMANDS, main, parse
from ms_highway.envs import ENVIRONMENTS
from ms_highway.envs.demonstration import DENSITIES
from ms_highway.planning.ladders import PAPER_MODELS

HELP = """
import sys
sys.argv[0] = "ms-highway"
from ms_highway.cli.main import COMMANDS, main
for command in ([], *(name.split() for name in COMMANDS)):
    try:
        main([*command, "--help"])
    except SystemExit as ended:
        assert ended.code == 0
print(f"loaded: {sorted({'highway_env', 'jax', 'matplotlib', 'pandas', 'scipy'} & set(sys.modules))}")
"""


def test_help_describes_every_command_and_loads_no_package_that_computes_or_draws():
    wide = {**os.environ, "COLUMNS": "300"}
    run = subprocess.run([sys.executable, "-c", HELP], capture_output=True, text=True, check=True, env=wide)
    before, *texts = run.stdout.split("usage: ms-highway")
    assert (before, len(texts)) == ("", 1 + len(COMMANDS))
    assert min(map(len, texts)) > 250
    assert max(map(len, run.stdout.splitlines())) <= 120
    assert run.stdout.endswith("loaded: []\n")


@pytest.mark.parametrize("name", COMMANDS)
def test_help_fits_the_terminal_loses_no_word_and_its_examples_parse(name, monkeypatch, capsys):
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
    lines = [line.split()[1:] for line in examples.replace("\\\n", "").splitlines() if line.startswith("  ms-highway")]
    assert lines
    monkeypatch.chdir("/tmp")
    assert name in {parse(words).command.name for words in lines}


@pytest.mark.parametrize(
    ("command", "message"),
    [
        ("compare --no-such-option", "unrecognized arguments: --no-such-option; see the --help of the command"),
        ("sweep merger --out out --seeds 0", "argument --seeds: '0' is no whole number from 1 to 1,000,000"),
        ("video merger --out film.gif --speed fast", "argument --speed: 'fast' is no number from 0.01 to 100"),
        ("compare --format gif", "argument --format: invalid choice: 'gif' (choose from "),
        ("frontier --lambdas 3:1:1", "argument --lambdas: lambdas are '3:1:1'; give a number like 0.1, or LOW:HIGH"),
        ("compare --out /proc/x/y", "/proc/x/y cannot be written: No such file or directory; "),
        ("compare --out file", "file cannot be written: it is no directory; "),
        ("bench --json .", ". cannot be written: it is a directory or a device; "),
    ],
)
def test_a_wrong_option_is_refused_with_the_remedy_and_writes_nothing(command, message, tmp_path, refused):
    (tmp_path / "file").touch()
    assert refused(command).startswith(f"ms-highway: {message}")


def test_help_texts_name_what_the_package_has():
    assert tuple(ENVIRONMENTS) == options.SCENARIO_NAMES
    assert tuple(DENSITIES) == irl.DENSITY_NAMES
    assert tuple(options.CONTROLLERS.split(", ")[: len(PAPER_MODELS)]) == tuple(PAPER_MODELS)
    known = {key for environment in ENVIRONMENTS.values() for key in environment.default_config()}
    keys = set(re.findall(r"\b([a-z]+(?:_[a-z]+)?)=[^=,\s]", options.KEYS))
    assert {"semantics", "horizon", "step_size", "costs", "way_out"} <= keys
    assert keys <= known | {"naive", "a", "b", "turn", "tom"}
