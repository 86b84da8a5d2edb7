"""Stretches of road for tests: three lanes, straight or on a circle, with traffic placed in road coordinates."""

from functools import partial

import jax
import numpy as np
from jax import numpy as jnp

from ms_highway.game.road import BEHIND, KNOTS, LANES, SPACING, TRAFFIC, TRAFFIC_KNOTS, Path, RoadScene, place

LANE_WIDTH = 4.0


def arc(knots, bend=0.0, d=0.0, start=0.0):
    """The line at lateral position d along an arc of curvature ``bend`` through the origin, from s = start on."""
    along = (np.arange(knots) * SPACING - BEHIND) / (1 - d * bend) + start
    heading = along * bend
    x, y = (np.sin(heading) / bend, (1 - np.cos(heading)) / bend) if bend else (along, np.zeros(knots))
    own = bend / (1 - d * bend)
    arrays = (x - d * np.sin(heading), y + d * np.cos(heading), heading, np.full(knots, own))
    return Path(*(np.asarray(array, np.float32) for array in arrays))


def winding(curvature):
    """A path of given curvature at its knots, through the origin with heading 0 at s = 0."""
    mean = (curvature[1:] + curvature[:-1]) / 2
    heading = np.concatenate([[0.0], np.cumsum(mean) * SPACING])
    middle = (heading[1:] + heading[:-1]) / 2
    x, y = (np.concatenate([[0.0], np.cumsum(along(middle)) * SPACING]) for along in (np.cos, np.sin))
    zero = round(BEHIND / SPACING)
    arrays = (x - x[zero], y - y[zero], heading - heading[zero], curvature)
    return Path(*(np.asarray(array, np.float32) for array in arrays))


def scene_of(bend=0.0, robot=(0.0, 0.0, 0.0, 20.0), cars=(), limit=30.0, applied=(0.0, 0.0)):
    """A road of three lanes; the robot follows the middle one.

    Args:
        bend: curvature of the road [1/m].
        robot: state of its rear axle.
        cars: (s, lane, speed) of each other car, on the path of its lane (-1, 0, 1); s along the route.
        limit: speed limit [m/s].
        applied: last control of the robot.
    """
    paths = [arc(TRAFFIC_KNOTS, bend, lane * LANE_WIDTH, s) for s, lane, _ in cars]
    paths += [arc(TRAFFIC_KNOTS)] * (TRAFFIC - len(cars))
    present = np.arange(TRAFFIC) < len(cars)
    states = np.zeros((TRAFFIC, 4), np.float32)
    states[: len(cars), 3] = [speed for *_, speed in cars]
    lanes = np.array([-LANE_WIDTH, 0.0, LANE_WIDTH])
    return RoadScene(
        route=arc(KNOTS, bend),
        lanes=np.tile(lanes[:, None], KNOTS).astype(np.float32),
        open=np.ones((LANES, KNOTS), bool),
        edges=np.tile([[-1.5 * LANE_WIDTH], [1.5 * LANE_WIDTH]], KNOTS).astype(np.float32),
        speed_limit=np.full(KNOTS, limit, np.float32),
        changes=np.zeros(LANES, np.float32),
        room=np.inf,
        robot=np.asarray(robot, np.float32),
        size=np.array([5.0, 2.0], np.float32),
        applied=np.asarray(applied, np.float32),
        paths=Path(
            *(np.stack(field) for field in zip(*((p.x, p.y, p.heading, p.curvature) for p in paths), strict=True))
        ),
        states=states,
        sizes=np.tile(np.array([5.0, 2.0], np.float32), (TRAFFIC, 1)),
        present=present,
        limits=np.full(TRAFFIC, limit, np.float32),
        leaders=np.full(TRAFFIC, -1),
        gaps=np.full(TRAFFIC, np.inf, np.float32),
        owners=np.where(present, np.arange(TRAFFIC), -1),
        names=np.where(present, np.arange(TRAFFIC), -1),
        moving=present,
        priority=np.zeros(TRAFFIC, bool),
    )


@partial(jax.jit, static_argnums=1)
def _kept(scene, steps, time_step):
    def one(path, state):
        s = state[0] + state[3] * jnp.arange(1, steps + 1) * time_step
        return jnp.stack([*place(path, s, jnp.zeros_like(s)), jnp.full_like(s, state[3])])

    return jax.vmap(one)(scene.paths, scene.states)


def keeping_velocity(scene, planning):
    """World trajectories [TRAFFIC, 4, steps] of traffic that keeps its velocity along its path."""
    return _kept(scene, planning.steps, planning.time_step)
