"""Propose plans: to lanes, by speed profiles, or round what cannot move."""

from typing import NamedTuple

import numpy as np
from jax import numpy as jnp

from ms_highway.geometry.curve import interpolate
from ms_highway.perception.scene import LANES, Lane, PlanFlags, Plans
from ms_highway.road.traffic import Situation
from ms_highway.runtime.arrays import Controls, Index, ManyControls, Vector

CONSTANT_ACCELERATIONS = -5.0, -3.0, -1.5, 0.0, 1.5, 3.0  # m/s^2, of profiles of constant acceleration
YIELD_TIMES = 0.5, 1.5, 3.0, 5.0, np.inf  # s, of profiles that let cars pass who come until then
OBSTACLE_SPEEDS = 0.3, 0.6  # shares of the desired speed, in profiles that go round what cannot move
IN_EACH_LANE = (  # share of the desired speed, acceleration, whether it follows, and closes up as late as is safe
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
"""Numbers of those that brake hardest."""


class LastPlan(NamedTuple):
    """What a plan hands on to the next one.

    Attributes:
        controls: of the robot from now on.
        goal: x and y of where the robot is after the last plan, world coordinates; NaN without one.
        side: on which it goes round what cannot move, see `Profiles`.
    """

    controls: Controls
    goal: Vector
    side: Index

    def later(self) -> "LastPlan":
        """Return what is left of it a step later; its last control is held."""
        return self._replace(controls=np.concatenate([self.controls[1:], self.controls[-1:]]))


class Profiles(NamedTuple):
    """What plans do.

    Attributes:
        lane: that each goes to, 0 to 2.
        share: of the desired speed that it follows the traffic at.
        rate: its acceleration if it does not follow [m/s^2].
        follows: whether it follows the traffic.
        closes: whether it closes up as it follows.
        yields: it lets all cars pass that come to where they cross its route within this time [s].
        side: on which it goes round what cannot move in the robot's lane: -1, left; 1, right; 0, it does not.
        given: whether its controls are given.
        controls: those.
    """

    lane: Lane
    share: Plans
    rate: Plans
    follows: PlanFlags
    closes: PlanFlags
    yields: Plans
    side: Lane
    given: PlanFlags
    controls: ManyControls


def proposals(now: Situation, last: LastPlan) -> Profiles:
    """Return all proposals; the rest of the last plan goes to the lane that is nearest to its end."""
    given, scene = jnp.arange(PROPOSALS) == LAST_PLAN, now.scene
    side = jnp.where(now.obstruction.exists, last.side, 0)  # also where the plan leads back already
    x, y = last.goal
    s, d, _ = scene.route.project(x, y, jnp.zeros(()))
    nearest = jnp.where(jnp.isfinite(d), jnp.argmin(jnp.abs(interpolate(scene.lanes, s) - d)), 1)
    controls = jnp.broadcast_to(last.controls, (PROPOSALS, *last.controls.shape))
    plans = Profiles._make([*map(jnp.asarray, zip(*PROFILES, strict=True)), given, controls])
    lane = jnp.where(given, jnp.where(side == 0, nearest, 1), plans.lane)
    return plans._replace(lane=lane, side=jnp.where(given, side, plans.side))
