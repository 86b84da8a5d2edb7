"""The cost of plans for seconds that could no longer stop before an obstacle."""

from dataclasses import replace

import jax
import numpy as np
import pytest
from driving import dense_merge

from ms_highway.game.dynamics import Motion, observe
from ms_highway.game.game import move, swap_roles
from ms_highway.game.payoff import STOPPING, stopping_cost
from ms_highway.game.scenario import GRIP, build_game
from ms_highway.game.scenarios import DENSE_MERGE
from ms_highway.planning.compiled_plans import CompiledPlans
from ms_highway.planning.human_models import Naive

GAME = dense_merge(1)
SCENE = replace(GAME.scene, obstacles=GAME.scene.obstacles[:1])
(CONE,) = SCENE.obstacles
CAR, CAR_WIDTH = SCENE.car_size
LENGTH, TOUCH = (SCENE.car_size + SCENE.obstacle_size) / 2
WIDTH = (
    TOUCH + STOPPING.lateral_gap * CAR_WIDTH
)  # m, at which an obstacle is out of the way
SPEED = 20.0
STOP = CONE[0] - LENGTH - STOPPING.room * CAR  # m, where a car stands with room
STEPS = 20
HALF = 9


def motion(x, y=CONE[1], speed=SPEED):
    """A car that keeps its velocity, and is at x half-way."""
    xs = x + speed * 0.1 * (np.arange(STEPS) - HALF)
    return observe(
        np.stack(np.broadcast_arrays(xs, y, 0.0, speed), axis=-1).astype(np.float32)
    )


late = jax.jit(stopping_cost)


def cost(*where):
    return np.sum(late(SCENE, GRIP, motion(*where)))


def test_a_car_beside_or_beyond_an_obstacle_pays_nothing():
    assert cost(STOP, CONE[1] - 0.8 * WIDTH) > cost(STOP, CONE[1] - 0.9 * WIDTH) > 0.0
    assert cost(STOP, CONE[1] - 1.01 * WIDTH) == 0.0
    assert cost(CONE[0] + 0.5 * LENGTH) > 0.0
    assert cost(CONE[0] + 1.01 * LENGTH) == 0.0


@pytest.mark.parametrize(
    ("grip", "limit", "braking"), [(3.0, 8.0, 3.0), (8.0, 3.0, 3.0), (None, 8.0, 8.0)]
)
def test_plans_count_on_the_braking_that_their_limits_allow(grip, limit, braking):
    planner = replace(
        GAME.planner, grip=grip, control_limit=np.array([0.2, limit], np.float32)
    )
    assert replace(GAME, planner=planner).payoff.braking == braking


def test_only_plans_for_seconds_where_there_are_obstacles_keep_room():
    assert build_game(DENSE_MERGE, solver="gradient").payoff.braking is None
    assert (
        swap_roles(GAME).payoff.braking == GAME.payoff.braking
    )  # humans with the published reward pay, too
    assert (
        replace(GAME, scene=replace(SCENE, obstacles=np.zeros((0, 2)))).payoff.braking
        is None
    )


def test_a_robot_without_a_gap_stops_just_in_time():
    """Without the cost it is 7 m too late after a second."""
    place = STOP - 34.0
    others = [
        [place + ahead, SCENE.target_lane, 0.0, 20.0] for ahead in (8.0, 0.0, -8.0)
    ]
    state = np.float32([[place, 0.0, 0.0, 21.0], *others])
    solution, _ = CompiledPlans(GAME, [Naive()]).plan(state, [0])
    x, *_, speed = np.asarray(move(GAME, state[0], solution.plan.robot))[:, HALF]
    assert -3.0 < x + speed**2 / (2 * GRIP) - STOP < 2.0


BRAKING = SPEED**2 / (2 * GRIP)


def test_a_car_pays_once_it_stops_too_late_to_steer():
    assert cost(STOP - BRAKING - 0.1) == 0.0
    assert cost(STOP - BRAKING + CAR) == pytest.approx(1 / 1.2**4, rel=1e-3)
    assert cost(STOP - BRAKING + CAR, CONE[1], SPEED - 1.0) < cost(STOP - BRAKING + CAR)


def test_without_a_limit_of_braking_only_the_gap_counts():
    slopes = jax.jit(
        jax.grad(lambda own: stopping_cost(SCENE, np.inf, Motion(*own)).sum())
    )(np.stack(motion(STOP + 1)))
    assert np.isfinite(slopes).all()
    assert slopes[0].any()
    assert not slopes[4].any()


@jax.jit
def price_and_bend(payoff, own, others):
    """What room to stop changes in a payoff and in its curvature."""
    free = replace(payoff, braking=None)
    price = free.total(own, others) - payoff.total(own, others)
    return price, payoff.curvature(own, others) - free.curvature(own, others)


@pytest.mark.parametrize("metres", [0.01, 0.5, 6.0, 30.0])
def test_payoff_and_curvature_include_the_cost_of_stopping_late(metres):
    """The curvature is that of squares of r, without a jump.

    At 30 m, the car is passing the obstacle.
    """
    own = np.stack(motion(STOP - BRAKING + metres, CONE[1] - 0.4 * WIDTH))
    others = np.stack(motion(300.0, -3.3))[None]

    def lateness(change):
        changed = own.copy()
        changed[:, HALF] += change
        return np.sqrt(np.sum(late(SCENE, GRIP, Motion(*changed))))

    price, bent = price_and_bend(replace(GAME, scene=SCENE).payoff, own, others)
    assert price == pytest.approx(100 * lateness(0) ** 2, 2e-3, 1e-3)
    bumps = 0.02 * np.eye(5, dtype=np.float32)
    changes = np.array([lateness(bump) - lateness(-bump) for bump in bumps])
    slopes = changes / 0.04
    assert not np.delete(bent, HALF, axis=-1).any()
    np.testing.assert_allclose(
        bent[..., HALF], 200 * np.outer(slopes, slopes), rtol=0.05, atol=0.2
    )
