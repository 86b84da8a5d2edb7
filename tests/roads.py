"""Roads for tests: three lanes, straight or on a circle, with traffic placed in road coordinates."""

from dataclasses import replace

import jax
import numpy as np
from jax import numpy as jnp

from ms_highway.geometry.curve import BEHIND, SPACING, Curve
from ms_highway.perception.scene import KNOTS, LANES, TRAFFIC, TRAFFIC_KNOTS, RoadScene
from ms_highway.road.constants import LANE, RoadPlanning, RoadWeights
from ms_highway.road.following import Behaviour
from ms_highway.road.plan import no_plan
from ms_highway.road.proposals import LAST_PLAN, PROPOSALS, proposals
from ms_highway.road.score import score
from ms_highway.road.simulation import advance, simulate
from ms_highway.road.traffic import situation_of
from ms_highway.runtime.compilation import jit_quickly

PLANNING, WEIGHTS = RoadPlanning(), RoadWeights()
NOBODY = np.zeros(TRAFFIC, bool)
ONE_LANE = np.tile([[False], [True], [False]], KNOTS)


def arc(knots, bend=0.0, d=0.0, start=0.0):
    """The line at lateral position d beside an arc of curvature ``bend`` through the origin, from s = start on."""
    along = (np.arange(knots) * SPACING - BEHIND) / (1 - d * bend) + start
    heading = along * bend
    x, y = (np.sin(heading) / bend, (1 - np.cos(heading)) / bend) if bend else (along, np.zeros(knots))
    own = bend / (1 - d * bend)
    arrays = (x - d * np.sin(heading), y + d * np.cos(heading), heading, np.full(knots, own))
    return Curve(*(np.asarray(array, np.float32) for array in arrays))


def winding(curvature):
    """A path with a given curvature at its knots; at s = 0 it is at the origin, and its heading is 0."""
    mean = (curvature[1:] + curvature[:-1]) / 2
    heading = np.concatenate([[0.0], np.cumsum(mean) * SPACING])
    middle = (heading[1:] + heading[:-1]) / 2
    x, y = (np.concatenate([[0.0], np.cumsum(along(middle)) * SPACING]) for along in (np.cos, np.sin))
    zero = round(BEHIND / SPACING)
    arrays = (x - x[zero], y - y[zero], heading - heading[zero], curvature)
    return Curve(*(np.asarray(array, np.float32) for array in arrays))


def scene_of(bend=0.0, robot=(0.0, 0.0, 0.0, 20.0), cars=(), limit=30.0):
    """A road of three lanes; the robot follows the middle one.

    Args:
        bend: curvature of the road [1/m].
        robot: state of its rear axle.
        cars: (s, lane, speed) of each other car, on the path of its lane (-1, 0, 1); s along the route.
        limit: speed limit [m/s].
    """
    paths = [arc(TRAFFIC_KNOTS, bend, lane * LANE, s) for s, lane, _ in cars]
    paths += [arc(TRAFFIC_KNOTS)] * (TRAFFIC - len(cars))
    present = np.arange(TRAFFIC) < len(cars)
    states = np.zeros((TRAFFIC, 4), np.float32)
    states[: len(cars), 3] = [speed for *_, speed in cars]
    lanes = np.array([-LANE, 0.0, LANE])
    return RoadScene(
        route=arc(KNOTS, bend),
        lanes=np.tile(lanes[:, None], KNOTS).astype(np.float32),
        open=np.ones((LANES, KNOTS), bool),
        edges=np.tile([[-1.5 * LANE], [1.5 * LANE]], KNOTS).astype(np.float32),
        changes=np.zeros(LANES, np.float32),
        room=np.float32(np.inf),
        robot=np.asarray(robot, np.float32),
        size=np.array([5.0, 2.0], np.float32),
        applied=np.zeros(2, np.float32),
        paths=jax.tree.map(lambda *fields: np.stack(fields), *paths),
        states=states,
        sizes=np.tile(np.array([5.0, 2.0], np.float32), (TRAFFIC, 1)),
        limits=np.full(TRAFFIC, limit, np.float32),
        leaders=np.full(TRAFFIC, -1),
        gaps=np.full(TRAFFIC, np.inf, np.float32),
        owners=np.where(present, np.arange(TRAFFIC), -1),
        moving=present.copy(),
        accelerations=np.zeros(TRAFFIC, np.float32),
    )


def country_road(*cars):
    """A road of one lane for each direction."""
    scene = scene_of(robot=(0.0, 0.0, 0.0, 8.0), cars=cars, limit=10.0)
    edges = np.tile(np.array([[-2.0], [2.0]], np.float32), KNOTS)
    return replace(scene, open=ONE_LANE, edges=edges)


def crossing():
    """A robot, and a car that will cross its route from the left at s = 40."""
    scene = scene_of(robot=(26.0, 0.0, 0.0, 8.0), cars=[(0.0, 0, 10.0)])
    along = np.arange(TRAFFIC_KNOTS) * SPACING - BEHIND - 12.0
    scene.paths.x[0], scene.paths.y[0], scene.paths.heading[0] = 40.0, along, np.pi / 2
    return scene


def wrecked(scene, car):
    """The scene with a car that has crashed."""
    scene.moving[car] = False
    return scene


def coming(scene, car):
    """The scene, on a straight road, with an oncoming car."""
    scene.paths.x[car] = 2 * scene.paths.x[car, round(BEHIND / SPACING)] - scene.paths.x[car]
    scene.paths.heading[car] += np.pi
    return scene


@jax.jit
def execute(scene, planning, controls):
    """Return the robot's states after each control, and the controls that it executed within its limits."""

    def go(state, control):
        moved, held = advance(scene, planning, state, control)
        return moved, (moved, held)

    return jax.lax.scan(go, jnp.asarray(scene.robot), controls)[1]


def behaving(follows, acceleration=0.0):
    """Others that follow by IDM, or have a given acceleration; all arrays have fixed shapes, for one program."""
    nothing = np.zeros((PROPOSALS, TRAFFIC, PLANNING.steps), np.float32)
    return Behaviour(follows, nothing + np.float32(acceleration), nothing[0], nothing[0] + np.float32(np.inf))


@jit_quickly
def driven_and_judged(scene, planning, others, plans):
    """As many plans as there are proposals, simulated and scored by one program for all tests."""
    now = situation_of(scene, planning, WEIGHTS)
    driven = simulate(now, others, plans)
    return driven, score(now, driven, plans)


def judged(scene, controls, lanes):
    """Plans with given controls [plans, steps, 2], simulated among others that keep their speed, and scored."""
    number = len(controls)
    filled = np.minimum(np.arange(PROPOSALS), number - 1)
    plans = jax.tree.map(lambda field: np.repeat(field[LAST_PLAN:], PROPOSALS, axis=0), PLANS)
    plans = plans._replace(
        lane=np.asarray(lanes, np.int32)[filled],
        controls=np.asarray(controls, np.float32)[filled],
    )
    found = driven_and_judged(scene, PLANNING, behaving(NOBODY), plans)
    return jax.tree.map(lambda field: field[:number], found)


@jit_quickly
def proposals_in(scene, last):
    """All proposals in a scene."""
    return proposals(situation_of(scene, PLANNING, WEIGHTS), last)


PLANS = jax.tree.map(np.asarray, proposals_in(scene_of(), no_plan(PLANNING)))
