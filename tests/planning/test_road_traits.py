"""What drivers are like, estimated from how they follow: desired speed and headway."""

from dataclasses import replace
from functools import partial

import jax
import numpy as np
import pytest
from jax import numpy as jnp
from roads import PLANNING, judged, scene_of

from ms_highway.game.road import TRAFFIC, Traits
from ms_highway.planning.car_following import idm_acceleration
from ms_highway.planning.road.answers import commuter_of
from ms_highway.planning.road.traits import prior, traits_of, updated_traits

STEP = 0.2
FAR_BEHIND = (-150.0, 0.0, 0.0, 10.0)  # robot

update = jax.jit(partial(updated_traits, time_step=STEP))


def road(places, speeds, names=None, robot=FAR_BEHIND):
    """Cars in the right lane, each behind the one before; the first one leads."""
    scene = scene_of(robot=robot, cars=[(place, 1, speed) for place, speed in zip(places, speeds, strict=True)])
    leaders, gaps = np.full(TRAFFIC, -1), np.full(TRAFFIC, 1e3, np.float32)
    leaders[1 : len(places)] = np.arange(len(places) - 1)
    gaps[1 : len(places)] = -np.diff(places)
    names = scene.names if names is None else np.array([*names, *[-1] * (TRAFFIC - len(places))])
    return replace(scene, leaders=leaders, gaps=gaps, names=names)


def learned(desired, headway, seconds, leader, speed=20.0, gap=45.0):
    """Estimates of the traits of a car that follows by IDM, from its motion behind a leader of a given speed."""
    places, speeds = np.array([0.0, -gap]), np.array([leader(0.0), speed])
    scene = road(places, speeds)
    estimates = prior(scene)
    for step in range(1, round(seconds / STEP)):
        gap, closing = (jnp.float32(value) for value in (places[0] - places[1], speeds[0]))
        acceleration = float(idm_acceleration(jnp.float32(speeds[1]), desired, gap, closing, headway))
        places, speeds = places + speeds * STEP, np.array([leader(step * STEP), speeds[1] + acceleration * STEP])
        before, scene = scene, road(places, speeds)
        estimates = update(estimates, before, scene)
    traits = traits_of(estimates.mean)
    return float(traits.speed[1]), float(traits.headway[1])


@pytest.mark.parametrize("desired", [18.0, 23.0, 31.0])
def test_the_desired_speed_of_a_car_on_a_free_road_is_learned_in_three_seconds(desired):
    found, _ = learned(desired, 1.5, 3.0, lambda _: 45.0, speed=min(desired, 24.0), gap=400.0)
    assert found == pytest.approx(desired, rel=0.05)


@pytest.mark.parametrize("headway", [0.9, 2.2])
def test_the_headway_of_a_car_that_follows_is_learned(headway):
    _, found = learned(32.0, headway, 12.0, lambda time: 18.0 + 3 * np.sin(time), gap=20.0 + 20 * headway)
    assert found == pytest.approx(headway, rel=0.2)


def test_a_car_behind_the_robot_is_seen_to_follow_it():
    robot = (0.0, 4.0, 0.0, 15.0)  # in the lane of the car
    before, now = (road([-30.0], [speed], robot=robot) for speed in (20.0, 19.3))
    blind = [replace(scene, robot=np.asarray(FAR_BEHIND, np.float32)) for scene in (before, now)]
    followed, free = (
        traits_of(update(prior(first), first, second).mean) for first, second in ((before, now), tuple(blind))
    )
    assert free.speed[0] < followed.speed[0] - 1.0  # who brakes without a reason wants to be slow


def test_estimates_belong_to_cars_and_not_to_places():
    before = road([0.0, -100.0], [22.0, 22.0], names=[7, 8])
    now = road([4.4, 100.0, -95.6], [22.0, 25.0, 22.0], names=[8, 9, 7])
    estimates = prior(before)._replace(mean=jnp.log(jnp.tile(jnp.array([[20.0], [1.0]]), TRAFFIC)).at[0, 1].set(3.4))
    found = update(estimates, before, now)
    assert found.mean[0, 0] > found.mean[0, 2] + 0.1
    np.testing.assert_array_equal(found.mean[:, 1], prior(now).mean[:, 1])
    np.testing.assert_array_equal(found.covariance[..., 1], prior(now).covariance[..., 1])


def test_what_cannot_move_teaches_nothing():
    scene = replace(road([30.0], [0.0]), moving=np.zeros(TRAFFIC, bool))
    found = update(prior(scene), scene, scene)
    np.testing.assert_array_equal(found.mean, prior(scene).mean)


def test_predictions_by_idm_and_rewards_of_drivers_take_their_traits():
    scene = road([30.0], [20.0])
    known = [replace(scene, traits=Traits(*np.full((2, TRAFFIC), [[speed], [1.5]], np.float32))) for speed in (20, 30)]

    def along(scene):
        driven, _ = judged(scene, np.zeros((1, PLANNING.steps, 2), np.float32), np.ones(1, int), scene.moving)
        return driven.along[0, 0, -1]

    calm, eager = (float(along(one)) for one in known)
    assert calm == pytest.approx(float(along(scene)), abs=1e-3)  # without traits the present speed is the desired one
    assert eager > calm + 5.0
    human = commuter_of(known[1], PLANNING, 0)
    assert float(human.reward.speed_limit) == 30.0
    assert float(human.reward.headway) == 1.5
