"""Newton steps whose result is a continuous function of the start."""

import jax
import numpy as np
import pytest
from jax import numpy as jnp

from ms_highway.numerics.convex_newton import (
    NEWTON_STEPS,
    best_share,
    expand,
    improve,
    until_still,
)
from ms_highway.numerics.objective import Objective

PATH = np.random.default_rng(0).normal(size=(1, 6, 12)).astype(np.float32) / 3


def objective(reward, curvature, limit=10.0):
    return Objective(
        lambda controls: PATH @ controls.ravel(),
        reward,
        lambda controls: jnp.sum(controls**2) / 2,
        lambda controls: jnp.clip(controls, -limit, limit),
        jax.grad(reward),
        lambda path: curvature(path)[None],
        lambda controls: PATH,
    )


def climb(hill, start, steps):
    """Return the controls after Newton steps of a car to which nobody responds."""
    point, *_ = until_still(
        lambda _, controls: improve(hill, controls, expand(hill, controls)),
        hill.bounded(start),
        steps,
        lambda controls: controls,
    )
    return point


@jax.jit
@jax.vmap
def climbed(steepness, waves, limit):
    """Return the controls after Newton steps on a hill with waves, and the reward that
    these steps gain.
    """

    def reward(path):
        return waves * jnp.sum(jnp.cos(3 * path)) - steepness * jnp.sum(
            (path - 1.0) ** 2
        )

    hill = objective(reward, lambda path: jnp.full_like(path, 2 * steepness), limit)
    start = jnp.full((6, 2), 0.9)
    controls = climb(hill, start, steps=40)
    return controls, hill.earned(controls) - hill.earned(start)


def test_steps_climb_any_reward_within_the_limits():
    top = np.linalg.solve(
        np.eye(12) + 40 * PATH[0].T @ PATH[0], 40 * PATH[0].T @ np.ones(6)
    ).reshape(6, 2)
    rewards = np.float32([[20, 0, 10], [20, 0, 0.1], [0, 5, 10], [np.nan, 0, 10]])
    found, gained = climbed(*rewards.T)
    np.testing.assert_allclose(found[0], top, atol=0.01)
    assert abs(found[1]).max() <= 0.1
    assert gained[2] > 1.0
    assert np.isnan(found[3]).all()


def test_similar_starts_end_in_similar_plans_despite_walls():
    """At some of these starts, a line search that chooses among shares would jump from
    one share to the next.

    In double precision, as rounding hides whether the steepest change is a jump.
    """

    def walls(path):
        return -jnp.sum(50 * jnp.maximum(0.3 - (path - 0.4) ** 2, 0.0) ** 3) - jnp.sum(
            (path - 1.0) ** 2
        )

    def bend(path):
        squared = (path - 0.4) ** 2
        return 2 + 300 * jnp.maximum(0.3 - squared, 0.0) * 4 * squared

    improved = jax.jit(
        jax.vmap(lambda start: climb(objective(walls, bend), start, steps=6))
    )

    def changes(lowest, highest):
        starts = np.linspace(lowest, highest, 5001)[:, None, None] * np.ones((6, 2))
        return abs(np.diff(improved(starts), axis=0)).max(axis=(1, 2))

    with jax.enable_x64(True):
        all_over = changes(0.0, 0.5)
        fork = all_over.argmax() * 1e-4
        closer = changes(fork, fork + 1e-4)
    assert np.quantile(all_over, 0.99) < 20e-4  # for starts that are 1e-4 apart
    assert closer.max() < all_over.max() / 20  # a jump would stay


def test_the_share_of_a_step_is_that_of_a_parabola():
    slope = np.float32([1, 1, 1, 1, -1e-3, np.nan])
    after = np.float32([0.5, -1, -1e6, np.nan, -1, 1])
    least = NEWTON_STEPS.min_share
    expected = [1, 0.5, least, least, least, np.nan]
    np.testing.assert_allclose(best_share(slope, after), expected, atol=1e-4)


def test_steps_are_repeated_until_one_more_hardly_matters():
    def rest(start, most=50):
        return until_still(
            lambda _, point: 0.3 * point, start, most, lambda point: point
        )

    tolerance = NEWTON_STEPS.tolerance
    starts = np.geomspace(0.5 * tolerance, 1.0, 4001, dtype=np.float32)
    ends, steps, converged = map(np.asarray, jax.jit(jax.vmap(rest))(starts))
    assert ends[0] == starts[0]  # not worth a step
    assert ends.max() < 2 * tolerance / 0.7
    assert abs(np.diff(ends)).max() < 2 * NEWTON_STEPS.fade_end * tolerance
    assert converged.all()
    assert steps[0] == 1
    assert np.all(np.diff(steps) >= 0)
    end, steps, converged = rest(1.0, most=2)
    assert end == pytest.approx(0.09)
    assert (int(steps), bool(converged)) == (2, False)
