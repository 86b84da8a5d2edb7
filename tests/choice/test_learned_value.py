"""Learned values of computation: their inputs, an episode, and their files."""

import json
from dataclasses import replace

import jax
import numpy as np
import pytest
from episodes import drive, make

from ms_highway.choice.learned_value import load_values, save_values
from ms_highway.choice.rule import PUBLISHED_COSTS
from ms_highway.choice.situation import describe, description_names
from ms_highway.envs import ENVIRONMENTS, SCENARIOS
from ms_highway.game.scenario import PAPER_UNIT, build_game
from ms_highway.game.starts import draw_episode
from ms_highway.planning.ladders import ladder

describe_quickly = jax.jit(describe)
SHIPPED = load_values("shipped")


def test_a_description_means_the_same_in_all_scenes():
    """It depends neither on units, nor on places, nor on the number of humans, nor on
    whole turns of headings.
    """
    scenario = SCENARIOS["dense_merge"]
    game = build_game(scenario)
    small = build_game(scenario, unit=1.0)
    everyone = np.arange(8)
    start, _ = draw_episode(scenario, np.random.default_rng(1), small.humans)
    start[:, 2] += 0.02
    metres = start * [PAPER_UNIT, PAPER_UNIT, 1, PAPER_UNIT]
    far = np.array([50.0, 0, 0, 0])
    described = describe_quickly(game, metres, everyone)
    assert described.shape == (8, len(description_names()))
    np.testing.assert_allclose(
        describe_quickly(small, start, everyone), described, rtol=1e-3, atol=2e-3
    )
    moved = replace(
        game, scene=replace(game.scene, obstacles=game.scene.obstacles + far[:2])
    )
    further = describe_quickly(moved, metres + far, everyone)
    # Single precision loses digits further out.
    np.testing.assert_allclose(further, described, rtol=1e-2, atol=2e-2)
    reversed_humans = metres[[0, *range(8, 0, -1)]]
    renumbered = describe_quickly(game, reversed_humans, everyone[::-1])
    np.testing.assert_allclose(renumbered, described, rtol=1e-4, atol=1e-4)
    whole_turns = np.zeros_like(metres)
    whole_turns[:, 2] = 2 * np.pi * np.arange(-4, 5)
    turned = describe_quickly(game, metres + whole_turns, everyone)
    # Single precision loses digits.
    np.testing.assert_allclose(turned, described, rtol=1e-3, atol=1e-2)


def test_the_model_that_is_worth_most_plans():
    """Theory of mind is worth its time at the start only."""
    models = []
    for info in drive(make("merger", "learned:1")).infos:
        worth = {
            name: gain - 1.0 * PUBLISHED_COSTS[name]
            for name, gain in info["gains"].items()
        }
        models.append(info["model"])
        assert max(worth, key=worth.get) == models[-1]
    assert (models[0], models[-1]) == ("tom", "naive")  # Algorithm 1 starts with naive
    assert 2 <= models.count("tom") <= 20


@pytest.fixture
def file(tmp_path):
    save_values(SHIPPED, tmp_path / "values.npz")
    return tmp_path / "values.npz"


def test_a_file_is_read_as_it_was_written(file):
    read = load_values(file)
    jax.tree.map(np.testing.assert_array_equal, read.network, SHIPPED.network)
    assert read.provenance == SHIPPED.provenance


@pytest.mark.parametrize(
    ("name", "change", "problem"),
    [
        (
            "about",
            lambda about: np.array(
                json.dumps(json.loads(str(about)) | {"version": 99})
            ),
            "version 99",
        ),
        (
            "about",
            lambda about: np.array(
                json.dumps(json.loads(str(about)) | {"provenance": {"scenarios": None}})
            ),
            "scenarios is None: Expected `array`",
        ),
        (
            "weights_2",
            lambda weights: weights * 1e9,
            "weights of the networks are beyond 1000",
        ),
        ("biases_1", lambda biases: biases[:1], "shapes"),
    ],
)
def test_a_damaged_file_is_refused_with_a_remedy(file, name, change, problem):
    """The error names the damage, and the command that writes another file."""
    with np.load(file) as archive:
        arrays = dict(archive)
    np.savez(file, **arrays | {name: change(arrays[name])})
    with pytest.raises(
        ValueError,
        match=(
            rf"values\.npz cannot be read.*{problem}.*`ms-highway values learn` --out"
        ),
    ):
        load_values(file)


def test_shipped_values_know_the_ladder_among_several_humans():
    settings = ENVIRONMENTS["dense-merge-v1"]().settings
    start = settings.start(1, np.random.default_rng())
    for names in (("naive", "tom"), ("naive", "turn", "tom")):
        assert (
            settings.controller.learned(start._replace(ladder=ladder(names))).ladder
            == names
        )
