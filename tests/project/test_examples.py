"""The examples run and print what their texts say."""

import json
import re
from textwrap import indent

import pytest
from commands import python
from test_pages import EXAMPLES, PAGES

ALONE = LEARNING, PEERS, IN_JAX = "learn_to_choose", "train_peers", "train_in_jax"

PROGRAM = """
import runpy, sys
import ms_highway
ms_highway.keep_compilations()
for example in sys.argv[1:]:
    runpy.run_path(example, run_name="__main__")
    print("----")
"""

pytestmark = pytest.mark.slow


def place(example):
    return str(PAGES / "examples" / f"{example}.py")


@pytest.fixture(scope="module")
def printed(tmp_path_factory):
    """Return what each example prints, by name. All run in another process, as they add
    to the package's registries.
    """
    names = [name for name in EXAMPLES if name not in ALONE]
    done = python(
        "-c", PROGRAM, *map(place, names), cwd=tmp_path_factory.mktemp("examples")
    )
    return dict(zip(names, done.stdout.split("----\n")[:-1], strict=True))


def test_every_example_runs_and_prints_what_its_text_says(printed):
    assert all(printed.values())
    for name, text in printed.items():
        if "Prints::" in EXAMPLES[name]:
            table = text.partition("\n")[2].rstrip("\n")
            assert f"Prints::\n\n{indent(table, '    ')}\n" in EXAMPLES[name]
    models = re.findall(r"'(\w+)'", printed["work_zone"])
    assert models.count("naive") > 0.8 * len(models) > models.count("tom") > 0
    assert printed["work_zone"].strip().endswith("False")  # nobody has crashed


@pytest.mark.parametrize(
    "scenario", ["merger-v1", "dense_merge --set humans=2 --set duration=1"]
)
def test_an_agent_learns_in_jax_and_is_compared_with_others(
    scenario,
):
    _, *lines = python(
        place(IN_JAX), *f"{scenario} --updates 1 --environments 8".split()
    ).stdout.splitlines()
    assert [line.split()[0] for line in lines] == [
        "agent",
        "random",
        "learned:1",
        "naive",
    ]


def test_an_agent_learns_to_choose_and_is_compared_with_others(
    tmp_path,
):
    pytest.importorskip(
        "stable_baselines3", reason="needs it: pip install stable-baselines3"
    )
    agent = tmp_path / "agent.zip"
    words = (
        "merger-v1 --set costs=published --price 10 --environments 8 --steps 320"
        f" --episodes 2 --out {agent}"
    )
    done = python(place(LEARNING), *words.split())
    _, _, *lines = done.stdout.partition("a second costs 10")[2].splitlines()
    names = ["agent", "random", "naive", "turn", "tom", "learned:10"]
    assert [line.split()[0] for line in lines] == names
    reward, net = (float(cell) for cell in lines[names.index("tom")].split()[1:3])
    assert net == pytest.approx(
        reward - 10 * 0.37, abs=0.011
    )  # the published time of a plan, in every step
    assert agent.is_file()


def test_trained_peers_drive_only_in_their_own_scene(tmp_path):
    pytest.importorskip(
        "stable_baselines3", reason="needs it: pip install stable-baselines3"
    )
    python(place(PEERS), *f"merge-v0 --steps 300 --to {tmp_path}".split())
    agents = [
        str(tmp_path / f"{algorithm}-merge-v0-0.zip") for algorithm in ("dqn", "ppo")
    ]
    bench = "-m ms_highway bench road"
    figures = tmp_path / "road.json"
    python(*f"{bench} merge-v0 --seeds 1 --json {figures} --drivers".split(), *agents)
    assert list(json.loads(figures.read_text())["merge-v0"]) == agents
    refused = python(
        *f"{bench} intersection-v0 --drivers {agents[0]}".split(), status=2
    )
    assert "the agent's observation space is Box" in refused.stderr
