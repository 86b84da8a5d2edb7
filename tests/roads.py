"""Roads for tests: three lanes, straight or on a circle, with traffic placed in road
coordinates.
"""

import jax
import numpy as np
from jax import numpy as jnp

from ms_highway.geometry.curve import BEHIND, SPACING, Curve
from ms_highway.perception.scene import SHAPE, RoadScene
from ms_highway.road.road_planning import RoadPlanning
from ms_highway.road.road_weights import RoadWeights
from ms_highway.road.robot_motion import advance, bodies
from ms_highway.runtime.compilation import jit_quickly

PLANNING = RoadPlanning()
WEIGHTS = RoadWeights()
LANE = RoadPlanning.lane_width
ONE_LANE = np.tile([[False], [True], [False]], SHAPE.route_knots)


def arc(knots, bend=0.0, d=0.0, start=0.0):
    """The line at lateral position d beside an arc of curvature ``bend`` through the
    origin, from s = start on.
    """
    along = (np.arange(knots) * SPACING - BEHIND) / (1 - d * bend) + start
    heading = along * bend
    x = np.sin(heading) / bend if bend else along
    y = (1 - np.cos(heading)) / bend if bend else np.zeros(knots)
    curvature = np.full(knots, bend / (1 - d * bend))
    beside_x = x - d * np.sin(heading)
    beside_y = y + d * np.cos(heading)
    return Curve(*np.array([beside_x, beside_y, heading, curvature], np.float32))


def scene_of(bend=0.0, robot=(0.0, 0.0, 0.0, 20.0), cars=(), limit=30.0):
    """A road of three lanes; the robot follows the middle one.

    Args:
        bend: curvature of the road [1/m].
        robot: state of its rear axle.
        cars: (s, lane, speed) of each other car, on the path of its lane (-1, 0, 1); s
            along the route.
        limit: speed limit [m/s].
    """
    paths = [arc(SHAPE.path_knots, bend, lane * LANE, s) for s, lane, _ in cars]
    paths += [arc(SHAPE.path_knots)] * (SHAPE.paths - len(cars))
    present = np.arange(SHAPE.paths) < len(cars)
    states = np.zeros((SHAPE.paths, 4), np.float32)
    states[: len(cars), 3] = [speed for *_, speed in cars]
    edges = [[-1.5 * LANE], [1.5 * LANE]]
    return RoadScene(
        route=arc(SHAPE.route_knots, bend),
        lanes=np.tile([[-LANE], [0.0], [LANE]], SHAPE.route_knots).astype(np.float32),
        open=np.ones((SHAPE.lanes, SHAPE.route_knots), bool),
        edges=np.tile(edges, SHAPE.route_knots).astype(np.float32),
        changes=np.zeros(SHAPE.lanes, np.float32),
        room=np.float32(np.inf),
        robot=np.asarray(robot, np.float32),
        size=np.array([5.0, 2.0], np.float32),
        applied=np.zeros(2, np.float32),
        paths=jax.tree.map(lambda *fields: np.stack(fields), *paths),
        states=states,
        sizes=np.full((SHAPE.paths, 2), [5.0, 2.0], np.float32),
        limits=np.full(SHAPE.paths, limit, np.float32),
        leaders=np.full(SHAPE.paths, -1, np.int32),
        gaps=np.full(SHAPE.paths, np.inf, np.float32),
        owners=np.where(present, np.arange(SHAPE.paths), -1).astype(np.int32),
        moving=present.copy(),
        accelerations=np.zeros(SHAPE.paths, np.float32),
    )


def wrecked(scene, car):
    """The scene with a car that has crashed."""
    scene.moving[car] = False
    return scene


def coming(scene, car):
    """The scene, on a straight road, with an oncoming car."""
    present_x = scene.paths.x[car, round(BEHIND / SPACING)]
    scene.paths.x[car] = 2 * present_x - scene.paths.x[car]
    scene.paths.heading[car] += np.pi
    return scene


@jit_quickly
def execute(scene, planning, controls):
    """Return the robot's states after each control, its executed controls, and the
    poses of its centre.
    """

    def go(state, control):
        moved, held = advance(scene, planning, state, control)
        return moved, (moved, held)

    states, held = jax.lax.scan(go, jnp.asarray(scene.robot), controls)[1]
    return states, held, jnp.stack(bodies(scene, states), axis=-1)
