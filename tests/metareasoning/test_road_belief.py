"""Which model drivers on a road follow: who makes way is counted on, and nobody else."""

from dataclasses import replace
from functools import partial

import jax
import numpy as np
from jax import numpy as jnp
from roads import scene_of

from ms_highway.game.road import TRAFFIC
from ms_highway.metareasoning.belief import first_belief
from ms_highway.metareasoning.road import SHOWN, counted_rungs, updated_road_belief
from ms_highway.planning.road.settings import IDM, NAIVE, TOM, TURN

STEP, STEPS = 0.2, 20
update = jax.jit(partial(updated_road_belief, time_step=STEP))
TO_THE_RIGHT = np.stack(
    [np.linspace(6, 80, STEPS), np.linspace(0, 4, STEPS), np.zeros(STEPS)], axis=-1, dtype=np.float32
)
AHEAD = TO_THE_RIGHT * np.array([1, 0, 1])


def after(acceleration, path, lane=0.0, seconds=2.0, speed=20.0):
    """Belief about a car right behind and beside the robot, which keeps an acceleration."""
    scene = scene_of(robot=(0.0, lane, 0.0, 20.0), cars=[(-12.0, 1, speed)])
    belief = first_belief(TRAFFIC)
    for _ in range(round(seconds / STEP)):
        speed += acceleration * STEP
        before, scene = scene, scene_of(robot=(0.0, lane, 0.0, 20.0), cars=[(-12.0, 1, speed)])
        belief = update(belief, before, path, scene)
    return np.asarray(belief)[0]


def test_who_brakes_where_the_robots_plan_leads_into_its_lane_makes_way():
    assert after(-1.5, TO_THE_RIGHT, seconds=1.2)[TOM] > 0.9


def test_who_does_not_is_not_counted_rungs():
    probabilities = after(0.0, TO_THE_RIGHT)
    assert probabilities[TOM] < 0.02
    np.testing.assert_allclose(probabilities[IDM], probabilities[TURN], atol=1e-3)


def test_who_runs_into_a_robot_in_its_lane_follows_neither_idm_nor_theory_of_mind():
    probabilities = after(0.0, AHEAD + np.array([0, 4, 0]), lane=4.0)
    assert probabilities[IDM] + probabilities[TOM] < 0.02


def test_whom_the_robot_does_not_concern_tells_nothing_of_how_it_answers():
    probabilities = after(0.0, AHEAD)
    np.testing.assert_allclose(probabilities[[IDM, TURN]], probabilities[TOM], atol=1e-6)


def test_belief_follows_the_car_and_starts_anew_for_others():
    before, now = scene_of(cars=[(-12.0, 1, 20.0), (40.0, 0, 20.0)]), scene_of(cars=[(40.0, 0, 20.0), (60.0, 1, 20.0)])
    now = replace(now, names=np.where(now.names == 0, 1, np.where(now.names == 1, 5, -1)))
    known = jnp.full((TRAFFIC, 4), 0.25).at[1].set(jnp.eye(4)[TOM])
    found = np.asarray(update(known, before, AHEAD, now))
    assert found[0, TOM] > 0.8
    np.testing.assert_allclose(found[1], 0.25)
    np.testing.assert_allclose(found.sum(axis=1), 1.0, atol=1e-6)


def test_only_theory_of_mind_falls_back_and_only_for_those_who_have_not_shown_it():
    rungs = np.array([TOM, TOM, TURN, IDM, NAIVE])
    probabilities = np.full((5, 4), 0.2)
    probabilities[0] = [0.1, 0.1, 0.1, 0.7]
    np.testing.assert_array_equal(counted_rungs(rungs, probabilities), [TOM, IDM, TURN, IDM, NAIVE])
    assert SHOWN > 1 / 4  # who has shown nothing is not counted on
