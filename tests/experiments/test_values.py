"""Learning values of computation, with one human and among several: `ms-highway values`."""

from dataclasses import replace
from itertools import islice

import jax
import numpy as np
import pytest
from commands import run

from ms_highway.choice.values import load_values
from ms_highway.experiments.batch import make_batch
from ms_highway.experiments.comparison import Comparison
from ms_highway.experiments.values.learning import Learning, learn, read_rollouts
from ms_highway.experiments.values.rollouts import Course, noisy_starts
from ms_highway.loop.devices import device_mesh, use_devices

LEARNING = Learning({"naive": 0.09, "turn": 0.17}, rounds=2, states=(8, 5), seed=3)
QUICK = {
    "merger": ("--set ladder=naive,turn", "--states 8 --rounds 2"),
    "dense_merge": ("--set humans=2 --set horizon=5", "--states 6 --rounds 2 --horizon-steps 5"),
}


@pytest.fixture(scope="module")
def course():
    batch = make_batch(Comparison({"merger": ["naive"]}, config={"ladder": ["naive", "turn"]}), "merger")
    return Course("merger", batch.loop, batch.environment.draw_episode, 40, (0, 1))


def same(one, other):
    pairs = zip(jax.tree.leaves(one.network), jax.tree.leaves(other.network), strict=True)
    return all(np.array_equal(first, second) for first, second in pairs)


@pytest.mark.slow
def test_learning_goes_on_where_it_was_killed_and_gives_the_same_values_on_any_devices(course, tmp_path):
    done = list(learn(LEARNING, [course], tmp_path / "whole", device_mesh(jax.local_devices()[:1])))
    assert [(step.round, step.course) for step in done] == [(1, "merger"), (1, ""), (2, "merger"), (2, "")]
    assert [step.values.provenance["examples"] for step in done[1::2]] == [8, 13]
    assert all(step.regrets["merger"] >= 0 for step in done[1::2])
    kept = tmp_path / "kept"
    list(islice(learn(LEARNING, [course], kept, use_devices()), 1))
    before = (kept / "1-0.npz").read_bytes()
    *_, last = learn(LEARNING, [course], kept, use_devices())
    assert (kept / "1-0.npz").read_bytes() == before
    assert same(last.values, done[-1].values)
    with pytest.raises(ValueError, match=r"seed \d instead of 9"):
        next(learn(replace(LEARNING, seed=9), [course], kept, device_mesh()))
    (kept / "1-0.npz").write_bytes(before[:100])
    with pytest.raises(ValueError, match=r"1-0\.npz cannot be read"):
        next(learn(LEARNING, [course], kept, device_mesh()))


def test_starts_are_noisier_than_those_of_the_scenario_around_the_same_mean(course):
    random = np.random.default_rng(0)
    own, noisy = course.starts(random, 400)[0], noisy_starts(course, random, 400)[0]
    np.testing.assert_allclose(noisy.mean(axis=0), own.mean(axis=0), atol=0.3)
    ratio = noisy.std(axis=0) / own.std(axis=0)
    assert (ratio > 2).all()
    assert (ratio < 5).all()


@pytest.mark.slow
@pytest.mark.parametrize("scenario", ["merger", "dense_merge"])
def test_the_command_learns_values_that_drive(scenario, tmp_path, capsys):
    file, (config, quick) = tmp_path / "values.npz", QUICK[scenario]
    run(f"values learn {scenario} {config} {quick} --out {file}")
    assert capsys.readouterr().out.count("held-out regret per step: merger 0.") == 2 * (scenario == "merger")
    assert list(tmp_path.iterdir()) == [file]
    values = load_values(file)
    assert values.provenance["scenarios"] == [scenario]
    assert values.provenance["examples"] == (13 if scenario == "merger" else 24)  # of two humans in each state
    run(f"compare {scenario} {config} --controllers learned:0.1:{file} --seeds 1 --out {tmp_path / 'out'}")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("merger --out values.json", "'values.json' is no name that ends in .npz"),
        ("dense_merge merger --out values.npz", "some scenarios have one human, others several"),
        ("merger --set costs=naive=0.1 --out values.npz", "without seconds for tom, turn"),
        ("merger --set ladder=best --out values.npz", "leave +warm out"),
        ("merger --set yielding=never --out values.npz", "config['yielding']"),
    ],
)
def test_what_cannot_be_learned_is_refused_before_anything_is_written(arguments, message, refused):
    assert message in refused(f"values learn {arguments}")


@pytest.mark.parametrize("name", ["descriptions", "gains"])
def test_rollouts_that_are_not_finite_are_refused_by_name(name, tmp_path):
    arrays = {"descriptions": np.zeros((1, 2)), "gains": np.full((1, 2), -np.inf)}
    np.savez(tmp_path / "1-0.npz", **arrays)
    assert (read_rollouts(tmp_path / "1-0.npz").descriptions == 0).all()
    arrays[name][0, 0] = np.nan
    np.savez(tmp_path / "1-0.npz", **arrays)
    with pytest.raises(
        ValueError, match=r"1-0\.npz cannot be read \(it holds numbers that are not finite\); remove it"
    ):
        read_rollouts(tmp_path / "1-0.npz")
