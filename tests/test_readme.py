"""The README keeps what it says."""

import re
import shlex
import subprocess
import sys
from pathlib import Path

import pandas as pd
import pytest
from markdown_it import MarkdownIt

from ms_highway.cli import _parser
from ms_highway.experiment import SETTINGS_FILE, read_settings
from ms_highway.markdown import markdown_table
from ms_highway.provenance import read_runs
from ms_highway.results import Results

ROOT = Path(__file__).parents[1]
TEXT = (ROOT / "README.md").read_text()
FENCES = [(token.info, token.content) for token in MarkdownIt().parse(TEXT) if token.type == "fence"]
EXAMPLES = [content for language, content in FENCES if language == "python"]
COMMANDS = [
    shlex.split(line.partition(" > ")[0])[1:]
    for language, content in FENCES
    if language == "sh"
    for line in content.replace("\\\n", " ").splitlines()
    if line.startswith("ms-highway ")
]


@pytest.fixture(scope="module")
def printed(tmp_path_factory):
    """What the examples print, each run as a program of its own, in one process and directory."""
    program = (
        "import sys\nfor example in sys.argv[1:]:\n    exec(example, {'__name__': '__main__'})\n    print('----')\n"
    )
    directory = tmp_path_factory.mktemp("readme")
    run = subprocess.run([sys.executable, "-c", program, *EXAMPLES], capture_output=True, text=True, cwd=directory)
    assert run.returncode == 0, run.stderr
    return run.stdout.split("----\n")[:-1]


def test_every_example_runs(printed):
    assert len(printed) == len(EXAMPLES) >= 6


def test_the_robot_of_the_first_example_drives_an_episode_and_tells_its_model(printed):
    steps = printed[0].splitlines()
    assert len(steps) == 40
    assert {step.split()[0] for step in steps} == {"naive", "turn", "tom"}


def example(printed, word):
    """What the example prints that has a word in it."""
    (output,) = (output for output, text in zip(printed, EXAMPLES, strict=True) if word in text)
    return output


def test_the_robot_in_a_scene_of_ones_own_cuts_in_with_the_models_that_the_text_names(printed):
    output = example(printed, "class WorkZoneEnv")
    models = re.findall(r"'(\w+)'", output)
    assert f"`{'`, `'.join(model for model in models if model != 'naive')}`" in TEXT
    assert output.strip().endswith("False")  # no crash


@pytest.mark.parametrize("word", ["class ZipperEnv", "class BriefTheoryOfMind"])
def test_what_an_example_of_comparing_prints_is_what_stands_below_it(printed, word):
    table = "\n".join(example(printed, word).splitlines()[1:])
    assert f"```text\n{table}\n```" in TEXT


@pytest.mark.parametrize("command", COMMANDS, ids=" ".join)
def test_every_command_is_one(command):
    assert callable(_parser().parse_args(command).run)


@pytest.mark.parametrize("place", re.findall(r"\]\((?!http)([^)#]+)\)", TEXT))
def test_every_link_leads_somewhere(place):
    assert (ROOT / place).is_file()


def kept(name):
    """Results whose summary is kept with the project."""
    directory = ROOT / "notebooks" / "results" / name
    summaries = pd.read_csv(directory / "summary.csv")
    return Results(directory, pd.DataFrame(), summaries, read_settings(directory / SETTINGS_FILE), read_runs(directory))


@pytest.mark.parametrize("names", [("compare", "released"), ("compare", "published")])
def test_tables_of_results_are_those_of_the_summaries_they_come_from(names):
    results = [kept(name) for name in names]
    assert markdown_table(results) in TEXT
    assert all(result.runs for result in results)
