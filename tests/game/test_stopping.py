"""What plans for seconds pay where they could no longer stop before an obstacle."""

import jax
import numpy as np
import pytest
from jax import numpy as jnp

from ms_highway.game.dynamics import Motion, observe
from ms_highway.game.game import move
from ms_highway.game.scenario import GRIP, build_game
from ms_highway.game.scenarios import DENSE_MERGE
from ms_highway.game.stopping import ROOM, stopping_cost, stopping_curvature
from ms_highway.planning.human_models import Naive
from ms_highway.planning.several import plan_for

GAME = build_game(DENSE_MERGE, control_limit=DENSE_MERGE.control_limit, grip=DENSE_MERGE.grip, humans=3)
SCENE = GAME.scene
CAR, CONE = (float(size[0]) for size in (SCENE.car_size, SCENE.obstacle_size))
STOP = float(SCENE.obstacles[:, 0].min()) - (CAR + CONE) / 2 - ROOM * CAR  # m, where a car stands with room
STEPS, HALF = 20, 9


def motion(x, y=0.5, speed=20.0):
    """A car that keeps its velocity, and is at x half-way."""
    xs = x + speed * 0.1 * (np.arange(STEPS) - HALF)
    rows = [np.broadcast_to(number, STEPS) for number in (y, 0.0, speed)]
    return observe(np.stack([xs, *rows], axis=-1).astype(np.float32))


def cost(*where):
    return float(stopping_cost(SCENE, GRIP, motion(*where)))


def test_a_car_pays_from_where_it_can_no_longer_stop_with_room_to_steer_out():
    braking = 20.0**2 / (2 * GRIP)
    assert cost(STOP - braking - 0.1) == 0.0
    y = float(SCENE.obstacles[0, 1])
    assert cost(STOP - braking + 2.0, y) == pytest.approx((2.0 / CAR) ** 2, rel=0.01)  # the next cone is 3 m further
    assert cost(STOP - braking + 2.0, y, 19.0) < cost(STOP - braking + 2.0, y)


def test_a_car_that_passes_beside_an_obstacle_or_has_passed_it_pays_nothing():
    width = (float(SCENE.car_size[1]) + float(SCENE.obstacle_size[1])) / 2
    beside = float(SCENE.obstacles[0, 1]) - width
    assert cost(STOP, beside + 0.2) > cost(STOP, beside + 0.1) > 0.0
    assert cost(STOP, beside) == 0.0
    assert cost(float(SCENE.obstacles[:, 0].max()) + 20.0) == 0.0


@pytest.mark.parametrize("late", [0.01, 3.0])
def test_the_cost_bends_as_its_curvature_says_where_it_begins_and_no_less_anywhere(late):
    own = motion(STOP - 25.0 + late, -0.4)

    def at(fields):
        path = jnp.stack(own).at[:, HALF].set(fields)
        return stopping_cost(SCENE, GRIP, Motion(*path))

    bent = np.asarray(stopping_curvature(SCENE, GRIP, own))
    exact = np.asarray(jax.hessian(at)(jnp.stack([field[HALF] for field in own])))
    assert not bent[np.arange(STEPS) != HALF].any()
    assert np.linalg.eigvalsh(bent[HALF])[0] > -1e-4 * bent.max()
    np.testing.assert_allclose(bent[HALF][0, :], exact[0, :], rtol=0.1 if late < 1 else 2.0, atol=1e-3)


def test_a_robot_without_a_gap_beside_it_plans_to_stop_in_time_and_no_earlier_than_it_must():
    """Without the cost it is 7 m too late after a second."""
    robot, target = [STOP - 34.0, 0.0, 0.0, 21.0], float(SCENE.target_lane)
    humans = [[robot[0] + ahead, target, 0.0, 20.0] for ahead in (8.0, 0.0, -8.0)]
    state = jnp.asarray([robot, *humans], jnp.float32)
    plan = jax.jit(lambda state: plan_for((Naive(),), GAME, state, jnp.zeros(3, int)).robot)(state)
    x, *_, speed = np.asarray(move(GAME, state[0], plan))[:, HALF]
    assert -3.0 < x + speed**2 / (2 * GRIP) - STOP < 1.0
