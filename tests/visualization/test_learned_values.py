"""What learned values see, in states and in pictures."""

from dataclasses import replace

import jax
import numpy as np
import pytest
from comparisons import failure
from matplotlib.colors import to_hex
from matplotlib.figure import Figure

from ms_highway.cli.main import main
from ms_highway.envs.graphics import _reason
from ms_highway.experiments.analysis.advantages import Advantages, Slice, estimate, slice_of_starts
from ms_highway.experiments.runner import make_environment
from ms_highway.metareasoning.rule import first_memory
from ms_highway.metareasoning.values import load_values
from ms_highway.visualization.colors import color_of
from ms_highway.visualization.values import along, where

STEPS = 4


@pytest.fixture(scope="module")
def merger():
    env = make_environment("merger", "learned:1").unwrapped
    env.reset(seed=0)
    return env


@pytest.fixture(scope="module")
def rule(merger):
    return load_values("shipped").rule(merger.models, merger.costs(merger.car_states), 1.0)


@pytest.fixture
def drawn():
    """Four steps whose dearest model is worth less from step to step, and a slice of the same."""
    worth = np.linspace(1, -0.5, STEPS)
    mean = np.stack([np.zeros(STEPS), worth / 2, worth], axis=-1)
    advantages = Advantages(("naive", "turn", "tom"), 1.0, mean, np.full_like(mean, 0.1), np.array([2, 2, 0, 0]))
    square = replace(advantages, mean=np.stack([mean] * 3), deviation=None, chosen=np.stack([advantages.chosen] * 3))
    return advantages, Slice(np.linspace(-5, 20, STEPS), np.linspace(-6, 6, 3), square, (3.0, 0.0))


def test_estimates_are_what_the_rule_compares_and_chooses(merger, rule):
    states = np.stack([merger.car_states, merger.car_states + np.array([30.0, 0.0, 0.0, 0.0])]).astype(np.float32)
    seen = estimate(rule, merger.game, states)
    assert seen.models == ("naive", "turn", "tom")
    for state, mean, chosen in zip(states, seen.mean, seen.chosen, strict=True):
        decision = jax.jit(lambda state: rule.choose(first_memory(rule), rule.look(merger.game, None, _Now(state))))(
            state
        )
        np.testing.assert_allclose(mean, decision.gains, rtol=1e-3, atol=1e-4)
        assert chosen == decision.memory.rung
    assert (seen.mean[:, 0] == 0).all()
    assert (seen.deviation[:, 0] == 0).all()
    assert (seen.deviation[:, 1:] > 0).all()


class _Now:
    """An outcome, of which learned values look at the state after it only."""

    def __init__(self, state):
        self.after = state


def test_a_slice_moves_the_human_along_the_road_and_changes_its_speed(merger, rule):
    start = merger.car_states
    part = slice_of_starts(rule, merger.game, start, cells=2)
    moved = start.copy()
    moved[1, 0], moved[1, 3] = start[0, 0] - part.behind[1], start[0, 3] + part.faster[0]
    alone = estimate(rule, merger.game, moved[None])
    np.testing.assert_allclose(part.advantages.mean[0, 1], alone.mean[0], rtol=1e-3, atol=1e-4)
    assert part.start == pytest.approx((start[0, 0] - start[1, 0], start[1, 3] - start[0, 3]))


def test_advantages_and_the_models_in_use_are_drawn_along_an_episode(drawn):
    advantages, _ = drawn
    figure = Figure()
    along(figure, advantages, ["tom", "tom", "naive", "naive"], np.arange(STEPS))
    upper, lower = figure.axes
    lines = {line.get_label(): line for line in upper.lines}
    np.testing.assert_array_equal(lines["tom rather than naive"].get_ydata(), advantages.mean[:, 2])
    assert lines["tom rather than naive"].get_color() == color_of("tom")
    assert [to_hex(patch.get_facecolor()) for patch in lower.patches] == [color_of("tom")] * 2 + [color_of("naive")] * 2
    texts = [text.get_text() for text in figure.legends[0].get_texts()]
    assert texts == ["turn rather than naive", "tom rather than naive", "naive in use", "tom in use"]


def test_a_slice_shows_the_chosen_model_and_where_the_dearest_is_worth_its_time(drawn):
    _, part = drawn
    figure = Figure()
    where(figure, part)
    chosen, worth = (axes.images[0] for axes in figure.axes[:2])
    np.testing.assert_array_equal(chosen.get_array(), part.advantages.chosen)
    np.testing.assert_array_equal(worth.get_array(), part.advantages.mean[..., 2])
    assert to_hex(chosen.cmap(chosen.norm(2))) == color_of("tom")
    assert worth.norm.vmin == -worth.norm.vmax
    assert chosen.get_extent() == [-5, 20, -6, 6]


@pytest.mark.slow
def test_the_command_draws_what_the_values_see(tmp_path, capsys):
    picture = tmp_path / "merger.png"
    assert main(["values", "show", "shipped", "--scenario", "merger", "--price", "1", "--out", str(picture)]) == 0
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert "merger at a price of 1" in capsys.readouterr().out


def test_a_picture_needs_a_scenario_and_a_file_that_is_a_png(tmp_path, capsys):
    show = "values", "show", "shipped"
    assert "--scenario and --out go together" in failure(capsys, *show, "--scenario", "merger")
    assert "name a .png file" in failure(capsys, *show, "--scenario", "merger", "--out", str(tmp_path / "a.pdf"))


@pytest.mark.parametrize(
    ("gains", "failed", "learned", "said"),
    [
        ({"tom": 0.5}, False, True, "switched: worth +0.500"),
        ({"tom": 0.5}, False, False, "switched: estimated net gain +0.500"),
        ({"naive": -0.5}, False, True, "stays: worth of naive -0.500"),
        ({"naive": -0.5}, False, False, "stays: net gain of naive -0.500"),
        ({}, True, True, "choice failed: tom to be safe"),
    ],
)
def test_the_panel_says_what_the_model_is_worth_by_the_rule_that_chose_it(gains, failed, learned, said):
    assert _reason({"model": "tom", "gains": gains, "choice_failed": failed}, learned) == said
