"""Compute the controls of drivers with learned weights on a straight road.

The best control that is held over the horizon has a closed form, `held_acceleration`
and `held_curvature`. The reward's features of traffic, of the lane and of comfort are
quadratic in a held acceleration and a held curvature, if a leader keeps its speed,
headings are small, and the attention to the leader is constant. So the best control is
a quotient of two sums over the steps. The risk of collisions, the braking of followers
and the edges of the road are left out, as they matter little while driving in a lane.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from ms_highway.data.learned_drivers import RewardTraits
from ms_highway.game.car_following import CAR_LIMITS
from ms_highway.game.features import FOLLOWING, HEADING_SHARE
from ms_highway.game.scenario import PAPER_UNIT, SPEED_LIMIT, TIME_STEP
from ms_highway.game.scene import Leader
from ms_highway.geometry.curve import namespace
from ms_highway.runtime.arrays import Numeric

AnyCars = Float[Any, "*cars"]


@dataclass(frozen=True)
class HeldControl:
    """Set how learned drivers hold a control."""

    steps: int = 5
    """Number of steps over which they hold it, as in the paper's plans."""
    max_curvature: float = 0.02
    """Largest curvature to each side [1/m]."""
    free_gap: float = 60.0
    """Gap to the leader where none is seen [m]; such a leader has no attention."""
    turn_scale: float = 1 / SPEED_LIMIT
    """Unit of curvature in the comfort of steering [1/m], the planner's, see
    `ms_highway.game.scenario`.
    """

    @property
    def times(self) -> Float[np.ndarray, "steps"]:
        """Time after each step [s]."""
        return TIME_STEP * np.arange(1, self.steps + 1)


HELD_CONTROL = HeldControl()


def held_acceleration(
    weights: Mapping[str, Numeric],
    traits: RewardTraits,
    speed: AnyCars,
    leader: Leader,
) -> AnyCars:
    """Return the best acceleration to hold, from -8 to 4 m/s^2 (`CAR_LIMITS`).

    With the speed ``v_k = v + a t_k`` and the gap ``g_k = g + (v_leader - v) t_k - a
    t_k^2 / 2`` it maximises, with the attention w to the leader, the desired speed s
    and the unit of lengths U::

        sum_k - speed ((v_k - s) / s)^2
              - w headway ((g_k - 2 m - headway v_k) / U)^2
              - w closing_speed ((v_k - v_leader) / s)^2
              - patience comfort (a / (U / s^2))^2 / 2

    This is ``constant + slope a - concavity a^2 / 2``, whose top is at ``slope /
    concavity``.

    Args:
        weights: of the reward, by name, at any common scale.
        traits: of the drivers.
        speed: [m/s].
        leader: of each.
    """
    xp = namespace(traits.desired_speed, speed, leader.gap)
    unit = PAPER_UNIT
    desired_speed = xp.maximum(traits.desired_speed, 1.0)
    gap = xp.maximum(leader.gap, 0.0)
    attention = xp.where(
        leader.there, xp.exp(-gap / (FOLLOWING.attention_gap * unit)), 0.0
    )
    closing = leader.speed - speed

    # Comfort alone makes the reward concave, whatever the traffic.
    times = HELD_CONTROL.times
    slope = 0.0 * speed  # a float, also for whole speeds
    concavity = len(times) * weights["comfort_acceleration"] * traits.patience / unit**2
    for time in times:
        # How far the gap exceeds the desired one without acceleration, and how much
        # less it does per acceleration.
        excess = leader.gap + closing * time - FOLLOWING.standstill_gap * unit
        excess = excess - traits.headway * speed
        per_acceleration = time**2 / 2 + traits.headway * time

        slope += (
            2 * weights["speed"] * (desired_speed - speed) * time / desired_speed**2
        )
        slope += (
            2 * attention * weights["headway"] * excess * per_acceleration / unit**2
        )
        slope += (
            2 * attention * weights["closing_speed"] * closing * time / desired_speed**2
        )
        of_speeds = weights["speed"] + attention * weights["closing_speed"]
        concavity += 2 * of_speeds * time**2 / desired_speed**2
        concavity += 2 * attention * weights["headway"] * per_acceleration**2 / unit**2
    return xp.clip(slope / concavity, -CAR_LIMITS.braking, CAR_LIMITS.acceleration)


def held_curvature(
    weights: Mapping[str, Numeric],
    offset: AnyCars,
    heading: AnyCars,
    speed: AnyCars,
) -> AnyCars:
    """Return the best curvature to hold, at most 0.02 1/m to each side.

    With the lateral position ``y_k = offset + v heading t_k + v^2 c t_k^2 / 2`` and the
    heading ``h_k = heading + v c t_k`` it maximises ``sum_k -lane_alignment (y_k / U)^2
    - (direction + 0.01 lane_alignment) h_k^2 / 2 - comfort (c U 0.6)^2 / 2``, as
    `held_acceleration` does.

    Args:
        weights: of the reward, by name.
        offset: from the centre of the wanted lane, to the right [m].
        heading: relative to the lane [rad].
        speed: [m/s].
    """
    xp = namespace(offset, speed)
    unit = PAPER_UNIT
    alignment = weights["lane_alignment"]
    straightness = weights["direction"] + HEADING_SHARE * alignment

    times = HELD_CONTROL.times
    comfort = len(times) * weights["comfort_steering"] / HELD_CONTROL.turn_scale**2
    slope = 0.0 * speed  # a float, also for whole speeds
    concavity = xp.full_like(speed, comfort)
    for time in times:
        # Lateral position and heading per curvature.
        aside = (speed * time) ** 2 / 2
        turned = speed * time

        slope -= 2 * alignment * (offset + speed * time * heading) * aside / unit**2
        slope -= straightness * heading * turned
        concavity += 2 * alignment * aside**2 / unit**2 + straightness * turned**2
    most = HELD_CONTROL.max_curvature
    return xp.clip(slope / concavity, -most, most)
