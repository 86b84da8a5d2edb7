"""Proposals keep within the limits of the car, traffic follows as in highway-env, and
the better plan is preferred.
"""

import jax
import numpy as np
import pytest
from highway_env.road.road import Road, RoadNetwork
from highway_env.vehicle.behavior import IDMVehicle
from roads import PLANNING, WEIGHTS, execute, scene_of

from ms_highway.geometry.curve import BEHIND, SPACING
from ms_highway.perception.scene import SHAPE
from ms_highway.road.following import Behaviour
from ms_highway.road.proposals import LAST_PLAN, PROFILES, Profiles
from ms_highway.road.score import score
from ms_highway.road.simulation import simulate
from ms_highway.road.traffic import situation_of
from ms_highway.runtime.compilation import jit_quickly

GRIP = float(PLANNING.grip)
DT = PLANNING.time_step
STEPS = PLANNING.steps
FOLLOWING = np.ones(SHAPE.paths, bool)
NOBODY = np.zeros(SHAPE.paths, bool)
KEEPING = (0.0, 0.0)
HARD = (0.0, -4.9)
# From a centre to the rear axle of the car behind, where the bumpers touch [m].
LENGTHS = 5.0 + 2.5
PROPOSALS = len(PROFILES)
PLANS = Profiles(
    *map(np.array, zip(*PROFILES, strict=True)), controls=np.zeros(PROPOSALS)
)
GIVEN = jax.tree.map(lambda field: np.repeat(field[LAST_PLAN:], PROPOSALS), PLANS)
OWN = 1
RIGHT = 2


@jit_quickly
def driven_and_judged(scene, others, plans):
    """As many plans as there are proposals, simulated; their preference, and whether
    they break a constraint.
    """
    now = situation_of(scene, PLANNING, WEIGHTS)
    driven = simulate(now, others, plans)
    scores = score(now, driven, plans)
    return driven, scores.preference, scores.broken


def judged(scene, controls, plans=PLANS, follows=NOBODY, acceleration=0.0):
    """Plans, simulated and scored; given plans repeat the given controls [plans, steps,
    2].

    Others follow by IDM or have an acceleration.
    """
    nothing = np.zeros((PROPOSALS, SHAPE.paths, STEPS), np.float32)
    others = Behaviour(
        follows,
        nothing + np.float32(acceleration),
        nothing[0],
        nothing[0] + np.float32(np.inf),
    )
    controls = np.resize(np.asarray(controls, np.float32), (PROPOSALS, STEPS, 2))
    return jax.tree.map(
        np.asarray, driven_and_judged(scene, others, plans._replace(controls=controls))
    )


@pytest.mark.parametrize(
    "scene",
    [
        scene_of(robot=(0.0, 0.0, 0.0, 0.0)),
        scene_of(
            robot=(0.0, 0.5, -0.05, 38.0), cars=[(30.0, 0, 10.0), (-15.0, 1, 30.0)]
        ),
        scene_of(bend=-1 / 15, robot=(0.0, 1.0, 0.2, 11.0), cars=[(20.0, 0, 5.0)]),
    ],
    ids=["standing", "fast in traffic", "circle"],
)
def test_every_step_of_a_proposal_is_within_the_limits(scene):
    wild = np.random.default_rng(0).normal(size=(STEPS, 2)) * [0.3, 10]
    rollouts, *_ = judged(scene, wild, follows=FOLLOWING)
    states = rollouts.states
    curvature, acceleration = np.moveaxis(rollouts.controls, -1, 0)
    before = np.insert(states[:, :-1, 3], 0, scene.robot[3], axis=1)
    assert np.hypot(before**2 * curvature, acceleration).max() <= GRIP + 1e-4
    assert np.abs(curvature).max() <= PLANNING.curvature
    assert states[..., 3].min() > -1e-6
    for found, controls in zip(states, rollouts.controls, strict=True):
        np.testing.assert_allclose(
            found, execute(scene, PLANNING, controls)[0], atol=0.02
        )


@pytest.mark.parametrize(("gap", "speed"), [(20.0, 20.0), (10.0, 10.0)])
def test_a_plan_that_follows_does_not_hit_a_braking_car(gap, speed):
    scene = scene_of(robot=(0.0, 0.0, 0.0, speed), cars=[(gap + LENGTHS, 0, speed)])
    rollouts, *_ = judged(scene, KEEPING, acceleration=-6.0)
    own = PLANS.follows & ~PLANS.closes_up & (PLANS.lane == OWN)
    assert (rollouts.traffic.s[own, 0] - rollouts.states[own, :, 0] - LENGTHS).min() > 0


def theirs(speed, distance, ahead):
    """Acceleration of highway-env's IDMVehicle, within its own limits, at a distance of
    centres to the car ahead.
    """
    road = Road(RoadNetwork.straight_road_network(1, speed_limit=50.0))
    car = IDMVehicle(road, [100.0, 0.0], 0.0, speed, target_speed=speed)
    other = IDMVehicle(road, [100.0 + distance, 0.0], 0.0, ahead)
    return np.clip(
        car.acceleration(car, other), -IDMVehicle.ACC_MAX, IDMVehicle.COMFORT_ACC_MAX
    )


@pytest.mark.parametrize(
    ("speed", "ahead", "distance"), [(25.0, 22.0, 60.0), (22.0, 25.0, 30.0)]
)
def test_followers_are_predicted_as_highway_env_moves_them(speed, ahead, distance):
    led = scene_of(cars=[(40.0, 1, speed), (40.0 + distance, 1, ahead)])
    led.leaders[0] = 1
    led.gaps[0] = distance
    behind = scene_of(robot=(0.0, 0.0, 0.0, ahead), cars=[(2.5 - distance, 0, speed)])
    for scene in (led, behind):
        rollouts, *_ = judged(scene, KEEPING, follows=FOLLOWING)
        acceleration = (rollouts.traffic.speed[LAST_PLAN, 0, 0] - speed) / DT
        assert acceleration == pytest.approx(theirs(speed, distance, ahead), abs=5e-3)


def changing(curvature):
    """Controls that turn for 1.2 s and turn back."""
    return np.pad(
        np.repeat([[curvature, 0.0], [-curvature, 0.0]], 6, axis=0),
        ((0, STEPS - 12), (0, 0)),
    )


def before(place):
    """A robot before a standing car."""
    return scene_of(robot=(0.0, 0.0, 0.0, 12.0), cars=[(place, 0, 0.0)])


def crossing():
    """A robot, and a car that will cross its route from the left at s = 40."""
    scene = scene_of(robot=(26.0, 0.0, 0.0, 8.0), cars=[(0.0, 0, 10.0)])
    along = np.arange(SHAPE.path_knots) * SPACING - BEHIND - 12.0
    scene.paths.x[0] = 40.0
    scene.paths.y[0] = along
    scene.paths.heading[0] = np.pi / 2
    return scene


CLOSED = scene_of()
TWICE = [changing(0.004)] * 2
CLOSED.open[RIGHT] = False
PURSUED = scene_of(
    robot=(0.0, 0.0, 0.0, 15.0), cars=[(-15.0, lane, 18.5) for lane in (0, 1)]
)


@pytest.mark.parametrize(
    ("scene", "controls", "other_lane", "broken"),
    [
        (scene_of(), (KEEPING, (0.01, 0.0)), OWN, False),
        (CLOSED, TWICE, RIGHT, False),
        (PURSUED, (KEEPING, changing(0.008)), RIGHT, False),
        (crossing(), (HARD, KEEPING), OWN, False),
        (before(75.0), (HARD, KEEPING), OWN, False),
        (before(14.0), ((0.0, -1.0), KEEPING), OWN, True),
        (before(22.5), (HARD, (0.03, 0.0)), OWN, True),
    ],
    ids=[
        "stays on the road",
        "changes to no closed lane",
        "does not cut in, though it is rear-ended",
        "stops before a crossing car",
        "keeps room to stop",
        "hits more softly",
        "hits softly rather than leaves the road",
    ],
)
def test_plans_that_break_constraints_are_not_preferred(
    scene, controls, other_lane, broken
):
    """The second of two plans breaks a constraint; the first may, too.

    Target lanes are the robot's and the other lane.
    """
    controls = [np.broadcast_to(each, (STEPS, 2)) for each in controls]
    lanes = np.resize([OWN, other_lane], PROPOSALS)
    _, preference, found = judged(scene, controls, GIVEN._replace(lane=lanes))
    assert preference[0] > preference[1] + 100
    assert found[:2].tolist() == [broken, True]
