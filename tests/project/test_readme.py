"""The README keeps what it says."""

import re
import subprocess
import sys
from pathlib import Path

import pandas as pd
import pytest
from markdown_it import MarkdownIt

from ms_highway.cli.compare import comparison
from ms_highway.cli.main import build_parser
from ms_highway.experiments.provenance import read_runs
from ms_highway.experiments.regret import BEST_PER_START
from ms_highway.experiments.results import Results
from ms_highway.experiments.safety import read_safety, safety_cells
from ms_highway.experiments.settings import SETTINGS_FILE, read_settings
from ms_highway.experiments.tradeoff import meta_rewards, shares
from ms_highway.visualization.overview import markdown, overview

ROOT = Path(__file__).parents[2]
TEXT = (ROOT / "README.md").read_text()
FENCES = [(token.info, token.content) for token in MarkdownIt().parse(TEXT) if token.type == "fence"]
EXAMPLES = [content for language, content in FENCES if language == "python"]
COMMANDS = [
    line
    for language, content in FENCES
    if language == "sh"
    for line in content.replace("\\\n", " ").splitlines()
    if line.strip().startswith("ms-highway ") and "$" not in line and "--import" not in line
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


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_is_one(command):
    """Expanded as bash does."""
    line = command.partition(" > ")[0]
    words = subprocess.run(["bash", "-c", f"printf '%s\\n' {line}"], capture_output=True, text=True, check=True).stdout
    options = build_parser().parse_args(words.splitlines()[1:])
    assert callable(options.run)
    if words.splitlines()[1] == "compare":
        assert comparison(options).controllers


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
    assert markdown(overview(results)) in TEXT
    assert all(result.runs for result in results)


@pytest.mark.parametrize(
    ("scenario", "controller"),
    [
        ("merger", "schedule:tom=7,naive"),
        ("give_way", "schedule:tom=10,naive"),
        ("merger", "switching:0.02"),
        ("merger", "switching:0.1"),
        ("merger", "switching:0.01"),
        ("give_way", "switching:0.002"),
        ("give_way", "switching:0.01"),
    ],
)
def test_shares_of_reward_and_planning_are_those_of_the_summary_they_come_from(scenario, controller):
    share = shares(kept("curve").summaries, scenario).loc[controller]
    assert f"{100 * share['reward']:.0f} % at {100 * share['computation']:.0f} %" in " ".join(TEXT.split())


def test_the_table_of_collisions_is_that_of_what_was_counted():
    safety = read_safety(ROOT / "notebooks" / "results" / "safety")
    assert markdown(safety_cells(safety)) in TEXT
    assert safety.runs
    counts = safety.table.set_index(["scenario", "controller", "acceleration"])["collision_episodes"]
    assert f"in {counts['merger', 'tom', 9.0]} of 300 episodes of Merger" in " ".join(TEXT.split())
    assert (counts[["merger", "give_way"]].xs(50.0, level="acceleration") == 0).all()
    assert (counts["stay_back"].xs(9.0, level="acceleration") == 300).all()


def test_always_tom_is_better_than_switching_by_the_meta_reward_as_the_text_says():
    for scenario in ("merger", "give_way"):
        table = meta_rewards(kept("curve").summaries, scenario)
        assert (table["tom"] > table["switching"]).all()
        assert [table.index.min(), table.index.max()] == [0.001, 3]


def test_regrets_are_those_of_the_results_they_come_from():
    behind = pd.read_csv(ROOT / "notebooks" / "results" / "frontier" / "regrets.csv").query("price == 1")
    switching = behind[behind["kind"] == "switching"].set_index(["controller", "scenario"])["regret"].unstack()
    common = switching.mean(axis=1).idxmin()
    for scenario, rows in behind.groupby("scenario"):
        own = rows.set_index("controller")
        best = own.loc[own["kind"].isin(["fixed", "schedule"]), "regret"].min()
        fixed = [f"{own['regret'][model]:.2f}" if model in own.index else "" for model in ("naive", "turn", "tom")]
        lambdas = [
            f"{own['regret'][name]:.2f} ({name.removeprefix('switching:')})"
            for name in (switching[scenario].idxmin(), common)
        ]
        cells = [scenario, f"{own.loc[BEST_PER_START, 'meta_reward']:.2f}", *fixed, f"{best:.2f}", *lambdas]
        assert f"| {' | '.join(cells)} |" in TEXT
