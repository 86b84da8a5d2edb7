"""What holds for every command: its help teaches and is there at once, and whatever is wrong is refused in one line."""

import os
import re
import subprocess
import sys
from contextlib import suppress

import pytest

from ms_highway.cli import irl, options
from ms_highway.cli.command import number, output
from ms_highway.cli.main import COMMANDS, main, parse
from ms_highway.envs import ENVIRONMENTS
from ms_highway.envs.demonstration import DENSITIES
from ms_highway.planning.human_models import PAPER_MODELS

LEAST = dict.fromkeys(COMMANDS, "") | {
    "sweep": " merger --out results",
    "video": " merger --out film.gif",
    "report": " results",
    "validate": " episodes",
    "values learn": " --out values.npz",
    "irl record": " --driver maxent --episodes 1 --dataset a/b-v0",
    "irl fit": " --data minari:none --out theta.json",
    "irl evaluate": " --data minari:none --folds 2",
}
"""The least that stands behind each command."""

OPTIONS = [(name, *option) for name, command in COMMANDS.items() for option in command.options]


def made_by(maker):
    """Commands, their options that are made by a function, and how their values are called."""
    kinds = [getattr(more.get("type"), "__qualname__", "") for *_, more, _ in OPTIONS]
    return [
        (name, option, more.get("metavar"))
        for (name, option, more, _), kind in zip(OPTIONS, kinds, strict=True)
        if kind.startswith(f"{maker.__name__}.")
    ]


CHECKED = [each[:2] for each in made_by(number)] + [each[:2] for each in OPTIONS if "choices" in each[2]]


HELP = """
import sys
sys.argv[0] = "ms-highway"
from ms_highway.cli.main import COMMANDS, main
for command in ([], *(name.split() for name in COMMANDS)):
    try:
        main([*command, "--help"])
    except SystemExit as ended:
        assert ended.code == 0
print(f"loaded: {sorted({'highway_env', 'jax', 'matplotlib', 'pandas', 'rich', 'scipy'} & set(sys.modules))}")
"""


def test_help_teaches_every_command_and_loads_neither_jax_nor_highway_env_nor_what_draws():
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


@pytest.mark.parametrize("name", COMMANDS)
def test_an_unknown_option_is_refused_with_a_remedy(name, refused):
    message = refused(f"{name}{LEAST[name]} --no-such-option")
    assert message.startswith("ms-highway: unrecognized arguments: --no-such-option; see the --help of the command")


@pytest.mark.parametrize(("name", "option"), CHECKED)
def test_a_wrong_value_is_refused_with_what_is_right(name, option, refused):
    message = refused(f"{name}{LEAST[name]} {option} nonsense")
    assert message.startswith(f"ms-highway: argument {option}: ")
    assert "'nonsense'" in message
    assert re.search(r"number from \S+ to \S+;|choose from ", message)


@pytest.mark.parametrize(("name", "option", "kind"), made_by(output))
def test_a_place_that_cannot_be_written_is_named_before_anything_is_driven_or_read(
    name, option, kind, tmp_path, refused
):
    (tmp_path / "file").touch()
    places = [("/proc/x/y", "No such file or directory"), ("file/results", "Not a directory")]
    places += [("file", "it is no directory")] if kind == "DIR" else [(".", "it is a directory or a device")]
    for place, problem in places:
        message = refused(f"{name}{LEAST[name]} {option} {place}")
        assert message.startswith(f"ms-highway: {place} cannot be written: {problem}; ")


def test_the_names_in_help_texts_are_those_that_are_known():
    assert tuple(ENVIRONMENTS) == options.SCENARIO_NAMES
    assert tuple(DENSITIES) == irl.DENSITY_NAMES
    assert tuple(options.CONTROLLERS.split(", ")[: len(PAPER_MODELS)]) == tuple(PAPER_MODELS)
    known = {key for environment in ENVIRONMENTS.values() for key in environment.default_config()}
    keys = set(re.findall(r"\b([a-z]+(?:_[a-z]+)?)=[^=,\s]", options.KEYS))
    assert {"semantics", "horizon", "step_size", "costs", "way_out"} <= keys
    assert keys <= known | {"naive", "a", "b", "turn", "tom"}
