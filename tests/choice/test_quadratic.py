"""Algorithm 1: gain estimates over one step and over the whole horizon, and which rungs
it checks.
"""

import jax
import numpy as np
import pytest
from driving import COSTS, LADDER
from jax import numpy as jnp

from ms_highway.choice.quadratic import Switching, WholeHorizon, expand
from ms_highway.choice.rule import NOT_ESTIMATED, Outcome, decide, first_memory
from ms_highway.game.game import swap_players, total_reward
from ms_highway.game.scenario import PAPER_UNIT
from ms_highway.numerics.second_derivatives import minus_inverse_times
from ms_highway.planning.plans import Plan
from ms_highway.runtime.compilation import jit_quickly

pytestmark = pytest.mark.usefixtures("stopped_by_nans")

decide_quickly = jit_quickly(decide)
ROBOT, HUMAN = PLAN = np.float32(np.random.default_rng(0).normal(0, 0.2, (2, 5, 2)))


def made(price, kind=Switching):
    return kind(COSTS, np.float32(price), LADDER)


def on(rung):
    memory = first_memory(made(0.0), 1)
    return memory._replace(rungs=memory.rungs + rung, step=np.ones((), np.int32))


def decided(rule, played, memory, reward=1.5, unit=PAPER_UNIT):
    """Return the decision after a step in which both followed a plan."""
    game, state = played("merger", unit=unit)
    plan = Plan(ROBOT, HUMAN[None])
    outcome = Outcome(state, state, ROBOT[0], HUMAN[:1], np.float32(reward), plan)
    return decide_quickly(rule, game, memory, outcome)


@pytest.mark.parametrize("kind", [Switching, WholeHorizon])
def test_the_top_is_chosen_up_to_its_break_even_price(played, kind):
    """There, its time costs as much as it gains per step."""
    gain = decided(made(0.0, kind), played, on(0), reward=-9.0).gains[0, 2]
    break_even = gain / (0.37 - 0.09)
    assert gain > 0
    for share, rung in ((0.99, 2), (1.01, 0)):
        decision = decided(made(share * break_even, kind), played, on(0), reward=-9.0)
        assert decision.memory.rungs == rung
        assert decision.gains[0, 2] == gain


def test_gains_are_over_the_first_rung_from_any_rung(played):
    """A downward check from turn compares it with naive; what tom gained when it was
    chosen is kept.
    """
    up = decided(made(0.0), played, on(0), reward=-9.0)
    assert (up.memory.rungs, up.memory.gain) == (2, up.gains[0, 2])
    down = decided(made(1e6), played, up.memory._replace(step=np.int32(2)))
    assert down.memory.rungs == 1
    assert down.gains[0, 2] == up.gains[0, 2]
    last = decided(
        made(0.0), played, down.memory._replace(step=np.int32(6)), reward=100.0
    )
    assert np.isfinite(last.gains[0]).all()
    assert last.gains[0, 0] == 0
    assert last.memory.gain == last.gains[0, 1]


def test_gains_do_not_depend_on_the_unit_of_length(played):
    for rung in range(3):
        metres, units = (
            decided(made(0.1), played, on(rung), unit=unit).gains
            for unit in (PAPER_UNIT, 1.0)
        )
        assert np.isfinite(metres).any()
        np.testing.assert_allclose(metres, units, rtol=1e-2, atol=1e-3)


def test_the_top_checks_the_rung_below_after_each_cooldown(played):
    """It checks no other rung, and switches to that one for a gain."""
    memory = on(2)
    checked = []
    for _ in range(8):
        decision = decided(
            made(0.0), played, memory, reward=100.0
        )  # more than any alternative earns
        checked.append(np.flatnonzero(decision.gains[0] != NOT_ESTIMATED).tolist())
        memory = decision.memory._replace(step=np.asarray(decision.memory.step) + 1)
        assert memory.rungs == 2
    assert checked == [[1, 2], [], [], [1, 2], [], [], [1, 2], []]
    assert decided(made(1e6), played, on(2)).memory.rungs == 1


def test_the_expansion_has_the_derivatives_of_both_rewards(played):
    game, state = played("merger", seed=2)

    def rewards(both):
        robot, human = both.reshape(2, 5, 2)
        mirrored = total_reward(*swap_players(game, state), human, robot[None])
        return jnp.stack([total_reward(game, state, robot, human[None]), mirrored])

    @jit_quickly
    def derivatives(both):
        slopes = jax.jacobian(rewards)(both)
        bends = jax.hessian(rewards)(both)
        human_bend = bends[1, 10:, 10:] - jnp.diag(
            jnp.tile(jnp.asarray(game.humans.comfort), 5)
        )
        return (
            slopes[0],
            bends[0],
            minus_inverse_times(game.influence, human_bend, bends[1, 10:, :10]),
        )

    slopes, bends, influence = map(np.asarray, derivatives(PLAN.ravel()))
    found = jit_quickly(expand)(game, state, ROBOT.ravel(), HUMAN.ravel())
    for one, expected in ((found.hessian, bends), (found.gradient, slopes)):
        np.testing.assert_allclose(
            one, expected, rtol=1e-3, atol=1e-4 * abs(expected).max()
        )
    np.testing.assert_allclose(
        found.influence, influence, rtol=1e-2, atol=1e-3 * abs(influence).max()
    )
