"""The examples run, each as a program of its own, and print what they say."""

import re
import subprocess
import sys
from pathlib import Path
from textwrap import indent

import pytest

DIRECTORY = Path(__file__).parents[2] / "notebooks" / "examples"
EXAMPLES = sorted(path for path in DIRECTORY.glob("*.py") if path.stem != "learn_to_choose")  # which needs an extra

PROGRAM = """
import runpy, sys
import ms_highway
ms_highway.keep_compilations()
for example in sys.argv[1:]:
    runpy.run_path(example, run_name="__main__")
    print("----")
"""

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def printed(tmp_path_factory):
    """What each example prints, by name; all run in one process and one directory."""
    directory = tmp_path_factory.mktemp("examples")
    command = [sys.executable, "-c", PROGRAM, *map(str, EXAMPLES)]
    run = subprocess.run(command, capture_output=True, text=True, cwd=directory)
    assert run.returncode == 0, run.stderr
    return dict(zip([path.stem for path in EXAMPLES], run.stdout.split("----\n")[:-1], strict=True))


def test_every_example_runs_and_prints_something(printed):
    assert {"brief", "drive", "feature", "humans_in_highway", "plan", "rule", "work_zone", "zipper"} <= set(printed)
    assert all(printed.values())


def test_the_robot_of_the_first_example_drives_an_episode_and_tells_its_model(printed):
    steps = printed["drive"].splitlines()
    assert len(steps) == 40
    assert {step.split()[0] for step in steps} == {"naive", "turn", "tom"}


def test_the_robot_in_a_scene_of_ones_own_cuts_in_with_the_models_that_the_text_names(printed):
    output = printed["work_zone"]
    models = [model for model in re.findall(r"'(\w+)'", output) if model != "naive"]
    text = " ".join((DIRECTORY / "work_zone.py").read_text().split())
    assert f"``{'``, ``'.join(models)}``." in text
    assert output.strip().endswith("False")  # no crash


@pytest.mark.parametrize("name", ["zipper", "brief"])
def test_what_an_example_of_comparing_prints_is_what_its_text_says(printed, name):
    table = "\n".join(printed[name].splitlines()[1:])
    assert f"Prints::\n\n{indent(table, '    ')}\n" in (DIRECTORY / f"{name}.py").read_text()


def test_the_robot_plans_another_control_under_each_model(printed):
    plans = re.findall(r"^(\w+) +robot (\[.*?\])", printed["plan"], re.MULTILINE)
    assert [model for model, _ in plans] == ["naive", "turn", "tom"]
    assert len({control for _, control in plans}) == 3


def test_a_rule_of_ones_own_opens_the_gap_with_theory_of_mind_in_some_steps_only(printed):
    reward, used, steps = re.findall(r"[\d.]+", printed["rule"])
    assert float(reward) > 5
    assert 0 < int(used) < int(steps) / 2


def test_humans_drive_in_a_stock_environment(printed):
    assert printed["humans_in_highway"].count("HumanVehicle") == 5


def test_the_robot_drives_a_stock_scene_within_the_acceleration_that_the_example_asks_for(printed):
    largest = re.findall(r"at most ([\d.]+) m/s\^2", printed["stock_road"])
    assert len(largest) == 5
    assert max(map(float, largest)) <= 4.0


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_an_example_imports_the_package_by_one_line_beside_experiments(path):
    lines = re.findall(r"^(?:from|import) ms_highway\b(?!\.experiments).*", path.read_text(), re.MULTILINE)
    assert len(lines) <= 1


def test_an_agent_learns_to_choose_and_is_told_beside_switching_and_tom():
    pytest.importorskip("stable_baselines3", reason='needs it: pip install stable-baselines3')
    command = [sys.executable, str(DIRECTORY / "learn_to_choose.py"), "merger", "--steps", "450", "--episodes", "1"]
    run = subprocess.run(command, check=True, capture_output=True, text=True)
    title, _, *rows = run.stdout.splitlines()
    assert title == "merger, 1 episodes, a second of planning costs 3"
    table = {row[:16].strip(): [float(cell) for cell in row[16:].split()] for row in rows}
    assert list(table) == ["switching:0.1", "tom", "dqn, seed 0"]
    assert table["tom"][1] == 370
    for reward, milliseconds, net in table.values():
        assert 90 <= milliseconds <= 370
        assert net == pytest.approx(reward - 3 * milliseconds / 1e3, abs=0.02)
