"""Learning values of computation per human: `ms-highway values learn dense_merge`."""

from dataclasses import replace
from functools import partial
from itertools import islice

import jax
import numpy as np
import pytest

from ms_highway.cli.main import main
from ms_highway.experiments.values.crowd import CrowdCourse, CrowdLearning, learn_crowd
from ms_highway.game.crowd_scenario import DENSE_MERGE, crowd_game, draw_crowd
from ms_highway.game.planning_settings import PlanningSettings
from ms_highway.metareasoning.crowd.rule import CrowdCosts
from ms_highway.metareasoning.crowd.values import load_crowd_values
from ms_highway.simulation.devices import device_mesh, use_devices

HUMANS = 2
CROWD = crowd_game(DENSE_MERGE, HUMANS, planning=PlanningSettings(horizon=5))
COURSE = CrowdCourse("dense_merge", CROWD, partial(draw_crowd, DENSE_MERGE, HUMANS, driver=CROWD.game.human), 6)
COSTS = CrowdCosts(0.003, np.array([0.0, 0.0006, 0.002], np.float32))
LEARNING = CrowdLearning(COSTS, rounds=2, states=6, horizon=5, seed=1)
QUICK = ["--humans", "2", "--horizon", "5", "--states", "6", "--rounds", "1", "--horizon-steps", "5", "--seed", "1"]


def same(one, other):
    pairs = zip(jax.tree.leaves(one.network), jax.tree.leaves(other.network), strict=True)
    return all(np.array_equal(first, second) for first, second in pairs)


@pytest.fixture(scope="module")
def learned():
    return list(learn_crowd(LEARNING, [COURSE], None, device_mesh(jax.local_devices()[:1])))


@pytest.mark.slow
def test_each_round_ends_in_values_of_all_examples_so_far(learned):
    assert [(step.round, step.course) for step in learned] == [(1, "dense_merge"), (1, ""), (2, "dense_merge"), (2, "")]
    assert [step.values.provenance["examples"] for step in learned[1::2]] == [12, 24]  # two humans in each state


@pytest.mark.slow
def test_learning_goes_on_where_it_was_killed_and_gives_the_same_values_on_any_devices(learned, tmp_path):
    kept = tmp_path / "kept.npz"
    list(islice(learn_crowd(LEARNING, [COURSE], kept, use_devices()), 1))
    *_, last = learn_crowd(LEARNING, [COURSE], kept, use_devices())
    assert same(last.values, learned[-1].values)
    with pytest.raises(ValueError, match="other settings"):
        next(learn_crowd(replace(LEARNING, seed=2), [COURSE], kept, use_devices()))


@pytest.mark.slow
def test_another_seed_gives_other_values(learned):
    *_, last = learn_crowd(replace(LEARNING, rounds=1, seed=4), [COURSE], None, device_mesh())
    assert not same(last.values, learned[1].values)


@pytest.mark.slow
def test_the_command_writes_a_file_of_values_and_says_where(tmp_path, capsys):
    file = tmp_path / "values.npz"
    assert main(["values", "learn", "dense_merge", *QUICK, "--out", str(file)]) == 0
    assert f"values per human are in {file}" in capsys.readouterr().out
    values = load_crowd_values(file)
    assert values.provenance["scenarios"] == ["dense_merge"]
    assert list(tmp_path.iterdir()) == [file]
    assert main(["values", "show", str(file)]) == 0
    assert "each of several humans" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "message"),
    [(["dense_merge", "merger"], "merger has one human"), (["dense_merge", "--ladder", "naive", "tom"], "--ladder")],
)
def test_what_cannot_be_learned_together_is_refused(arguments, message, tmp_path, capsys):
    assert main(["values", "learn", *arguments, "--out", str(tmp_path / "values.npz")]) == 2
    assert message in capsys.readouterr().err
