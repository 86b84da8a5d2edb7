"""Gain estimates and Algorithm 1."""

import jax
import numpy as np
import pytest
from jax import numpy as jnp

from ms_highway.choice.quadratic import Switching
from ms_highway.choice.rule import NOT_ESTIMATED, Outcome, decide, first_memory
from ms_highway.planning.compiled_plans import Costs
from ms_highway.planning.human_models import ladder
from ms_highway.planning.plans import Plan
from ms_highway.runtime.compilation import jit_quickly

pytestmark = pytest.mark.usefixtures("stopped_by_nans")

decide_quickly = jit_quickly(decide)


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


def test_the_top_rung_goes_down_one_rung_at_a_time_and_never_up(played):
    switching = made(1e6)
    decision = decided(switching, played, at(switching, 2))
    assert decision.gains[0, 2] == NOT_ESTIMATED
    assert decision.gains[0, 1] > 0
    assert decision.memory.rungs == 1


def test_downward_checks_of_a_rung_wait_for_the_cooldown(played):
    switching = made(0.0)
    memory, checked = at(switching, 2), []
    for _ in range(8):
        decision = decided(switching, played, memory, reward=100.0)  # better than any alternative: stay
        checked.append(bool(decision.gains[0, 1] != NOT_ESTIMATED))
        memory = decision.memory._replace(step=memory.step + 1)
        assert memory.rungs == 2
    assert checked == [True, False, False, True, False, False, True, False]


def test_a_ladder_of_one_rung_never_switches(played):
    decision = decided(made(0.0, names=("naive",), costs=(0.09,)), played, reward=-100.0)
    assert decision.memory.rungs == 0
    assert (decision.gains == NOT_ESTIMATED).all()
