"""Refined plans of the robot on any road."""

import jax
import numpy as np
import pytest
from jax import numpy as jnp
from roads import NOBODY, PLANNING, keeping_velocity, scene_of

from ms_highway.game.road import TRAFFIC
from ms_highway.planning.road.answers import UNIT, commuter_among
from ms_highway.planning.road.motion import bodies, centres, execute
from ms_highway.planning.road.refinement import Aim, Answered, motion_of, refine, scale_of, surroundings
from ms_highway.planning.road.refinement import earned as reward_of
from ms_highway.runtime.compilation import jit_quickly

OWN = 1
NOTHING = np.zeros((TRAFFIC, PLANNING.steps), np.float32)
STRAIGHT_ON = np.zeros((PLANNING.steps, 2), np.float32)


@jit_quickly
def refined(scene, start, others, tom, answers, lane):
    return refine(Aim(scene, PLANNING, lane, tom), start, others, answers)


@jax.jit
def slope(scene, controls, others, tom, answers):
    aim = Aim(scene, PLANNING, OWN, tom)
    return surroundings(aim, Answered(controls, answers, others))[0].reshape(-1, 2) / scale_of(aim)


@jax.jit
def earned(scene, controls, others, lane=OWN):
    aim = Aim(scene, PLANNING, lane, NOBODY)
    return reward_of(aim, motion_of(aim, execute(scene, PLANNING, controls)[1]), others)


@jit_quickly
def driven(scene, controls):
    return execute(scene, PLANNING, controls)


SCENES = {
    "free": scene_of(),
    "slow car ahead": scene_of(cars=[(40.0, 0, 10.0)]),
    "car beside": scene_of(cars=[(3.0, 1, 20.0), (-20.0, -1, 25.0)]),
    "curve": scene_of(bend=1 / 30, robot=(0.0, 0.3, 0.05, 12.0), cars=[(20.0, 0, 9.0)]),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", SCENES)
@pytest.mark.parametrize("lane", [0, 1, 2])
def test_refining_never_earns_less_and_keeps_within_limits(name, lane):
    scene = SCENES[name]
    others = keeping_velocity(scene)
    start = jnp.asarray(np.random.default_rng(lane).normal(size=(PLANNING.steps, 2)) * [0.005, 1.0], jnp.float32)
    found = refined(scene, start, others, NOBODY, NOTHING, lane)
    assert float(earned(scene, found, others, lane)) > float(earned(scene, start, others, lane))
    np.testing.assert_allclose(driven(scene, found)[1], found, atol=1e-4)


@pytest.mark.slow
def test_without_answers_the_slope_is_that_of_the_reward():
    scene = SCENES["curve"]
    others = keeping_velocity(scene)
    controls = jnp.asarray(np.random.default_rng(0).normal(size=(PLANNING.steps, 2)) * [0.002, 0.3], jnp.float32)
    found = np.asarray(slope(scene, controls, others, NOBODY, NOTHING))
    np.testing.assert_allclose(found, jax.jit(jax.grad(earned, 1))(scene, controls, others), rtol=1e-3, atol=1e-2)


def test_the_robot_keeps_to_its_lane_on_a_circle():
    scene = scene_of(bend=1 / 30, robot=(0.0, 0.0, 0.0, 10.0), applied=(1 / 30, 0.0))
    start = np.stack([np.full(PLANNING.steps, 1 / 30), np.zeros(PLANNING.steps)], -1).astype(np.float32)
    _, d, heading, speed = np.asarray(
        driven(scene, refined(scene, start, keeping_velocity(scene), NOBODY, NOTHING, OWN))[0]
    ).T
    assert np.abs(d).max() < 0.1
    assert np.abs(heading).max() < 0.05
    assert 10.5 < speed[-1] < 11.5  # sqrt(0.85 * 5 * 30) = 11.3


def test_the_robot_changes_lanes():
    scene = scene_of(robot=(0.0, 0.0, 0.0, 25.0))
    for lane, goal in ((0, -4.0), (2, 4.0)):
        states, _ = driven(scene, refined(scene, STRAIGHT_ON, keeping_velocity(scene), NOBODY, NOTHING, lane))
        assert abs(float(states[-1, 1]) - goal) < 0.3


def test_the_robot_brakes_for_a_slow_car_ahead_and_waits_for_a_car_beside():
    scene = SCENES["slow car ahead"]
    found = refined(scene, STRAIGHT_ON, keeping_velocity(scene), NOBODY, NOTHING, OWN)
    assert float(driven(scene, found)[0][-1, 3]) < 15.0
    scene = scene_of(cars=[(3.0, 1, 20.0)])
    others = keeping_velocity(scene)
    states, _ = driven(scene, refined(scene, STRAIGHT_ON, others, NOBODY, NOTHING, 2))
    x, y, _ = bodies(scene, states)
    clear = (np.abs(x - others[0, 0]) > 5.5) | (np.abs(y - others[0, 1]) > 2.3)
    assert clear.all()


MERGING = scene_of(cars=[(-5.0, 1, 20.0), (40.0, 1, 22.0)])
TOM = np.arange(TRAFFIC) < 1
CUT_IN = np.zeros((PLANNING.steps, 2), np.float32)
CUT_IN[:4, 0], CUT_IN[4:8, 0] = 0.004, -0.004


@jax.jit
def settled(controls, first):
    """The answer of car 0 to controls, and all trajectories with it."""
    scene = jax.tree.map(jnp.asarray, MERGING)
    robot, others = centres(scene, execute(scene, PLANNING, controls)[0]), keeping_velocity(scene)
    human = commuter_among(scene, PLANNING, 0, robot, others)
    found = jax.lax.fori_loop(0, 18, lambda _, scaled: human.improved(scaled), first)
    return found, others.at[0].set(human.drive(found))


def test_the_slope_through_an_answer_is_that_of_answering_again():
    base, others = settled(jnp.asarray(CUT_IN), jnp.zeros(PLANNING.steps))
    assert UNIT * base.min() > -5.9
    answers = jnp.asarray(NOTHING).at[0].set(base)
    through, alone = (slope(MERGING, CUT_IN, others, tom, answers) for tom in (TOM, NOBODY))
    for control, change in ((0, 2e-4), (1, 0.05)):
        direction = np.zeros_like(CUT_IN)
        direction[:4, control] = 1.0

        def after(way, change=change, direction=direction):
            controls = jnp.asarray(CUT_IN + way * change * direction)
            return float(earned(MERGING, controls, settled(controls, base)[1], OWN))

        difference = (after(1) - after(-1)) / (2 * change)
        share = float(jnp.sum((through - alone) * direction))
        assert float(jnp.sum(through * direction)) == pytest.approx(
            difference, abs=0.05 * abs(share) + 0.02 * abs(difference)
        )
        assert abs(share) > 1e-3


def test_plans_count_on_those_who_answer():
    others = keeping_velocity(MERGING)
    counting, alone = (np.asarray(refined(MERGING, CUT_IN, others, tom, NOTHING, 2)) for tom in (TOM, NOBODY))
    assert np.isfinite(counting).all()
    assert np.abs(counting - alone)[:, 1].max() > 0.1
