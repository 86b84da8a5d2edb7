"""Learning values of computation: `ms-highway values`."""

from dataclasses import replace
from itertools import islice

import jax
import numpy as np
import pytest

from ms_highway.cli.main import main
from ms_highway.envs.merger import MERGER
from ms_highway.experiments.values.course import Course, noisy_starts
from ms_highway.experiments.values.generator import draw_scenario
from ms_highway.experiments.values.learning import Learning, learn
from ms_highway.experiments.values.rollouts import Rollouts
from ms_highway.game.scenario import build_game, draw_starts
from ms_highway.metareasoning.values import load_values
from ms_highway.simulation.devices import device_mesh

QUICK = ["values", "learn", "merger", "--ladder", "naive", "turn", "--states", "8", "--rounds", "2", "--out"]
COURSE = Course("merger", build_game(MERGER), lambda random: draw_starts(MERGER, random), 40, (0, 1))
LEARNING = Learning({"naive": 0.09, "turn": 0.17}, rounds=2, states=(8, 5), seed=3)


def same(one, other):
    pairs = zip(jax.tree.leaves(one.network), jax.tree.leaves(other.network), strict=True)
    return all(np.array_equal(first, second) for first, second in pairs)


@pytest.fixture(scope="module")
def progress(tmp_path_factory):
    kept = tmp_path_factory.mktemp("values") / "kept.npz"
    return kept, list(learn(LEARNING, [COURSE], kept, device_mesh()))


def test_each_round_ends_in_values_and_their_held_out_regret(progress):
    _, done = progress
    assert [(step.round, step.course) for step in done] == [(1, "merger"), (1, ""), (2, "merger"), (2, "")]
    for step in done[1::2]:
        assert step.values is not None
        assert step.regrets["merger"] >= 0


def test_learning_goes_on_where_it_was_killed_and_gives_the_same_values(progress, tmp_path):
    _, done = progress
    kept = tmp_path / "kept.npz"
    list(islice(learn(LEARNING, [COURSE], kept, device_mesh()), 2))  # a round, and then the end
    with np.load(kept) as archive:
        assert {name.split("/")[0] for name in archive.files} == {"about", "1"}
    before = kept.read_bytes()
    resumed = list(learn(LEARNING, [COURSE], kept, device_mesh()))
    assert kept.read_bytes() != before
    assert same(resumed[-1].values, done[-1].values)


def test_another_seed_gives_other_values(progress):
    _, done = progress
    other = Learning(LEARNING.costs, rounds=1, states=(8, 5), seed=4)
    *_, last = learn(other, [COURSE], None, device_mesh())
    assert not same(last.values, done[1].values)


def test_rollouts_of_other_settings_are_not_gone_on_with(progress):
    kept, _ = progress
    other = Learning(LEARNING.costs, rounds=2, states=(9, 5), seed=3)
    with pytest.raises(ValueError, match=r"kept.npz cannot be resumed \(it holds rollouts of other settings\)"):
        next(learn(other, [COURSE], kept, device_mesh()))
    moved = replace(COURSE, game=replace(COURSE.game, robot=replace(COURSE.game.robot, speed_limit=np.float32(25.0))))
    with pytest.raises(ValueError, match="it holds rollouts of other settings"):
        next(learn(LEARNING, [moved], kept, device_mesh()))


def test_the_best_way_to_go_on_depends_on_the_price():
    rollouts = Rollouts(np.zeros((1, 1)), np.array([[[1.0, 2.0]]]), np.array([[[0.0, 1.0]]]))
    assert rollouts.best(np.array([0.5]))[0, 0] == 1.5
    assert rollouts.best(np.array([3.0]))[0, 0] == 1.0


def test_starts_are_noisier_than_those_of_the_scenario_around_the_same_mean():
    random = np.random.default_rng(0)
    own = np.array([COURSE.draw(random) for _ in range(400)])
    noisy = noisy_starts(COURSE, random, 400)
    np.testing.assert_allclose(noisy.mean(axis=0), own.mean(axis=0), atol=0.3)
    ratio = noisy.std(axis=0) / own.std(axis=0)
    assert (ratio > 2).all()
    assert (ratio < 5).all()


def test_generated_scenes_begin_without_a_collision_and_share_their_shapes():
    random = np.random.default_rng(0)
    games = [build_game(draw_scenario(random)) for _ in range(50)]
    assert len({tuple(np.shape(leaf) for leaf in jax.tree.leaves(game)) for game in games}) == 1
    for _ in range(50):
        scenario = draw_scenario(random)
        for place, (x, y) in enumerate(scenario.cars):
            assert y in scenario.lanes
            assert all(abs(x - other) > 0.15 for other, lane in scenario.cars[:place] if lane == y)


def test_the_command_learns_values_that_drive_and_shows_them(tmp_path, capsys):
    file = tmp_path / "values.npz"
    assert main([*QUICK, str(file)]) == 0
    told = capsys.readouterr().out
    assert told.count("held-out regret per step: merger 0.") == 2
    assert [path.name for path in tmp_path.iterdir()] == ["values.npz"]
    assert list(load_values(file).costs) == ["naive", "turn"]
    assert main(["values", "show", str(file)]) == 0
    assert "naive 0.09 s, turn 0.17 s" in capsys.readouterr().out
    out = tmp_path / "frontier.csv"
    controllers = ["--ladder", "naive", "turn", "--controllers", f"learned:0.1:{file}", "naive", "--seeds", "1"]
    assert main(["compare", "merger", *controllers, "--out", str(out)]) == 0


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["merger", "--out", "values.txt"], "ends in .npz"),
        (["merger", "--out", "missing/values.npz"], "in a directory that exists"),
        (["murger", "--out", "values.npz"], "unknown scenario 'murger'"),
        (["merger", "--ladder", "best", "--out", "values.npz"], "leave +warm out"),
        (["merger", "--horizon-steps", "0", "--out", "values.npz"], "--horizon-steps is 0"),
        (["merger", "--rounds", "0", "--out", "values.npz"], "--rounds is 0"),
        (["merger", "--costs", "naive=0.1", "--out", "values.npz"], "turn"),
    ],
)
def test_what_cannot_be_learned_is_refused_before_anything_is_written(tmp_path, monkeypatch, capsys, arguments, told):
    monkeypatch.chdir(tmp_path)
    assert main(["values", "learn", *arguments]) == 2
    assert told in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
