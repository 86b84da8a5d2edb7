"""Propose plans: to lanes, with speed profiles, or round obstacles."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jax import numpy as jnp

from ms_highway.geometry.curve import interpolate
from ms_highway.perception.scene import SHAPE, PerPlan, PlanFlags, PlanLanes
from ms_highway.road.traffic import Situation
from ms_highway.runtime.arrays import Controls, Index, ManyControls, Vector


class Profile(NamedTuple):
    """A rule by which a plan drives.

    Attributes:
        lane: target lane, see `SHAPE.own_lane`.
        speed_share: share of the desired speed, where the plan follows the traffic.
        acceleration: where the plan does not follow the traffic [m/s^2].
        follows: whether the plan follows the traffic.
        closes_up: whether it closes up to the car ahead, as late as is safe.
        yield_time: the plan yields to all cars that reach its route within this time
            [s].
        side: on which the plan passes obstacles in the robot's lane: -1, left; 1,
            right; 0, it does not pass them.
        is_given: whether the controls are given, as the rest of the last plan.
    """

    lane: int = SHAPE.own_lane
    speed_share: float = 1.0
    acceleration: float = 0.0
    follows: bool = True
    closes_up: bool = False
    yield_time: float = 0.0
    side: int = 0
    is_given: bool = False


class Profiles(NamedTuple):
    """Rules by which plans drive, as arrays.

    These are the fields of `Profile`, and the controls of those whose controls are
    given.
    """

    lane: PlanLanes
    speed_share: PerPlan
    acceleration: PerPlan
    follows: PlanFlags
    closes_up: PlanFlags
    yield_time: PerPlan
    side: PlanLanes
    is_given: PlanFlags
    controls: ManyControls


@dataclass(frozen=True)
class ProposalSettings:
    """Set which plans are proposed in each step."""

    accelerations: tuple[float, ...] = (-5.0, -3.0, -1.5, 0.0, 1.5, 3.0)
    """Constant accelerations, in each lane; the first one brakes hardest [m/s^2]."""
    yield_times: tuple[float, ...] = (0.5, 1.5, 3.0, 5.0, np.inf)
    """Times within which crossing cars arrive to which a plan yields [s]."""
    obstacle_speeds: tuple[float, ...] = (0.3, 0.6)
    """Speeds at which plans pass an obstacle [share of the desired speed]."""

    def profiles(self) -> tuple[Profile, ...]:
        """Return all proposals; the last is the rest of the last plan."""
        found = []
        for lane in range(SHAPE.lanes):
            found.append(Profile(lane=lane))
            found.append(Profile(lane=lane, closes_up=True))
            for acceleration in self.accelerations:
                found.append(
                    Profile(lane=lane, acceleration=acceleration, follows=False)
                )
        for seconds in self.yield_times:
            found.append(Profile(yield_time=seconds))
        for share in self.obstacle_speeds:
            for side in (-1, 1):
                found.append(Profile(speed_share=share, side=side))
        found.append(Profile(follows=False, is_given=True))
        return tuple(found)


PROFILES = ProposalSettings().profiles()
"""Profiles of all proposals; the last is the rest of the last plan."""

LAST_PLAN = len(PROFILES) - 1
"""Number of the proposal that is the rest of the last plan."""


def full_braking() -> list[int]:
    """Return the numbers of the proposals that brake hardest."""
    hardest = min(profile.acceleration for profile in PROFILES)
    return [
        number
        for number, profile in enumerate(PROFILES)
        if profile.acceleration == hardest
    ]


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
        """Return the rest a step later, which repeats the last control at its end."""
        later_controls = np.concatenate([self.controls[1:], self.controls[-1:]])
        return self._replace(controls=later_controls)


def proposals(situation: Situation, last: LastPlan) -> Profiles:
    """Return all proposals, each field [proposals].

    The target lane of the last plan is the lane that is nearest to its end.
    """
    scene = situation.scene

    # The last plan may pass an obstacle; it keeps doing so while it already returns to
    # the lane.
    side = jnp.where(situation.obstruction.exists, last.side, 0)

    # The lane in which the last plan ends, the own one without a last plan.
    x, y = last.goal
    s, d, _ = scene.route.project(x, y, jnp.zeros(()))
    nearest = jnp.argmin(jnp.abs(interpolate(scene.lanes, s) - d))
    last_lane = jnp.where(jnp.isfinite(d), nearest, SHAPE.own_lane)

    # The fields of all profiles; the last plan has the controls.
    controls = jnp.broadcast_to(last.controls, (len(PROFILES), *last.controls.shape))
    fields = [*map(jnp.asarray, zip(*PROFILES, strict=True)), controls]
    profiles = Profiles._make(fields)
    target_lane = jnp.where(side == 0, last_lane, SHAPE.own_lane)
    return profiles._replace(
        lane=jnp.where(profiles.is_given, target_lane, profiles.lane),
        side=jnp.where(profiles.is_given, side, profiles.side),
    )
