"""Propose plans: to lanes, with speed profiles, or round obstacles."""

from typing import NamedTuple

import numpy as np
from jax import numpy as jnp

from ms_highway.geometry.curve import interpolate
from ms_highway.perception.scene import LANES, PlanFlags, PlanLanes, Plans
from ms_highway.road.traffic import Situation
from ms_highway.runtime.arrays import Controls, Index, ManyControls, Vector

CONSTANT_ACCELERATIONS = (
    -5.0,
    -3.0,
    -1.5,
    0.0,
    1.5,
    3.0,
)  # m/s^2, of profiles of constant acceleration
YIELD_TIMES = (
    0.5,
    1.5,
    3.0,
    5.0,
    np.inf,
)  # s, of profiles that yield to crossing cars which arrive within this time
OBSTACLE_SPEEDS = (
    0.3,
    0.6,
)  # shares of the desired speed, in profiles that pass an obstacle


class Profiles(NamedTuple):
    """Rules by which plans drive.

    Attributes:
        lane: target lane, 0 to 2.
        share: of the desired speed, where the plan follows the traffic.
        rate: acceleration, where the plan does not follow the traffic [m/s^2].
        follows: whether the plan follows the traffic.
        closes: whether it closes up to the car ahead, as late as is safe.
        yields: time; the plan yields to all cars that reach its route within this time
            [s].
        side: on which the plan passes obstacles in the robot's lane: -1, left; 1,
            right; 0, it does not pass them.
        given: whether the controls are given.
        controls: the given controls.
    """

    lane: PlanLanes = 1
    share: Plans = 1.0
    rate: Plans = 0.0
    follows: PlanFlags = True
    closes: PlanFlags = False
    yields: Plans = 0.0
    side: PlanLanes = 0
    given: PlanFlags = False
    controls: ManyControls = 0.0


IN_EACH_LANE = (
    Profiles(),
    Profiles(closes=True),
    *(
        Profiles(rate=acceleration, follows=False)
        for acceleration in CONSTANT_ACCELERATIONS
    ),
)
PROFILES = (
    *(profile._replace(lane=lane) for lane in range(LANES) for profile in IN_EACH_LANE),
    *(Profiles(yields=seconds) for seconds in YIELD_TIMES),
    *(
        Profiles(share=share, side=side)
        for share in OBSTACLE_SPEEDS
        for side in (-1, 1)
    ),
    Profiles(follows=False, given=True),
)
"""Profiles of all proposals; the last is the rest of the last plan."""

PROPOSALS = len(PROFILES)
LAST_PLAN = PROPOSALS - 1
"""Number of the proposal that is the rest of the last plan."""

FULL_BRAKING = tuple(
    place
    for place, profile in enumerate(PROFILES)
    if profile.rate == min(CONSTANT_ACCELERATIONS)
)
"""Numbers of the proposals that brake hardest."""


class LastPlan(NamedTuple):
    """The rest of the last plan.

    Attributes:
        controls: of the robot from now on.
        goal: x and y of the robot after the last plan in world coordinates; NaN without
            a plan.
        side: on which the plan passes an obstacle, see `Profiles`.
    """

    controls: Controls
    goal: Vector
    side: Index

    def later(self) -> "LastPlan":
        """Return the rest a step later; the last control is held."""
        return self._replace(
            controls=np.concatenate([self.controls[1:], self.controls[-1:]])
        )


def proposals(now: Situation, last: LastPlan) -> Profiles:
    """Return all proposals; the target lane of the last plan is the lane that is
    nearest to its end.
    """
    scene = now.scene
    side = jnp.where(
        now.obstruction.exists, last.side, 0
    )  # also while the last plan already returns to the lane
    x, y = last.goal
    s, d, _ = scene.route.project(x, y, jnp.zeros(()))
    nearest = jnp.where(
        jnp.isfinite(d), jnp.argmin(jnp.abs(interpolate(scene.lanes, s) - d)), 1
    )
    plans = Profiles(*map(jnp.asarray, zip(*PROFILES, strict=True)))
    return plans._replace(
        lane=jnp.where(plans.given, jnp.where(side == 0, nearest, 1), plans.lane),
        side=jnp.where(plans.given, side, plans.side),
        controls=jnp.broadcast_to(last.controls, (PROPOSALS, *last.controls.shape)),
    )
