"""Propose plans: to lanes, with speed profiles, or round obstacles."""

from typing import NamedTuple

import numpy as np
from jax import numpy as jnp

from ms_highway.geometry.curve import interpolate
from ms_highway.perception.scene import LANES, PlanFlags, PlanLanes, Plans
from ms_highway.road.traffic import Situation
from ms_highway.runtime.arrays import Controls, Index, ManyControls, Vector

CONSTANT_ACCELERATIONS = -5.0, -3.0, -1.5, 0.0, 1.5, 3.0  # m/s^2, of profiles of constant acceleration
YIELD_TIMES = 0.5, 1.5, 3.0, 5.0, np.inf  # s, of profiles that yield to crossing cars which arrive within this time
OBSTACLE_SPEEDS = 0.3, 0.6  # shares of the desired speed, in profiles that pass an obstacle
IN_EACH_LANE = (  # share of the desired speed, acceleration, whether the plan follows, and whether it closes up
    (1.0, 0.0, True, False),
    (1.0, 0.0, True, True),
    *((1.0, acceleration, False, False) for acceleration in CONSTANT_ACCELERATIONS),
)
PROFILES = (
    *((lane, *profile, 0.0, 0) for lane in range(LANES) for profile in IN_EACH_LANE),
    *((1, 1.0, 0.0, True, False, seconds, 0) for seconds in YIELD_TIMES),
    *((1, share, 0.0, True, False, 0.0, side) for share in OBSTACLE_SPEEDS for side in (-1, 1)),
    (1, 1.0, 0.0, False, False, 0.0, 0),  # the rest of the last plan
)
"""Profiles of all proposals: the fields of `Profiles` up to ``side``."""

PROPOSALS = len(PROFILES)
LAST_PLAN = PROPOSALS - 1
"""Number of the proposal that is the rest of the last plan."""

FULL_BRAKING = tuple(number for number, profile in enumerate(PROFILES) if profile[2] == min(CONSTANT_ACCELERATIONS))
"""Numbers of the proposals that brake hardest."""


class LastPlan(NamedTuple):
    """The rest of the last plan.

    Attributes:
        controls: of the robot from now on.
        goal: x and y of the robot after the last plan in world coordinates; NaN without a plan.
        side: on which the plan passes an obstacle, see `Profiles`.
    """

    controls: Controls
    goal: Vector
    side: Index

    def later(self) -> "LastPlan":
        """Return the rest a step later; the last control is held."""
        return self._replace(controls=np.concatenate([self.controls[1:], self.controls[-1:]]))


class Profiles(NamedTuple):
    """Rules by which plans drive.

    Attributes:
        lane: target lane, 0 to 2.
        share: of the desired speed, where the plan follows the traffic.
        rate: acceleration, where the plan does not follow the traffic [m/s^2].
        follows: whether the plan follows the traffic.
        closes: whether it closes up to the car ahead, as late as is safe.
        yields: time; the plan yields to all cars that reach its route within this time [s].
        side: on which the plan passes obstacles in the robot's lane: -1, left; 1, right; 0, it does not pass them.
        given: whether the controls are given.
        controls: the given controls.
    """

    lane: PlanLanes
    share: Plans
    rate: Plans
    follows: PlanFlags
    closes: PlanFlags
    yields: Plans
    side: PlanLanes
    given: PlanFlags
    controls: ManyControls


def proposals(now: Situation, last: LastPlan) -> Profiles:
    """Return all proposals; the target lane of the last plan is the lane that is nearest to its end."""
    given, scene = jnp.arange(PROPOSALS) == LAST_PLAN, now.scene
    side = jnp.where(now.obstruction.exists, last.side, 0)  # also while the last plan already returns to the lane
    x, y = last.goal
    s, d, _ = scene.route.project(x, y, jnp.zeros(()))
    nearest = jnp.where(jnp.isfinite(d), jnp.argmin(jnp.abs(interpolate(scene.lanes, s) - d)), 1)
    controls = jnp.broadcast_to(last.controls, (PROPOSALS, *last.controls.shape))
    plans = Profiles._make([*map(jnp.asarray, zip(*PROFILES, strict=True)), given, controls])
    lane = jnp.where(given, jnp.where(side == 0, nearest, 1), plans.lane)
    return plans._replace(lane=lane, side=jnp.where(given, side, plans.side))
