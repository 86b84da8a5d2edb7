"""Plans and decisions from states in which no scenario starts."""

from dataclasses import replace
from functools import partial

import jax
import numpy as np
import pytest
from driving import COSTS, LADDER

from ms_highway.choice.quadratic import Switching
from ms_highway.game.dynamics import step as move
from ms_highway.game.scenario import PHYSICAL_LIMIT
from ms_highway.game.scenarios import MERGER, STAY_BACK
from ms_highway.loop.braking import BRAKING, braking_control
from ms_highway.loop.driver import Driver, fixed

LIMIT = np.array(PHYSICAL_LIMIT)


def wild(state):
    """Return starts with cars off the road, across it, reversing, standing, and one
    inside another.
    """
    random = np.random.default_rng(0)
    starts = np.asarray(state, dtype=float) + random.normal(
        0, [10, 4, 0.8, 12], (100, *state.shape)
    )
    starts[::5, 0] = starts[::5, 1]  # the robot in the human's place
    starts[1::5, :, 3] = 0.0  # all cars stand
    starts[2::5, 0, :2] = starts[2::5, -1, :2]  # bodies overlap, motions differ
    return starts


@pytest.mark.slow
def test_switching_drives_from_wild_starts(played):
    """Five steps from every start, with a random human: enough to go up the ladder and
    all the way down.
    """
    game, normal = played(
        replace(MERGER, cones=STAY_BACK.cones), control_limit=PHYSICAL_LIMIT
    )
    controller = Driver(game, Switching(COSTS, 0.1, LADDER))
    random = np.random.default_rng(1)
    models = set()
    estimated = set()
    for state in wild(normal):
        controller.reset()
        for _ in range(5):
            step = controller.step(state)
            assert step.status == "planned"
            assert np.isfinite(step.plan).all()
            assert np.isfinite(step.humans).all()
            assert (abs(step.plan) <= LIMIT * (1 + 1e-6)).all()
            models |= {*step.models}
            estimated |= {
                name
                for name, gain in zip(step.ladder, step.gains[0], strict=True)
                if np.isfinite(gain)
            }
            controls = np.zeros((len(state), 2))
            controls[:2] = step.control, random.normal(0, LIMIT / 3)
            state = move(game.dynamics, state, controls)
    assert models == estimated == {"naive", "turn", "tom"}


either_semantics = pytest.mark.parametrize("semantics", ["paper", "released"])


def absurd_states(number, cars, largest):
    """Finite states whose numbers are of every magnitude and either sign."""
    random = np.random.default_rng(2)
    shape = number, cars, 4
    return random.choice([-1, 1], shape) * 10.0 ** random.uniform(
        -largest, largest, shape
    )


@either_semantics
def test_braking_is_finite_and_limited_in_any_finite_state(played, semantics):
    """It ends at a standstill."""
    game, _ = played("merger", semantics=semantics)
    for car in absurd_states(2000, 1, 308)[:, 0]:
        with np.errstate(over="ignore", invalid="ignore"):
            control = braking_control(game, car)
        assert np.isfinite(control).all()
        assert abs(control[1]) <= BRAKING.deceleration
    slow = np.array([0.0, 0.0, 0.1, 0.5])
    assert move(game.dynamics, slow, braking_control(game, slow))[3] == pytest.approx(
        0.0, abs=1e-6
    )
    single = absurd_states(2000, 1, 38)[:, 0].astype(np.float32)
    assert np.isfinite(jax.jit(jax.vmap(partial(braking_control, game)))(single)).all()


@either_semantics
def test_controls_are_finite_in_any_single_precision_state(played, semantics):
    """States that single precision does not hold are refused."""
    game, state = played("merger", semantics=semantics)
    controller = fixed(game)
    random = np.random.default_rng(3)
    for states in absurd_states(300, len(state), 38):
        wild = np.where(random.random(states.shape) < 0.3, states, np.asarray(state))
        controller.reset()
        step = controller.step(wild)
        assert np.isfinite(step.plan).all()
        assert np.isfinite(step.humans).all()
    for value in (1e39, -1e308):
        states = np.array(state, dtype=float)
        states[1, 3] = value
        with pytest.raises(
            ValueError,
            match=r"car 1 is not finite: speed is .*, too large for single precision",
        ):
            controller.step(states)
