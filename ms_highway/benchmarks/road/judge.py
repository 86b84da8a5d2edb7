"""Judge drives in recorded traffic by what others have made: CommonRoad's file formats and its drivability checker."""

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from ms_highway.envs.recorded.commonroad import MOST_RADIANS, MOST_SAMPLED, open_commonroad
from ms_highway.game.road import wrapped
from ms_highway.runtime.extras import needing
from ms_highway.runtime.files import reading

LIMITS = (*MOST_SAMPLED, MOST_RADIANS)  # of a state, as in `_row`, and of its steering angle [rad]
START = 0.1  # m, rad and m/s, by which a drive may begin elsewhere than its planning problem
SLIT = 0.6  # m, of the widest slit between lanelets that is no edge of the road
BEYOND_END = 0.5  # m around the end of a lanelet, in which there is no edge of the road


@dataclass(frozen=True)
class Verdict:
    """What a drive is, until the first step at which its goal is reached, or to its end.

    Attributes:
        reached: whether the goal is reached, whatever happens on the way.
        collision: whether the car overlaps an obstacle at any step.
        off_road: whether the car, by any part of it, is over the edge of the road at any step.
        feasible: whether it begins where its planning problem does, and the kinematic single-track model of the car can
            make each of its steps.
    """

    reached: bool
    collision: bool
    off_road: bool
    feasible: bool


def judge_drive(scenario: Path, solution: Path) -> Verdict:
    """Judge a drive by the scenario that it took place in.

    Args:
        scenario: a CommonRoad scenario with the planning problem, and all others as they moved then.
        solution: a CommonRoad solution of that problem, the states of a kinematic single-track model (KS).

    Raises:
        ValueError: naming the file that is damaged, or holds something else.
        ImportError: without the packages of the extra ``judge``.
    """
    with needing("judge"):
        import shapely
        from commonroad.common.solution import vehicle_parameters
        from commonroad.geometry.shape import Rectangle
        from commonroad_dc.collision.collision_detection.pycrcc_collision_dispatch import create_collision_object
        from commonroad_dc.feasibility.feasibility_checker import state_transition_feasibility
        from commonroad_dc.feasibility.vehicle_dynamics import VehicleDynamics
    world, problems = open_commonroad(scenario)
    drive, problem = _read_drive(solution, problems.planning_problem_dict)
    states, is_reached = drive.trajectory.state_list, problem.goal.is_reached
    first = next((place for place, state in enumerate(states) if is_reached(state)), None)
    states = states[: None if first is None else first + 1]

    car, dynamics = vehicle_parameters[drive.vehicle_type], VehicleDynamics.KS(drive.vehicle_type)
    boxes = [Rectangle(car.l, car.w, state.position, float(wrapped(state.orientation))) for state in states]
    edge = road_edge(world.lanelet_network.lanelets)
    apart = _row(states[0]) - _row(problem.initial_state)
    apart[3] = wrapped(apart[3])
    return Verdict(
        reached=first is not None,
        collision=any(
            create_collision_object(other.shape).collide(create_collision_object(box))
            for box, state in zip(boxes, states, strict=True)
            for other in world.occupancies_at_time_step(state.time_step)
        ),
        off_road=bool(shapely.intersects(edge, [box.shapely_object for box in boxes]).any()),
        feasible=bool((np.abs(apart) <= START).all())
        and all(state_transition_feasibility(*both, dynamics, world.dt)[0] for both in pairwise(states)),
    )


def _read_drive(path: Path, problems: dict[int, Any]) -> tuple[Any, Any]:
    """Return the drive that a CommonRoad solution holds, and the planning problem that it solves."""
    from commonroad.common.solution import (
        CommonRoadSolutionReader,
        SolutionException,
        SolutionReaderException,
        VehicleModel,
    )

    with reading(path, "export the drive again, together with its scenario", " as a CommonRoad solution"):
        try:
            (drive,) = CommonRoadSolutionReader.open(str(path)).planning_problem_solutions
            if drive.vehicle_model is not VehicleModel.KS:
                raise ValueError(f"its model is {drive.vehicle_model.name}; only KS is judged")
            if drive.planning_problem_id not in problems:
                raise ValueError(f"the scenario has no planning problem {drive.planning_problem_id}")
            rows = np.array([(*_row(state), state.steering_angle) for state in drive.trajectory.state_list])
            if not (np.abs(rows) <= LIMITS).all():
                raise ValueError("a state is nowhere on Earth, or faster than any car")
            if rows[0, 0] < 0 or (np.diff(rows[:, 0]) != 1).any():
                raise ValueError("its steps do not follow each other from 0 on")
        except (AssertionError, AttributeError, TypeError, SolutionException, SolutionReaderException) as error:
            raise ValueError(str(error)) from error
    return drive, problems[drive.planning_problem_id]


def _row(state: Any) -> np.ndarray:
    """Return step, x, y, orientation and speed of a state."""
    return np.array([state.time_step, *state.position, state.orientation, state.velocity], dtype=float)


def road_edge(lanelets: Iterable[Any]) -> Any:
    """Return the edge of the road that lanelets of commonroad-io make, lines of shapely; it is open where they end."""
    import shapely

    # The checker's own boundaries cannot be used: some ends of the mapped road are walls there, 7 of 184 on US-101,
    # though cars come and go through them, and so are the hair-thin slits that lanelets and ramps leave between them.
    lanelets = list(lanelets)
    widened = [lanelet.polygon.shapely_object.buffer(SLIT / 2, join_style="mitre") for lanelet in lanelets]
    road = shapely.union_all(widened).buffer(-SLIT / 2, join_style="mitre")
    ends = [(one.left_vertices[-1], one.right_vertices[-1]) for one in lanelets if not one.successor]
    ends += [(one.left_vertices[0], one.right_vertices[0]) for one in lanelets if not one.predecessor]
    return road.boundary - shapely.union_all(shapely.linestrings(ends)).buffer(BEYOND_END)
