"""Compute the controls of drivers with learned weights on a straight road.

The best control that is held over the horizon has a closed form, `held_acceleration`
and `held_curvature`. The reward's features of traffic, of the lane and of comfort are
quadratic in a held acceleration and a held curvature, if a leader keeps its speed,
headings are small, and the attention to the leader is constant. So the best control is
a quotient of two sums over the steps. The risk of collisions, the braking of followers
and the edges of the road are left out, as they matter little while driving in a lane.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Float

from ms_highway.data.learned_drivers import RewardTraits
from ms_highway.game.features import ATTENTION_GAP, HEADING_SHARE, STANDSTILL_GAP
from ms_highway.game.scenario import PAPER_UNIT, SPEED_LIMIT, TIME_STEP
from ms_highway.game.scene import Leader
from ms_highway.geometry.curve import namespace

AnyCars = Float[Any, "*cars"]

UNIT = PAPER_UNIT  # m
TURN_SCALE = (
    1 / SPEED_LIMIT
)  # 1/m, of the planner's scaled curvature, see `ms_highway.game.scenario`
MAX_BRAKING, MAX_ACCELERATION, MAX_CURVATURE = 8.0, 4.0, 0.02  # m/s^2, m/s^2, 1/m
TIMES = TIME_STEP * np.arange(1, 6)  # s, of the steps over which a control is held

FREE_GAP = 60.0
"""Distance to the leader if none is seen [m]."""


def held_acceleration(
    weights: Mapping[str, Any], traits: RewardTraits, speed: AnyCars, leader: Leader
) -> AnyCars:
    """Return the best acceleration to hold over `TIMES`, from -8 to 4 m/s^2.

    With the speed ``v_k = v + a t_k`` and the gap ``g_k = g + (v_leader - v) t_k - a
    t_k^2 / 2`` it maximises, with the attention w to the leader and the desired speed
    s::

        sum_k -speed ((v_k - s) / s)^2 - w headway ((g_k - 2 m - headway v_k) / U)^2
              - w closing_speed ((v_k - v_leader) / s)^2 - patience comfort (a / (U / s^2))^2 / 2

    Args:
        weights: of the reward, by name, at any common scale.
        traits: of the drivers.
        speed: [m/s].
        leader: of each.
    """
    xp = namespace(traits.desired_speed, speed, leader.gap)
    wish = xp.maximum(traits.desired_speed, 1.0)
    attention = xp.where(
        leader.there, xp.exp(-xp.maximum(leader.gap, 0.0) / (ATTENTION_GAP * UNIT)), 0.0
    )
    closing = leader.speed - speed
    slope = 0.0 * speed  # a float, also for whole speeds
    bend = len(TIMES) * weights["comfort_acceleration"] * traits.patience / UNIT**2
    for time in TIMES:
        lack = (
            leader.gap + closing * time - STANDSTILL_GAP * UNIT - traits.headway * speed
        )
        change = time**2 / 2 + traits.headway * time  # of the lack, per acceleration
        slope += 2 * weights["speed"] * (wish - speed) * time / wish**2
        slope += 2 * attention * weights["headway"] * lack * change / UNIT**2
        slope += 2 * attention * weights["closing_speed"] * closing * time / wish**2
        bend += (
            2
            * (weights["speed"] + attention * weights["closing_speed"])
            * time**2
            / wish**2
        )
        bend += 2 * attention * weights["headway"] * change**2 / UNIT**2
    return xp.clip(slope / bend, -MAX_BRAKING, MAX_ACCELERATION)


def held_curvature(
    weights: Mapping[str, Any], offset: AnyCars, heading: AnyCars, speed: AnyCars
) -> AnyCars:
    """Return the best curvature to hold over `TIMES`, at most 0.02 1/m to each side.

    With the lateral position ``y_k = offset + v heading t_k + v^2 c t_k^2 / 2`` and the
    heading ``h_k = heading + v c t_k`` it maximises ``sum_k -lane_alignment (y_k / U)^2
    - (direction + 0.01 lane_alignment) h_k^2 / 2 - comfort (c U 0.6)^2 / 2``.

    Args:
        weights: of the reward, by name.
        offset: from the centre of the wanted lane, to the right [m].
        heading: relative to the lane [rad].
        speed: [m/s].
    """
    xp = namespace(offset, speed)
    straight = weights["direction"] + HEADING_SHARE * weights["lane_alignment"]
    slope = 0.0 * speed  # a float, also for whole speeds
    bend = xp.full_like(speed, len(TIMES) * weights["comfort_steering"] / TURN_SCALE**2)
    for time in TIMES:
        aside = (speed * time) ** 2 / 2
        turned = speed * time
        slope -= (
            2
            * weights["lane_alignment"]
            * (offset + speed * time * heading)
            * aside
            / UNIT**2
        )
        slope -= straight * heading * turned
        bend += (
            2 * weights["lane_alignment"] * aside**2 / UNIT**2 + straight * turned**2
        )
    return xp.clip(slope / bend, -MAX_CURVATURE, MAX_CURVATURE)
