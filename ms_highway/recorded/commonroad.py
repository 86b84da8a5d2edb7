"""Read CommonRoad scenarios of format 2020a, such as those of the US-101 highway.

A file becomes a `TrafficRecording` in three steps: `read_xml` unpacks it, `_recording`
checks its header and collects its elements, and one function for each kind of element
makes a record of it. What differs between versions of the format stands in
`CommonRoadFormat`.

This module parses the XML elements itself: commonroad-io drops parts of shapes (which
ones depends on its version), replaces missing numbers by zeros, and raises errors that
do not name the element.
"""

import gzip
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from math import tau
from pathlib import Path
from xml.etree.ElementTree import Element, fromstring

import numpy as np

from ms_highway.game.scenario import TIME_STEP
from ms_highway.recorded.elements import (
    LARGEST_NUMBERS,
    interval_at,
    number_at,
    outlines_at,
    points_at,
    read_each,
    references,
    turned_left,
)
from ms_highway.recorded.scenario import (
    GoalRegion,
    Lanelet,
    Points,
    Problem,
    RecordedTrack,
    TrafficRecording,
)
from ms_highway.runtime.files import reading


@dataclass(frozen=True)
class CommonRoadFormat:
    """Say what a version of CommonRoad's format calls things."""

    version: str = "2020a"
    """Value of the attribute ``commonRoadVersion``."""

    obstacles: tuple[str, ...] = (
        "dynamicObstacle",
        "staticObstacle",
        "environmentObstacle",
    )
    """Tags of obstacles. Those of the environment are buildings, and are ignored."""

    driving_types: frozenset[str] = frozenset(
        {"bus", "car", "motorcycle", "priorityVehicle", "taxi", "truck"}
    )
    """Types of obstacles that drive in lanes; all others are replayed."""

    lanelets_without_cars: frozenset[str] = frozenset(
        {"bicycleLane", "border", "crosswalk", "restricted_area", "sidewalk"}
    )
    """Types of lanelets on which cars do not drive."""

    speed_signs: frozenset[str] = frozenset(
        {
            "274",
            "3.24",
            "B14",
            "B31",
            "C43",
            "R15",
            "R2-1",
            "r301",
            "Ρ-32",  # noqa: RUF001
        }
    )
    """Ids of the speed limit signs of all countries; the Greek one begins with a Greek
    letter.
    """

    goal_conditions: frozenset[str] = frozenset(
        {"position", "time", "velocity", "orientation"}
    )
    """Conditions of a goal that can be judged here."""


FORMAT_2020A = CommonRoadFormat()


# Files


def scenario_files(directory: Path) -> list[Path]:
    """Return the CommonRoad scenarios of a directory in the order of their names.

    Raises:
        ValueError: if there is no such directory, or no file ``*.xml`` or ``*.xml.gz``
            in it.
    """
    if not directory.is_dir():
        raise ValueError(
            f"{directory} is not a directory; give the one that holds the CommonRoad"
            " scenarios"
        )
    paths = sorted(
        path for path in directory.iterdir() if path.name.endswith((".xml", ".xml.gz"))
    )
    if not paths:
        raise ValueError(
            f"{directory} holds no CommonRoad scenarios, files *.xml or *.xml.gz"
        )
    return paths


def read_scenario(path: Path) -> TrafficRecording:
    """Read a CommonRoad scenario whose vehicles were recorded every 0.1 s.

    Raises:
        ValueError: naming the file and the element, if the file is damaged or holds
            something else.
    """
    with reading(
        path, "fetch it again, mend it or leave it out", " as a CommonRoad scenario"
    ):
        return _recording(fromstring(read_xml(path)), path.name)


def read_xml(path: Path) -> bytes:
    """Return the XML of a file, unpacked.

    Raises:
        ValueError: if the XML is larger than 100 MB.
        OSError: if the file cannot be read.
    """
    most_bytes = 100_000_000  # the scenarios of US-101 have some millions
    opened = gzip.open if path.name.endswith(".xml.gz") else open
    with opened(path, "rb") as file:
        xml = file.read(most_bytes + 1)
    if len(xml) > most_bytes:
        raise ValueError(f"more than {most_bytes} bytes of XML")
    return xml


# A scenario


def _recording(root: Element, source: str) -> TrafficRecording:
    """Return the recording that a document holds, given the name of its file."""
    _check_header(root)
    _check_obstacles(root)

    # The road. Goals may also be in lanelets on which cars do not drive.
    limits = read_each(root, "trafficSign", _speed_limits)
    lanelets = read_each(root, "lanelet", partial(_lanelet, limits=limits))
    is_for_cars = read_each(root, "lanelet", _is_for_cars)
    areas = {
        number: np.concatenate([lanelet.left, lanelet.right[::-1]])
        for number, lanelet in lanelets.items()
    }

    # What moves on it, and the planning problems.
    problems = read_each(root, "planningProblem", partial(_problem, areas=areas))
    moving = read_each(root, "dynamicObstacle", _moving_track)
    if not any(len(track.samples) > 1 for track in moving.values()):
        raise ValueError("there is no driving: no dynamic obstacle has two samples")

    # What stands, until the recording ends.
    ends = [track.last for track in moving.values()]
    ends += [problem.last for problem in problems.values()]
    standing = read_each(
        root, "staticObstacle", partial(_standing_track, last=max(ends))
    )

    name = root.get("benchmarkID", "")
    return TrafficRecording(
        name=name,
        group=_group_of(name),
        source=source,
        lanelets=tuple(
            lanelet for number, lanelet in lanelets.items() if is_for_cars[number]
        ),
        tracks=(*moving.values(), *standing.values()),
        problems=tuple(problems.values()),
    )


def _check_header(root: Element) -> None:
    """Raise an error unless a document is a scenario of this format and time step."""
    version = root.get("commonRoadVersion")
    if (
        root.tag != "commonRoad"
        or version != FORMAT_2020A.version
        or not root.get("benchmarkID")
    ):
        raise ValueError(
            f"<{root.tag}> of version {version!r} is no <commonRoad> of version"
            f" {FORMAT_2020A.version} with a benchmarkID"
        )
    written = root.get("timeStepSize", "nan")
    try:
        step = float(written)
    except ValueError:
        step = np.nan
    if not np.isclose(step, TIME_STEP):
        raise ValueError(
            f"timeStepSize of <commonRoad> is {written:.40} s; it must be {TIME_STEP} s"
        )


def _check_obstacles(root: Element) -> None:
    """Raise an error for an obstacle with a tag that this format does not have."""
    for element in root:
        if (
            element.tag.endswith("Obstacle")
            and element.tag not in FORMAT_2020A.obstacles
        ):
            raise ValueError(
                f"{element.tag} {element.get('id')!r:.40} cannot be read; only"
                f" {', '.join(FORMAT_2020A.obstacles)} can"
            )


def _group_of(name: str) -> str:
    """Return the name of the recording from which a scenario was cut.

    ``USA_US101-17_1_T-1`` is cut from ``US101-17``; a name without parts is its own
    group.
    """
    parts = name.split("_")
    return parts[1] if len(parts) > 1 else parts[0]


# The road


def _speed_limits(_: int, sign: Element) -> list[float]:
    """Return the speed limits that a traffic sign shows [m/s]."""
    limits = [
        number_at(shown, "additionalValue")
        for shown in sign.iterfind("trafficSignElement")
        if shown.findtext("trafficSignID") in FORMAT_2020A.speed_signs
    ]
    if not all(1 <= limit <= LARGEST_NUMBERS.speed for limit in limits):
        raise ValueError(
            f"it shows <additionalValue> {limits} m/s; limits are from 1 to"
            f" {LARGEST_NUMBERS.speed:g} m/s"
        )
    return limits


def _lanelet(
    number: int,
    element: Element,
    limits: Mapping[int, list[float]],
) -> Lanelet:
    """Return a lanelet, given the speed limits that each traffic sign shows."""
    left = points_at(element, "leftBound/point")
    right = points_at(element, "rightBound/point")
    if (
        len(left) != len(right)
        or len(left) < 2
        or not np.ptp(left + right, axis=0).any()
    ):
        raise ValueError(
            f"its bounds have {len(left)} and {len(right)} points; they need the same"
            " number, two or more, around a middle line"
        )
    signs = references(element, "trafficSignRef")
    missing = set(signs) - limits.keys()
    if missing:
        raise ValueError(f"there is no trafficSign {min(missing)}, to which it refers")
    shown = [limit for sign in signs for limit in limits[sign]]
    return Lanelet(
        number=number,
        left=left,
        right=right,
        before=references(element, "predecessor"),
        after=references(element, "successor"),
        beside=(
            _neighbour(element, "adjacentLeft"),
            _neighbour(element, "adjacentRight"),
        ),
        limit=min(shown, default=None),
    )


def _neighbour(lanelet: Element, tag: str) -> int | None:
    """Return the id of the lanelet on a side on which traffic goes the same way."""
    side = lanelet.find(f"{tag}[@drivingDir='same']")
    return None if side is None else int(side.get("ref", ""))


def _is_for_cars(_: int, lanelet: Element) -> bool:
    """Return whether cars drive on a lanelet."""
    types = {kind.text for kind in lanelet.iterfind("laneletType")}
    return not types & FORMAT_2020A.lanelets_without_cars


# Obstacles


def _moving_track(number: int, obstacle: Element) -> RecordedTrack:
    """Return the track of a dynamic obstacle."""
    if obstacle.find("occupancySet") is not None:
        raise ValueError(
            "only a <trajectory> can be read, and it has an <occupancySet>"
        )
    states = [_initial_state(obstacle), *obstacle.iterfind("trajectory/state")]
    samples = np.array([_sample(state) for state in states])
    if not (np.diff(samples[:, 0]) >= 1).all():
        raise ValueError("its times do not follow each other")
    drives = obstacle.findtext("type") in FORMAT_2020A.driving_types
    return _track_of_box(number, obstacle, samples, drives)


def _standing_track(number: int, obstacle: Element, last: int) -> RecordedTrack:
    """Return the track of a static obstacle until the last step."""
    pose = _pose(_initial_state(obstacle))
    samples = np.array([(step, *pose, 0.0) for step in range(last + 1)])
    return _track_of_box(number, obstacle, samples, drives=False)


def _track_of_box(
    number: int,
    obstacle: Element,
    samples: np.ndarray,
    drives: bool,
) -> RecordedTrack:
    """Return the track of the box around the shapes of an obstacle.

    Args:
        number: id of the obstacle.
        obstacle: has the shapes.
        samples: of the origin of the shapes [times, 5]; the middle of the box may be
            elsewhere.
        drives: whether the obstacle drives in lanes.
    """
    corners = np.concatenate(outlines_at(obstacle))
    low = corners.min(axis=0)
    high = corners.max(axis=0)
    length, width = (high - low).tolist()
    middles = np.tile((low + high) / 2, (len(samples), 1))
    samples[:, 1:3] += turned_left(middles, samples[:, 3])
    return RecordedTrack(number, (length, width), samples, drives)


def _initial_state(element: Element) -> Element:
    state = element.find("initialState")
    if state is None:
        raise ValueError("it lacks an <initialState>")
    return state


def _pose(state: Element) -> tuple[float, float, float]:
    """Return x, y and orientation of a state; intervals are refused."""
    x = number_at(state, "position/point/x")
    y = number_at(state, "position/point/y")
    return x, y, number_at(state, "orientation/exact", LARGEST_NUMBERS.angle)


def _sample(state: Element) -> tuple[int, float, float, float, float]:
    """Return the time step, x, y, orientation and speed of a state."""
    time = number_at(state, "time/exact", LARGEST_NUMBERS.step)
    if time < 0:
        raise ValueError(f"<time> of <{state.tag}> is {time}; it must not be negative")
    pose = _pose(state)
    return round(time), *pose, number_at(state, "velocity/exact", LARGEST_NUMBERS.speed)


# Planning problems


def _problem(number: int, element: Element, areas: Mapping[int, Points]) -> Problem:
    """Return a planning problem, given the corners of each lanelet."""
    time, x, y, orientation, speed = _sample(_initial_state(element))
    goals = tuple(
        goal for state in element.iterfind("goalState") for goal in _goals(state, areas)
    )
    if speed < 0 or not goals or max(goal.times[1] for goal in goals) <= time:
        raise ValueError("it starts backwards, or has no goal after its start")
    return Problem(number, (x, y, orientation, speed), time, goals)


def _goals(state: Element, areas: Mapping[int, Points]) -> Iterator[GoalRegion]:
    """Yield a goal for each shape or lanelet of a goal's position.

    Without a position, yield one without a region.
    """
    conditions = {part.tag for part in state}
    unknown = conditions - FORMAT_2020A.goal_conditions
    if unknown:
        raise ValueError(f"a goal has <{min(unknown)}>, which cannot be judged here")

    first, last = interval_at(state, "time", LARGEST_NUMBERS.step)
    speeds = None
    if "velocity" in conditions:
        speeds = interval_at(state, "velocity", LARGEST_NUMBERS.speed)
    headings = None
    if "orientation" in conditions:
        headings = interval_at(state, "orientation", LARGEST_NUMBERS.angle)
        if headings[1] - headings[0] >= tau:
            headings = None  # every heading is within a full turn

    regions: list[Points] | list[None] = [None]
    if "position" in conditions:
        regions = _goal_regions(state, areas)
    for region in regions:
        yield GoalRegion((round(first), round(last)), region, speeds, headings)


def _goal_regions(state: Element, areas: Mapping[int, Points]) -> list[Points]:
    """Return the corners of the lanelets or, without any, of the shapes of a goal."""
    lanelets = references(state, "position/lanelet")
    missing = set(lanelets) - areas.keys()
    if missing:
        raise ValueError(f"there is no lanelet {min(missing)}, to which a goal refers")
    if lanelets:
        return [areas[number] for number in lanelets]
    return outlines_at(state, "position/*")
