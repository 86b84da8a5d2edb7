"""Collisions under limits on plans, counted and told."""

import json
from dataclasses import replace

import jax
import pandas as pd
import pytest
from jax import numpy as jnp

from ms_highway.cli.main import main
from ms_highway.experiments.comparison import Comparison
from ms_highway.experiments.provenance import read_runs
from ms_highway.experiments.runner import episode, make_environment
from ms_highway.experiments.safety import Safety, read_safety, safety_cells, safety_sentences
from ms_highway.experiments.simulated import make_batch

ROAD = [0.2, 9.0]  # 1/m, m/s^2: what tyres hold
COUNT = ["safety", "merger", "--controllers", "tom", "--limits", "default", "0.2,9", "--episodes", "8"]


@pytest.fixture(scope="module")
def counted(tmp_path_factory):
    directory = tmp_path_factory.mktemp("safety")
    assert main([*COUNT, "--devices", "1", "--out", str(directory)]) == 0
    return directory


def test_collisions_are_counted_by_limit_and_kept_with_what_made_them(counted):
    table = pd.read_csv(counted / "safety.csv")
    assert table[["omega", "acceleration"]].to_numpy().tolist() == [[0.2, 50], ROAD]
    assert table["episodes"].tolist() == [8, 8]
    usual, road = table["collision_episodes"]
    assert usual == 0 < road
    assert table["reward"][0] > table["reward"][1]
    assert json.loads((counted / "settings.json").read_text())["limits"] == [None, ROAD]
    (run,) = read_runs(counted)
    assert run["command"].startswith("ms-highway safety merger")


def test_the_environments_collide_in_the_episodes_that_were_counted(counted):
    env = make_environment("merger", "tom", control_limit=ROAD)
    collided = [any(record["collision"] for record in episode(env, seed)) for seed in range(8)]
    assert sum(collided) == read_safety(counted).table["collision_episodes"][1]


@pytest.mark.parametrize("semantics", ["paper", "released"])
def test_a_limit_is_a_number_that_the_program_is_given_so_that_one_serves_all(semantics):
    comparison = Comparison({"merger": ["naive"]}, semantics=semantics)
    limits = [None, ROAD, "unlimited"]
    loops = [make_batch(replace(comparison, planning={"control_limit": limit}), "merger").loop for limit in limits]
    usual, road, unlimited = (loop.game.planner.control_limit.tolist() for loop in loops)
    assert usual == (pytest.approx([0.2, 50.0]) if semantics == "paper" else unlimited)
    assert road == pytest.approx(ROAD)
    assert jax.tree.structure(loops[0]) == jax.tree.structure(loops[1]) == jax.tree.structure(loops[2])
    assert len({str(jax.tree.map(jax.typeof, jax.tree.map(jnp.asarray, loop))) for loop in loops}) == 1


def told(tmp_path, *rows, semantics="paper"):
    """What is said of rows of scenario, controller, acceleration, and episodes with a collision, of 300."""
    table = pd.DataFrame(rows, columns=["scenario", "controller", "acceleration", "collision_episodes"])
    return Safety(tmp_path, table.assign(omega=0.2, episodes=300), {"semantics": semantics}, [])


def test_who_collides_is_told_by_limit_and_what_none_in_many_episodes_leaves_open(tmp_path):
    rows = [("merger", "naive", 50.0, 0), ("merger", "tom", 50.0, 0), ("merger", "naive", 9.0, 0)]
    rows += [("merger", "tom", 9.0, 127), ("stay_back", "naive", 9.0, 300), ("stay_back", "turn", 9.0, 299)]
    safety = told(tmp_path, *rows)
    assert safety_sentences(safety) == [
        "Within 0.2 1/m and 50 m/s², no controller collides.",
        "Within 0.2 1/m and 9 m/s², episodes with a collision are in Merger 127 of 300 with tom; in Stay Back 300 of "
        "300 with naive and 299 with turn.",
        "None in 300 leaves open that up to 1.0 % have one (90 % interval).",
    ]
    rows[-1] = ("stay_back", "turn", 9.0, 300)
    assert "in Stay Back 300 of 300 with every controller." in safety_sentences(told(tmp_path, *rows))[1]
    assert "0.2 rad/s and 9 m/s²" in safety_sentences(told(tmp_path, *rows, semantics="released"))[1]
    cells = safety_cells(safety).set_index(["scenario", "controller"])
    assert cells.loc[("merger", "tom")].tolist() == ["0 of 300", "127 of 300"]
    assert cells.loc[("stay_back", "turn")].tolist() == ["", "299 of 300"]


def test_what_was_counted_is_printed_in_markdown_and_needs_a_comparison_for_a_page(counted, capsys):
    assert main(["report", str(counted), "--markdown"]) == 0
    heading, _, row = capsys.readouterr().out.strip().splitlines()
    assert heading == "| scenario | controller | 0.2 1/m and 50 m/s² | 0.2 1/m and 9 m/s² |"
    assert row.startswith("| merger | tom | 0 of 8 | ")
    assert main(["report", str(counted)]) == 2
    assert "holds no comparison; name a directory that `ms-highway compare` wrote as well" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["zipper"], "unknown scenario 'zipper'"),
        (["--controllers", "oracle"], "unknown controller 'oracle'"),
        (["--limits", "0.2"], "config['control_limit'] is [0.2]"),
        (["--limits", "hard"], "--limits is 'hard'; give two numbers like 0.2,9, or unlimited"),
        (["--limits", "0.2,-9"], "two positive bounds"),
        (["--episodes", "0"], "--episodes is 0; it must be 1 or more"),
        (["--costs", "measured"], "a simulation cannot measure plans"),
    ],
)
def test_what_cannot_be_counted_is_refused_in_one_line_and_nothing_is_written(options, message, tmp_path, capsys):
    assert main(["safety", *options, "--out", str(tmp_path / "safety")]) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert message in line
    assert not (tmp_path / "safety").exists()


def test_a_directory_of_other_results_is_left_alone(counted, capsys):
    assert main([*COUNT, "--episodes", "9", "--out", str(counted)]) == 2
    assert "holds results with episodes 8 instead of 9" in capsys.readouterr().err
    assert read_safety(counted).table["episodes"].tolist() == [8, 8]


def test_files_that_are_none_of_this_command_are_refused(tmp_path):
    (tmp_path / "safety.csv").write_text("scenario,controller\n")
    with pytest.raises(ValueError, match=r"safety.csv cannot be read .*; name a directory that `ms-highway safety`"):
        read_safety(tmp_path)
