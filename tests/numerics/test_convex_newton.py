"""Newton steps whose result is a continuous function of the start."""

import jax
import numpy as np
import pytest
from jax import numpy as jnp

from ms_highway.numerics.convex_newton import (
    MIN_PART,
    MIN_SHARE,
    STEP_TOLERANCE,
    convex_newton_steps,
    share,
    until_still,
)
from ms_highway.numerics.newton import Objective, best_of

PATH = jnp.asarray(np.random.default_rng(0).normal(size=(1, 6, 12)) / 3)


def objective(reward, curvature=0.0, limit=10.0):
    return Objective(
        lambda controls: PATH @ controls.ravel(),
        reward,
        lambda controls: jnp.sum(controls**2) / 2,
        lambda controls: jnp.clip(controls, -limit, limit),
        jax.grad(reward),
        lambda path: (curvature(path) if callable(curvature) else jnp.full_like(path, curvature))[None],
        lambda controls: PATH,
    )


def test_a_concave_reward_is_climbed_almost_to_its_top_within_the_limits():
    def hill(path):
        return -20 * jnp.sum((path - 1.0) ** 2)

    best = np.linalg.solve(np.eye(12) + 40 * PATH[0].T @ PATH[0], 40 * PATH[0].T @ np.ones(6)).reshape(6, 2)
    start = jnp.zeros((6, 2))
    np.testing.assert_allclose(convex_newton_steps(objective(hill, 40.0), start, steps=40), best, atol=0.01)
    assert np.abs(convex_newton_steps(objective(hill, 40.0, limit=0.1), start)).max() <= 0.1


def test_similar_starts_end_in_similar_plans_even_where_the_reward_has_walls():
    """At some of these starts, a line search that chooses among shares would jump from one share to the next.

    In double precision, as rounding hides whether the steepest change is a jump.
    """

    def walls(path):
        return -jnp.sum(50 * jnp.maximum(0.3 - (path - 0.4) ** 2, 0.0) ** 3) - jnp.sum((path - 1.0) ** 2)

    def bend(path):
        squared = (path - 0.4) ** 2
        return 2 + 300 * jnp.maximum(0.3 - squared, 0.0) * 4 * squared

    improve = jax.jit(jax.vmap(lambda start: convex_newton_steps(objective(walls, bend), start, steps=6)))

    def changes(lowest, highest, number):
        starts = np.linspace(lowest, highest, number + 1)[:, None, None] * np.ones((6, 2))
        return np.abs(np.diff(improve(starts), axis=0)).max(axis=(1, 2))

    with jax.enable_x64(True):
        all_over = changes(0.0, 0.5, 5000)
        fork = all_over.argmax() * 1e-4
        closer = fork + changes(fork, fork + 1e-4, 100).argmax() * 1e-6
        assert np.quantile(all_over, 0.99) < 20e-4  # for starts that are 1e-4 apart
        assert changes(closer, closer + 1e-6, 100).max() < all_over.max() / 20  # a jump would stay


@pytest.mark.parametrize(
    ("slope", "after", "expected"),
    [
        (1.0, 0.5, 1.0),
        (1.0, 0.0, 1.0),
        (1.0, -1.0, 0.5),
        (1.0, -3.0, 0.25),
        (1.0, -1e6, MIN_SHARE),
        (-1e-3, -1.0, MIN_SHARE),
    ],
)
def test_the_share_of_a_step_is_that_of_a_parabola(slope, after, expected):
    assert share(jnp.float32(slope), jnp.float32(after)) == pytest.approx(expected, abs=1e-4)


def test_a_step_towards_nan_is_short_and_a_plan_without_a_finite_reward_is_nan():
    assert share(jnp.float32(1.0), jnp.float32(jnp.nan)) == jnp.float32(MIN_SHARE)
    lost = objective(lambda path: jnp.sum(path) * jnp.nan)
    assert np.isnan(convex_newton_steps(lost, jnp.zeros((6, 2)))).all()


def test_steps_are_repeated_until_they_are_short_and_one_more_or_less_hardly_matters():
    def rest(start, most=50, left=0.3):
        return until_still(lambda point: left * point, jnp.float32(start), most, lambda point: point)

    starts = np.geomspace(0.01, 1.0, 4001, dtype=np.float32)
    ends = np.asarray(jax.jit(jax.vmap(rest))(starts))
    assert ends.max() < 2 * STEP_TOLERANCE / 0.7
    assert np.abs(np.diff(ends)).max() < 2 * MIN_PART * STEP_TOLERANCE
    np.testing.assert_array_equal(ends[::1000], [rest(start) for start in starts[::1000]])
    assert rest(1.0, most=jnp.int32(2)) == pytest.approx(0.09)
    assert rest(0.5 * STEP_TOLERANCE) == pytest.approx(0.5 * STEP_TOLERANCE)  # not worth a step
    assert np.isnan(rest(1.0, left=np.nan))


def test_the_best_candidate_earns_a_finite_reward():
    candidates = jnp.arange(3.0)[:, None]
    assert best_of(candidates, jnp.array([jnp.nan, -1.0, jnp.inf])) == 1.0
    assert np.isnan(best_of(candidates, jnp.full(3, jnp.nan))).all()  # so that a plan fails, and says so


def test_a_reward_that_is_not_concave_is_climbed_too():
    waves, start = objective(lambda path: jnp.sum(jnp.cos(3 * path)) * 5), jnp.full((6, 2), 0.9)
    assert waves.earned(convex_newton_steps(waves, start)) > waves.earned(start) + 1.0
