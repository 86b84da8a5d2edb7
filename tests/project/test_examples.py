"""The examples run and print what their texts say."""

import json
import re
import subprocess
import sys
from pathlib import Path
from textwrap import indent

import pytest

DIRECTORY = Path(__file__).parents[2] / "notebooks" / "examples"
LEARNING, TRAINING = AGENTS = "learn_to_choose", "train_peers"  # which need stable-baselines3
LONG = "train_in_jax"
EXAMPLES = {path.stem: path.read_text() for path in sorted(DIRECTORY.glob("*.py"))}

PROGRAM = """
import runpy, sys
import ms_highway
ms_highway.keep_compilations()
for example in sys.argv[1:]:
    runpy.run_path(example, run_name="__main__")
    print("----")
"""


def output(example, words):
    """Run an example with these words on its command line; return what it prints."""
    command = [sys.executable, str(DIRECTORY / f"{example}.py"), *words.split(" ")]
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout


@pytest.fixture(scope="module")
def printed(tmp_path_factory):
    """Return what each example prints, by name. All run in another process, as they add to the package's registries."""
    names = [name for name in EXAMPLES if name not in (*AGENTS, LONG)]
    command = [sys.executable, "-c", PROGRAM, *(str(DIRECTORY / f"{name}.py") for name in names)]
    run = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path_factory.mktemp("examples"))
    assert run.returncode == 0, run.stderr
    return dict(zip(names, run.stdout.split("----\n")[:-1], strict=True))


@pytest.mark.slow
def test_every_example_runs_and_prints_what_its_text_says(printed):
    assert all(printed.values())
    for name, output in printed.items():
        if "Prints::" in EXAMPLES[name]:
            table = "\n".join(output.splitlines()[1:])
            assert f"Prints::\n\n{indent(table, '    ')}\n" in EXAMPLES[name]
    assert {*re.findall(r"'(\w+)'", printed["work_zone"])} == {"naive"}
    assert printed["work_zone"].strip().endswith("False")  # nobody has crashed


@pytest.mark.slow
@pytest.mark.parametrize("scenario", ["merger-v1", "dense_merge --set humans=2 --set duration=1"])
def test_an_agent_learns_in_jax_and_is_compared_with_random_choice_learned_values_and_naive(scenario):
    lines = output(LONG, f"{scenario} --updates 1 --environments 8").splitlines()[1:]
    assert [line.split()[0] for line in lines] == ["agent", "random", "learned:1", "naive"]


@pytest.mark.slow
def test_an_agent_learns_to_choose_and_is_compared_with_random_choice_naive_and_learned_values(tmp_path):
    pytest.importorskip("stable_baselines3", reason="needs it: pip install stable-baselines3")
    agent = str(tmp_path / "agent.zip")
    table = output(LEARNING, f"merger-v1 --steps 800 --episodes 1 --out {agent}")
    lines = table.partition("reward per step less that")[2].splitlines()[1:]
    assert [line.split()[0] for line in lines] == [agent, "random", "naive", "learned"]


@pytest.mark.slow
def test_trained_peers_drive_in_their_own_scene_and_are_refused_in_others(tmp_path):
    pytest.importorskip("stable_baselines3", reason="needs it: pip install stable-baselines3")
    output(TRAINING, f"merge-v0 --steps 300 --to {tmp_path}")
    agents = [str(tmp_path / f"{algorithm}-merge-v0-0.zip") for algorithm in ("dqn", "ppo")]
    bench = [sys.executable, "-m", "ms_highway", "bench", "road"]
    figures = tmp_path / "road.json"
    subprocess.run([*bench, "merge-v0", "--drivers", *agents, "--seeds", "1", "--json", str(figures)], check=True)
    assert list(json.loads(figures.read_text())["merge-v0"]) == agents
    refused = subprocess.run([*bench, "intersection-v0", "--drivers", agents[0]], capture_output=True, text=True)
    assert refused.returncode == 2
    assert "the agent's observation space is Box" in refused.stderr
