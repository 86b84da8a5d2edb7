"""The package's scenarios: three of the paper with one human, and some with several.

The first sentence behind each of them describes it in ``notebooks/REFERENCE.md``.

The paper gives positions in a unit of 100/3 m, ``UNIT``.
"""

from dataclasses import replace
from math import sqrt
from typing import Any

from ms_highway.game.scenario import (
    COMMON_WEIGHTS,
    GRIP,
    PHYSICAL_LIMIT,
    SPEED_LIMIT,
    Scenario,
    Stream,
)
from ms_highway.game.scenario import PAPER_UNIT as UNIT
from ms_highway.numerics.solvers import PlanningSettings

STAY_BACK = Scenario(
    name="stay_back",
    lanes=(-0.14 * UNIT, 0.0),
    cars=((-0.9 * UNIT, -0.14 * UNIT), (-0.9 * UNIT, 0.0)),
    steps=35,
    ladder=("naive", "turn"),
    prices=(5.0, 0.4),
    robot_weights=COMMON_WEIGHTS,
    human_weights=COMMON_WEIGHTS,
    cones=(
        (-0.25 * UNIT, -0.18 * UNIT),
        (-0.2 * UNIT, -0.17 * UNIT),
        (-0.15 * UNIT, -0.15 * UNIT),
        (-0.1 * UNIT, -0.15 * UNIT),
        (-0.1 * UNIT, 0.01 * UNIT),
        (-0.15 * UNIT, 0.01 * UNIT),
        (-0.2 * UNIT, 0.03 * UNIT),
        (-0.25 * UNIT, 0.04 * UNIT),
    ),
)
"""The robot on the left and the human on the right approach cones that only one car at
a time can pass.
"""

MERGER = Scenario(
    name="merger",
    lanes=(-0.1 * UNIT, 0.0),
    cars=((-0.1 * UNIT, 0.0), (-0.2 * UNIT, -0.1 * UNIT), (0.05 * UNIT, -0.1 * UNIT)),
    steps=40,
    ladder=("naive", "turn", "tom"),
    prices=(0.6, 0.1),
    robot_weights=COMMON_WEIGHTS | {"target_lane": 150, "merged": 5},
    human_weights=COMMON_WEIGHTS | {"target_lane": 1000, "gap": 70},
    human_gap=0.25 * UNIT,
    merging_car=0,
)
"""The robot on the right wants into the left lane, between a scripted car and the human
behind it.

The gap is too small unless the human yields.
"""

GIVE_WAY = Scenario(
    name="give_way",
    lanes=(-0.1 * UNIT, 0.0),
    cars=(
        (-0.275 * UNIT, -0.1 * UNIT),
        (-0.275 * UNIT, 0.0),
        (0.05 * UNIT, -0.1 * UNIT),
        (-0.6 * UNIT, -0.1 * UNIT),
    ),
    steps=40,
    ladder=("naive", "turn", "tom"),
    prices=(0.03, 0.01),
    robot_weights=COMMON_WEIGHTS
    | {
        "target_lane": 1000,
        "gap": 10,
        "partner_target_lane": 350,
        "partner_merged": 5,
    },
    human_weights=COMMON_WEIGHTS | {"target_lane": 0.7 * 150},
    robot_gap=0.325 * UNIT,
    merging_car=1,
    corner=0.675 / sqrt(2),
)
"""The robot drives in the left lane between two scripted cars; the human beside it
wants to merge.

The robot is paid for letting the human in.
"""


def _physical(scenario: Scenario, horizon: int, **changes: Any) -> Scenario:
    """Return version 1 of a scenario: all plan and drive within the grip of tyres.

    Args:
        scenario: version 0.
        horizon: steps of plans; the paper's half a second is too short to brake or to
            go round anything.
        changes: other attributes that differ.
    """
    name = scenario.name.replace("_", "-") + "-v1"
    physical = replace(
        scenario,
        name=name,
        semantics="physical",
        grip=GRIP,
        solver="convex_newton",
        prices=(10.0, 1.0),
    )
    return replace(physical, planning=PlanningSettings(horizon=horizon), **changes)


STAY_BACK_V1 = _physical(
    STAY_BACK,
    20,
    cars=((-1.24 * UNIT, -0.14 * UNIT), (-1.05 * UNIT, 0.0, 0.045 * UNIT)),
    steps=60,
)
"""Stay Back within what tyres hold: plans last two seconds, and the human starts ahead
of the robot.

The robot starts 32 m before the cones. The human starts 6.3 m ahead of it and drives
1.5 m/s faster. Within the grip of tyres, one car has to slow down in time for the other
one. Nearer starts leave no room for that. From 1.3 m farther back, all models earn the
same.

The human's start lies between starts of 6.0 to 6.5 m ahead, from which naive plans
collide in most of 32 or 48 episodes (seeds 1000 and up) and those under turn in none.
From 5.8 m ahead, both collide; from 7 m ahead, those under turn do in one of 48.
"""

MERGER_V1 = _physical(MERGER, 10)
"""Merger within what tyres hold: plans last a second."""

GIVE_WAY_V1 = _physical(GIVE_WAY, 10)
"""Give Way within what tyres hold: plans last a second."""


def _lane_end(first_cone: float) -> tuple[tuple[float, float], ...]:
    """Return the cones that end the robot's lane, from a first x [paper units]."""
    return tuple(
        ((first_cone + 0.09 * place) * UNIT, 0.02 * UNIT) for place in range(3)
    )


def _merge_among_several(
    name: str,
    steps: int,
    lanes: tuple[float, ...],
    first_cone: float,
    streams: tuple[Stream, ...],
) -> Scenario:
    """Return a scenario in which the robot's lane ends.

    Plans look two seconds ahead, as merging takes long, within what tyres hold on a dry
    road.
    """
    sharpest, _ = PHYSICAL_LIMIT
    return Scenario(
        name=name,
        lanes=lanes,
        cars=((0.0, 0.0),),
        steps=steps,
        ladder=("naive", "turn", "tom"),
        prices=(10.0, 1.0),
        robot_weights=COMMON_WEIGHTS | {"target_lane": 150, "merged": 5},
        human_weights=COMMON_WEIGHTS,
        cones=_lane_end(first_cone),
        streams=streams,
        humans=8,
        caution=0.3,
        planning=PlanningSettings(horizon=20),
        solver="convex_newton",
        control_limit=(sharpest, GRIP),
        grip=GRIP,
        way_out=True,
    )


DENSE_MERGE = _merge_among_several(
    "dense_merge", 80, (-0.1 * UNIT, 0.0), 2.0, (Stream(-0.1 * UNIT),)
)
"""The robot's lane ends; it has to get into a stream of humans in the lane beside it.

Most gaps in the stream are too short for a car unless a human yields.
"""

CROSSING_CROWD = _merge_among_several(
    "crossing_crowd",
    100,
    (-0.2 * UNIT, -0.1 * UNIT, 0.0),
    1.5,
    (Stream(-0.1 * UNIT, 0.95 * SPEED_LIMIT), Stream(-0.2 * UNIT, 1.05 * SPEED_LIMIT)),
)
"""The robot crosses one stream of humans to join another, so that other humans matter
early and late.

Its own lane ends, and it wants into the left lane. At first, the humans in the middle
lane matter: the robot has to get between them before the cones. Later, those in the
left lane do; they drive faster, so that the robot meets others there than its
neighbours at the start.
"""


def _several_v1(
    scenario: Scenario,
    first_cone: float,
    spacing: tuple[float, float],
) -> Scenario:
    """Return version 1 of a scenario with several humans, of six seconds.

    All humans yield to a car that merges. The robot is careful: it enters only gaps
    that it expects to open.

    Args:
        scenario: version 0.
        first_cone: x of the first cone, in the paper's unit.
        spacing: in all streams, shortest and longest [m].
    """
    return _physical(
        scenario,
        10,
        ladder=("naive", "tom"),
        robot_weights={**scenario.robot_weights, "collision_risk": -4},
        caution=1.0,
        careless=0.0,
        steps=60,
        cones=_lane_end(first_cone),
        streams=tuple(replace(stream, spacing=spacing) for stream in scenario.streams),
    )


DENSE_MERGE_V1 = _several_v1(DENSE_MERGE, 2.5, (7.0, 13.0))
"""A careful robot merges into a dense stream of yielding humans; plans last a second,
within tyre grip.

The stream is denser than in version 0, and the cones are farther away. Spacing and
speed were chosen so that naive plans succeed in less than half of the episodes, and
theory of mind in nearly all.
"""

CROSSING_CROWD_V1 = _several_v1(CROSSING_CROWD, 2.75, (6.5, 12.5))
"""A careful robot crosses a stream of yielding humans and joins another; plans last a
second, within tyre grip.

Both streams are denser than in version 0, the cones are farther away, and there are six
seconds to arrive. Spacing, cones and time were chosen so that naive plans fail in a
quarter of the episodes, and theory of mind in few.
"""

PACKAGE_SCENARIOS = {
    scenario.name: scenario
    for scenario in (
        STAY_BACK,
        MERGER,
        GIVE_WAY,
        DENSE_MERGE,
        CROSSING_CROWD,
        STAY_BACK_V1,
        MERGER_V1,
        GIVE_WAY_V1,
        DENSE_MERGE_V1,
        CROSSING_CROWD_V1,
    )
}
"""The package's scenarios by name, those of `ms_highway.runtime.names.SCENARIO_NAMES`.
"""
