"""The cost of plans for seconds that could no longer stop before an obstacle."""

from dataclasses import replace

import jax
import numpy as np
import pytest
from jax import numpy as jnp

from ms_highway.game.dynamics import Motion, observe
from ms_highway.game.game import move, swap_roles
from ms_highway.game.payoff import LATERAL_MARGIN, STOPPING_MARGIN, stopping_cost
from ms_highway.game.scenario import GRIP, build_game
from ms_highway.game.scenarios import DENSE_MERGE, STAY_BACK
from ms_highway.planning.compiled_plans import plan_for
from ms_highway.planning.human_models import Naive

GAME = build_game(DENSE_MERGE, control_limit=DENSE_MERGE.control_limit, grip=DENSE_MERGE.grip, humans=3)
SCENE = replace(GAME.scene, obstacles=GAME.scene.obstacles[:1])
(CONE,) = np.asarray(SCENE.obstacles, float)
CAR, CAR_WIDTH = np.asarray(SCENE.car_size, float)
LENGTH, TOUCH = (np.asarray(SCENE.car_size, float) + np.asarray(SCENE.obstacle_size, float)) / 2
WIDTH = TOUCH + LATERAL_MARGIN * CAR_WIDTH  # m, at which an obstacle is out of the way
SPEED = 20.0
STOP = CONE[0] - LENGTH - STOPPING_MARGIN * CAR  # m, where a car stands with room
STEPS, HALF = 20, 9


def motion(x, y=CONE[1], speed=SPEED):
    """A car that keeps its velocity, and is at x half-way."""
    xs = x + speed * 0.1 * (np.arange(STEPS) - HALF)
    rows = [np.broadcast_to(number, STEPS) for number in (y, 0.0, speed)]
    return observe(np.stack([xs, *rows], axis=-1).astype(np.float32))


def cost(*where):
    return float(stopping_cost(SCENE, GRIP, motion(*where)).sum())


def test_a_car_that_passes_beside_an_obstacle_or_has_passed_it_pays_nothing():
    assert cost(STOP, CONE[1] - 0.8 * WIDTH) > cost(STOP, CONE[1] - 0.9 * WIDTH) > 0.0
    assert cost(STOP, CONE[1] - 1.01 * WIDTH) == 0.0
    assert cost(CONE[0] + 0.5 * LENGTH) > 0.0
    assert cost(CONE[0] + 1.01 * LENGTH) == 0.0


@pytest.mark.parametrize(("grip", "limit"), [(8.0, 8.0), (None, 8.0), (8.0, 3.0), (None, np.inf)])
def test_plans_count_on_the_braking_that_their_limits_allow(grip, limit):
    planner = replace(GAME.planner, grip=grip, control_limit=np.array([0.2, limit], np.float32))
    assert replace(GAME, planner=planner).payoff.braking == min(limit, np.inf if grip is None else grip)


def test_only_plans_for_seconds_where_there_are_obstacles_keep_room():
    assert build_game(DENSE_MERGE, solver="gradient", humans=3).payoff.braking is None
    assert swap_roles(GAME).payoff.braking == GAME.payoff.braking  # humans with the published reward pay, too
    assert build_game(STAY_BACK, solver="convex_newton", grip=5.0).payoff.braking == 5.0
    assert replace(GAME, scene=replace(SCENE, obstacles=np.zeros((0, 2)))).payoff.braking is None


def test_a_robot_without_a_gap_beside_it_plans_to_stop_in_time_and_no_earlier_than_it_must():
    """Without the cost it is 7 m too late after a second."""
    robot, target = [STOP - 34.0, 0.0, 0.0, 21.0], float(SCENE.target_lane)
    humans = [[robot[0] + ahead, target, 0.0, 20.0] for ahead in (8.0, 0.0, -8.0)]
    state = jnp.asarray([robot, *humans], jnp.float32)
    plan = jax.jit(lambda state: plan_for((Naive(),), GAME, state, jnp.zeros(3, int)).robot)(state)
    x, *_, speed = np.asarray(move(GAME, state[0], plan))[:, HALF]
    assert -3.0 < x + speed**2 / (2 * GRIP) - STOP < 2.0


BRAKING = SPEED**2 / (2 * GRIP)


def test_a_car_pays_once_it_can_no_longer_stop_with_room_to_steer():
    assert cost(STOP - BRAKING - 0.1) == 0.0
    assert cost(STOP - BRAKING + CAR) == pytest.approx(1 / 1.2**4, rel=1e-3)
    assert cost(STOP - BRAKING + CAR, CONE[1], SPEED - 1.0) < cost(STOP - BRAKING + CAR)


def test_without_a_limit_of_braking_only_the_gap_counts():
    slopes = jax.grad(lambda own: stopping_cost(SCENE, np.inf, Motion(*own)).sum())(jnp.stack(motion(STOP + 1.0)))
    assert np.isfinite(slopes).all()
    assert slopes[0].any()
    assert not slopes[4].any()


@pytest.mark.parametrize("late", [0.01, 0.5, 6.0, 30.0])
def test_payoff_and_curvature_include_the_cost_at_the_price_of_a_collision(late):
    """The curvature is that of squares of r, without a jump. At 30 m, the car is passing the obstacle."""
    humans = [motion(300.0 + place, -3.3) for place in (0, 9, 18)]
    nobody = jnp.stack([jnp.stack(human) for human in humans])
    own = jnp.stack(motion(STOP - BRAKING + late, CONE[1] - 0.4 * WIDTH))
    payoff = replace(GAME, scene=SCENE).payoff
    free = replace(payoff, braking=None)

    def lateness(fields):
        return np.sqrt(float(stopping_cost(SCENE, GRIP, Motion(*own.at[:, HALF].set(fields))).sum()))

    price = 100 * lateness(own[:, HALF]) ** 2
    assert free.total(own, nobody) - payoff.total(own, nobody) == pytest.approx(price, 2e-3, 1e-3)
    bumps = 0.02 * np.eye(5, dtype=np.float32)
    slopes = np.array([(lateness(own[:, HALF] + bump) - lateness(own[:, HALF] - bump)) / 0.04 for bump in bumps])
    bent = np.moveaxis(payoff.curvature(own, nobody) - free.curvature(own, nobody), -1, 0)
    assert not bent[np.arange(STEPS) != HALF].any()
    np.testing.assert_allclose(bent[HALF], 200 * np.outer(slopes, slopes), rtol=0.05, atol=0.2)
