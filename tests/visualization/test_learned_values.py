"""What learned values see, in states and in pictures."""

from types import SimpleNamespace

import jax
import numpy as np
import pytest
from commands import run
from comparisons import Page
from matplotlib.colors import to_hex
from matplotlib.figure import Figure

from ms_highway.experiments.analysis.advantages import estimate, see
from ms_highway.experiments.runner import make_environment
from ms_highway.metareasoning.rule import first_memory
from ms_highway.visualization.colors import color_of
from ms_highway.visualization.values import along, around


@pytest.fixture(scope="module")
def seen():
    return see("merger", 1.0, "shipped", cells=2)


@pytest.mark.slow
def test_estimates_are_what_the_rule_compares_and_chooses(seen):
    env = make_environment("merger", "learned:1").unwrapped
    env.reset(seed=0)
    start = env.car_states
    rule = env.robot.controller.rule
    now = SimpleNamespace(after=start.astype(np.float32))  # learned values look at nothing else
    decision = jax.jit(lambda: rule.choose(first_memory(rule, 1), rule.look(env.game, None, now)))()
    np.testing.assert_allclose(seen.along.compared[0], decision.gains[0], rtol=1e-3, atol=1e-4)
    assert seen.along.chosen[0] == decision.memory.rungs[0]
    moved = start.copy()
    moved[1, 0], moved[1, 3] = start[0, 0] - seen.behind[1], start[0, 3] + seen.faster[0]
    np.testing.assert_allclose(
        seen.around.compared[0, 1], estimate(rule, env.game, moved).compared, rtol=1e-3, atol=1e-4
    )


def test_learned_values_see_the_models_that_are_used_in_the_episode(seen):
    assert seen.models == ("naive", "turn", "tom")
    assert [seen.models[rung] for rung in seen.along.chosen] == seen.used
    assert len(seen.rewards) == 40
    assert (seen.along.compared[:, 0] == 0).all()
    assert (seen.along.compared[:, 2] > seen.along.expected[:, 2]).all()  # in doubt, the most expensive one plans
    for each in (seen.along, seen.around):  # which the pictures show
        np.testing.assert_array_equal(each.compared.argmax(axis=-1), each.chosen)


def test_advantages_and_the_models_in_use_are_drawn_along_an_episode(seen):
    figure = Figure()
    along(figure, seen)
    upper, lower = figure.axes
    (line,) = [line for line in upper.lines if line.get_color() == color_of("tom")]
    np.testing.assert_array_equal(line.get_ydata(), seen.along.compared[:, 2])
    assert [to_hex(patch.get_facecolor()) for patch in lower.patches] == list(map(color_of, seen.used))
    texts = [text.get_text() for text in figure.legends[0].get_texts()]
    assert {"turn rather than naive", "tom rather than naive", "tom in use"} <= set(texts)


def test_around_a_start_the_chosen_model_is_drawn_and_what_the_most_expensive_one_is_worth(seen):
    figure = Figure()
    around(figure, seen)
    chosen, worth = (axes.images[0] for axes in figure.axes[:2])
    np.testing.assert_array_equal(chosen.get_array(), seen.around.chosen)
    np.testing.assert_array_equal(worth.get_array(), seen.around.compared[..., 2])
    assert to_hex(chosen.cmap(chosen.norm(2))) == color_of("tom")
    assert chosen.get_extent() == [*seen.behind, *seen.faster]


@pytest.mark.slow
def test_a_page_tells_what_values_hold_and_draws_what_they_see(compared, tmp_path, refused):
    page = tmp_path / "values.html"
    run(f"report {compared} --no-videos --values shipped --out {page}")
    html = Page(page.read_text())
    assert {"naive, turn, tom", "0.09, 0.17, 0.37", "0.001 to 100"} <= set(html.texts)
    assert html.all("img")[-1]["alt"].startswith("Values of computation, stay_back.")
    assert "cannot be read" in refused("report --values none.npz --out none.html")
