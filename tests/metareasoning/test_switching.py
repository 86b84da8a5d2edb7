"""Gain estimates and Algorithm 1."""

from dataclasses import replace

import jax
import numpy as np
import pytest
from jax import numpy as jnp

from ms_highway.game.game import swap_players, total_reward
from ms_highway.metareasoning.rule import Outcome, decide, first_memory
from ms_highway.metareasoning.switching import Switching, _expand
from ms_highway.optimization.second_derivatives import response
from ms_highway.planning.compiled_plans import Costs
from ms_highway.planning.human_models import ladder
from ms_highway.planning.plans import Plan
from ms_highway.runtime.compilation import jit_quickly

decide_quickly = jit_quickly(decide)


@pytest.mark.parametrize(
    ("scenario", "influence"),
    [
        pytest.param("merger", "exact", marks=pytest.mark.slow),
        ("stay_back", "damped"),
    ],
)
def test_the_expansion_is_that_of_the_rewards_after_one_step(scenario, played, influence):
    """Against derivatives of the planners' own objective, taken with the controls of both as one argument."""
    game, state = played(scenario, seed=2)
    game = replace(game, influence=influence)
    controls = jnp.asarray(np.random.default_rng(0).normal(0, 0.3, (2, 2)), dtype=jnp.float32)

    def robot_reward(both):
        return total_reward(game, state, both[:1], both[None, 1:])

    def human_reward(both):
        return total_reward(*swap_players(game, state), both[1:], both[None, :1])

    def derivatives(both):
        return jax.grad(robot_reward)(both), jax.hessian(robot_reward)(both), jax.hessian(human_reward)(both)

    expansion = jit_quickly(_expand)(game, state, *controls)
    slope, bend, human = (np.asarray(array) for array in jit_quickly(derivatives)(controls))
    scale = abs(bend).max()
    np.testing.assert_allclose([expansion.robot, expansion.human], slope, rtol=1e-3, atol=1e-4 * abs(slope).max())
    np.testing.assert_allclose(expansion.robot_robot, bend[0, :, 0], rtol=1e-3, atol=1e-4 * scale)
    np.testing.assert_allclose(expansion.robot_human, bend[0, :, 1], rtol=1e-3, atol=1e-4 * scale)
    np.testing.assert_allclose(expansion.human_human, bend[1, :, 1], rtol=1e-3, atol=1e-4 * scale)
    expected = response(influence, jnp.asarray(human[1, :, 1]), jnp.asarray(human[1, :, 0]))
    np.testing.assert_allclose(expansion.influence, expected, rtol=1e-2, atol=1e-4 * abs(expected).max())


def made(price, names=("naive", "turn", "tom"), costs=(0.09, 0.17, 0.37)):
    return jax.tree.map(jnp.asarray, Switching(Costs(0.0, np.array(costs)), price, ladder(names)))


def at(switching, rung, step=1):
    memory = first_memory(switching, 1)
    return memory._replace(rungs=memory.rungs + rung, step=np.asarray(step, np.int32))


def decided(switching, played, memory=None, reward=1.5):
    game, state = played("merger")
    memory = at(switching, 0) if memory is None else memory
    control, still = jnp.array([0.1, 0.1]), jnp.zeros((5, 2))
    outcome = Outcome(state, state, control, control[None], jnp.float32(reward), Plan(still, still[None]))
    return decide_quickly(switching, game, memory, outcome)


def test_a_higher_price_lowers_the_gain_by_the_extra_planning_time(played):
    free, priced = (decided(made(price), played) for price in (0.0, 2.0))
    assert free.gains[0, 2] - priced.gains[0, 2] == pytest.approx(2.0 * (0.37 - 0.09), rel=1e-3)


def test_a_positive_gain_goes_straight_to_the_top(played):
    decision = decided(made(0.0), played, reward=-100.0)
    assert decision.gains[0, 2] > 0
    assert decision.memory.rungs == 2


def test_a_negative_gain_stays(played):
    decision = decided(made(1e6), played)
    assert decision.gains[0, 2] < 0
    assert decision.memory.rungs == 0


def test_the_top_rung_goes_down_one_rung_at_a_time_and_never_up(played):
    switching = made(1e6)
    decision = decided(switching, played, at(switching, 2))
    assert np.isnan(decision.gains[0, 2])
    assert decision.gains[0, 1] > 0
    assert decision.memory.rungs == 1


def test_downward_checks_of_a_rung_wait_for_the_cooldown(played):
    switching = made(0.0)
    memory, checked = at(switching, 2), []
    for _ in range(8):
        decision = decided(switching, played, memory, reward=100.0)  # better than any alternative: stay
        checked.append(bool(~np.isnan(decision.gains[0, 1])))
        memory = decision.memory
        assert memory.rungs == 2
    assert checked == [True, False, False, True, False, False, True, False]


@pytest.mark.parametrize("costs", [(0.09,), (0.09, 0.17, 0.37, 0.5)])
def test_a_decision_needs_a_cost_for_each_rung(played, costs):
    with pytest.raises(ValueError, match="give one for each of naive, turn, tom"):
        decided(made(0.0, costs=costs), played)


def test_a_ladder_of_one_rung_never_switches(played):
    decision = decided(made(0.0, names=("naive",), costs=(0.09,)), played, reward=-100.0)
    assert decision.memory.rungs == 0
    assert np.isnan(decision.gains).all()
