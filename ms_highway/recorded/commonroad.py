"""Read CommonRoad scenarios of format 2020a, such as those of the US-101 highway.

This module parses the XML elements itself: commonroad-io drops parts of shapes (which
ones depends on its version), replaces missing numbers by zeros, and raises errors that
do not name the element.
"""

import gzip
from collections.abc import Callable, Iterator
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any, TypeVar
from xml.etree.ElementTree import Element, fromstring

import numpy as np

from ms_highway.game.scenario import TIME_STEP
from ms_highway.geometry.curve import rotated
from ms_highway.recorded.scenario import (
    FULL_TURN,
    GoalRegion,
    Lanelet,
    Points,
    Problem,
    RecordedTrack,
    TrafficRecording,
)
from ms_highway.runtime.files import reading

COMPRESSED = ".xml.gz"
ROLES = (
    "dynamicObstacle",
    "staticObstacle",
    "environmentObstacle",
)  # the last are buildings and ignored

DRIVING_TYPES = {"bus", "car", "motorcycle", "priorityVehicle", "taxi", "truck"}
"""Types of obstacles that drive in lanes; all others are replayed."""

NO_LANES = {"bicycleLane", "border", "crosswalk", "restricted_area", "sidewalk"}
"""Types of lanelets on which cars do not drive."""

SPEED_SIGNS = {
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
"""Ids of the speed limit signs of all countries; the Greek one begins with a Greek
letter.
"""

MAX_BYTES = 100_000_000  # of a scenario's XML; those of US-101 have some millions
MAX_STEPS, MAX_SPEED, MAX_RADIANS, MAX_COORDINATE = (
    1e5,
    200.0,
    1e3,
    1e8,
)  # of a time, m/s, of an angle, m
SQUARE = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) / 2
ANGLES = (
    2 * np.pi / 64 * np.arange(64)
)  # rad, of the corners of the polygon that replaces a circle

Read = TypeVar("Read")


def scenario_files(directory: Path) -> list[Path]:
    """Return the CommonRoad scenarios of a directory, files ``*.xml`` and ``*.xml.gz``,
    in the order of their names.

    Raises:
        ValueError: if there is no such directory, or no such file in it.
    """
    if not directory.is_dir():
        raise ValueError(
            f"{directory} is not a directory; give the one that holds the CommonRoad"
            " scenarios"
        )
    paths = sorted(
        path for path in directory.iterdir() if path.name.endswith((".xml", COMPRESSED))
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
        ValueError: if the XML is larger than `MAX_BYTES`.
        OSError: if the file cannot be read.
    """
    opened = gzip.open if path.name.endswith(COMPRESSED) else open
    with opened(path, "rb") as file:
        xml = file.read(MAX_BYTES + 1)
    if len(xml) > MAX_BYTES:
        raise ValueError(f"more than {MAX_BYTES} bytes of XML")
    return xml


def _recording(root: Element, source: str) -> TrafficRecording:
    version = root.get("commonRoadVersion")
    name = root.get("benchmarkID", "")
    if root.tag != "commonRoad" or version != "2020a" or not name:
        raise ValueError(
            f"<{root.tag}> of version {version!r} is no <commonRoad> of version 2020a"
            " with a benchmarkID"
        )
    if not np.isclose(float(step := root.get("timeStepSize", "nan")), TIME_STEP):
        raise ValueError(
            f"timeStepSize of <commonRoad> is {step:.40} s; it must be {TIME_STEP} s"
        )
    for element in root:
        if element.tag.endswith("Obstacle") and element.tag not in ROLES:
            raise ValueError(
                f"{element.tag} {element.get('id')!r:.40} cannot be read; only"
                f" {', '.join(ROLES)} can"
            )
    limits = _each(root, "trafficSign", _speed_limits)
    lanelets = _each(root, "lanelet", partial(_lanelet, limits=limits))
    areas = {
        number: np.concatenate([lane.left, lane.right[::-1]])
        for number, (lane, _) in lanelets.items()
    }
    lanes = tuple(lane for lane, drivable in lanelets.values() if drivable)
    problems = tuple(
        _each(root, "planningProblem", partial(_problem, areas=areas)).values()
    )
    tracks = tuple(_each(root, "dynamicObstacle", _track).values())
    if not any(len(track.samples) > 1 for track in tracks):
        raise ValueError("there is no driving: no dynamic obstacle has two samples")
    last = max(
        [track.last for track in tracks] + [problem.last for problem in problems]
    )
    return TrafficRecording(
        name=name,
        group=name.split("_")[
            min(1, name.count("_"))
        ],  # USA_US101-17_1_T-1 is cut from US101-17
        source=source,
        lanelets=lanes,
        tracks=(
            *tracks,
            *_each(root, "staticObstacle", partial(_standing, last=last)).values(),
        ),
        problems=problems,
    )


def _each(
    root: Element, tag: str, read: Callable[[int, Element], Read]
) -> dict[int, Read]:
    """Return what ``read`` makes of each element with a tag, by the elements' ids;
    errors name the element.
    """
    found: dict[int, Read] = {}
    for element in root.iterfind(tag):
        try:
            number = int(element.get("id", ""))
            if number in found:
                raise ValueError("another one has the same id")
            found[number] = read(number, element)
        except ValueError as error:
            raise ValueError(f"{tag} {element.get('id', '')[:40]}: {error}") from error
    return found


def _references(element: Element, tag: str) -> tuple[int, ...]:
    """Return the ids to which the elements with a tag refer."""
    return tuple(int(one.get("ref", "")) for one in element.iterfind(tag))


def _number(
    element: Element,
    path: str,
    most: float = MAX_COORDINATE,
    default: float | None = None,
) -> float:
    """Return the number at a path of tags below an element, or the default where there
    is none.

    Raises:
        ValueError: for a number that is not from ``-most`` to ``most``.
    """
    text = element.findtext(path)
    if text is None and default is not None:
        return default
    try:
        found = float(text or "")
    except ValueError:
        found = np.nan
    if not abs(found) <= most:
        raise ValueError(
            f"<{path}> of <{element.tag}> is {text!r:.40}; it must be from {-most:g} to"
            f" {most:g}"
        )
    return found


def _points(element: Element, path: str) -> Points:
    return np.array(
        [[_number(point, axis) for axis in "xy"] for point in element.iterfind(path)]
    ).reshape(-1, 2)


def _speed_limits(_: int, element: Element) -> list[float]:
    """Return the speed limits that a traffic sign shows [m/s]."""
    shown = element.iterfind("trafficSignElement")
    limits = [
        _number(one, "additionalValue")
        for one in shown
        if one.findtext("trafficSignID") in SPEED_SIGNS
    ]
    if not all(1 <= limit <= MAX_SPEED for limit in limits):
        raise ValueError(
            f"it shows <additionalValue> {limits} m/s; limits are from 1 to"
            f" {MAX_SPEED:g} m/s"
        )
    return limits


def _lanelet(
    number: int, element: Element, limits: dict[int, list[float]]
) -> tuple[Lanelet, bool]:
    """Return a lanelet, and whether cars drive on it."""
    left = _points(element, "leftBound/point")
    right = _points(element, "rightBound/point")
    if (
        len(left) != len(right)
        or len(left) < 2
        or not np.ptp(left + right, axis=0).any()
    ):
        counts = f"its bounds have {len(left)} and {len(right)} points"
        raise ValueError(
            f"{counts}; they need the same number, two or more, around a middle line"
        )
    signs = _references(element, "trafficSignRef")
    if missing := set(signs) - limits.keys():
        raise ValueError(f"there is no trafficSign {min(missing)}, to which it refers")
    sides = (
        element.find(f"{side}[@drivingDir='same']")
        for side in ("adjacentLeft", "adjacentRight")
    )
    beside_left, beside_right = (
        None if side is None else int(side.get("ref", "")) for side in sides
    )
    before = _references(element, "predecessor")
    after = _references(element, "successor")
    limit = min(chain(*(limits[sign] for sign in signs)), default=None)
    lanelet = Lanelet(
        number, left, right, before, after, (beside_left, beside_right), limit
    )
    return lanelet, not NO_LANES & {
        kind.text for kind in element.iterfind("laneletType")
    }


def _track(number: int, element: Element) -> RecordedTrack:
    """Return the track of a moving obstacle."""
    if element.find("occupancySet") is not None:
        raise ValueError(
            "only a <trajectory> can be read, and it has an <occupancySet>"
        )
    states = _initial_state(element), *element.iterfind("trajectory/state")
    samples = np.array([_sample(state) for state in states])
    if not (np.diff(samples[:, 0]) >= 1).all():
        raise ValueError("its times do not follow each other")
    return _boxed(number, element, samples, element.findtext("type") in DRIVING_TYPES)


def _standing(number: int, element: Element, last: int) -> RecordedTrack:
    """Return the track of a static obstacle until the last step."""
    pose = _pose(_initial_state(element))
    samples = np.array([(step, *pose, 0.0) for step in range(last + 1)])
    return _boxed(number, element, samples, False)


def _boxed(
    number: int, element: Element, samples: np.ndarray, drives: bool
) -> RecordedTrack:
    """Return the track of the box around the shapes of an obstacle, whose samples are
    of the shapes' origin.
    """
    corners = np.concatenate(_outlines(element))
    low = corners.min(axis=0)
    high = corners.max(axis=0)
    length, width = (high - low).tolist()
    samples[:, 1:3] += _turned(
        np.tile((low + high) / 2, (len(samples), 1)), samples[:, 3]
    )
    return RecordedTrack(number, (length, width), samples, drives)


def _initial_state(element: Element) -> Element:
    state = element.find("initialState")
    if state is None:
        raise ValueError("it lacks an <initialState>")
    return state


def _pose(state: Element) -> tuple[float, float, float]:
    """Return x, y and orientation of a state; intervals are refused."""
    x, y = (_number(state, f"position/point/{axis}") for axis in "xy")
    return x, y, _number(state, "orientation/exact", MAX_RADIANS)


def _sample(state: Element) -> list[float]:
    """Return the time step, x, y, orientation and speed of a state."""
    time = _number(state, "time/exact", MAX_STEPS)
    if time < 0:
        raise ValueError(f"<time> of <{state.tag}> is {time}; it must not be negative")
    return [round(time), *_pose(state), _number(state, "velocity/exact", MAX_SPEED)]


def _problem(number: int, element: Element, areas: dict[int, Points]) -> Problem:
    time, x, y, orientation, speed = _sample(_initial_state(element))
    goals = tuple(
        goal for state in element.iterfind("goalState") for goal in _goals(state, areas)
    )
    if speed < 0 or not goals or max(goal.times[1] for goal in goals) <= time:
        raise ValueError("it starts backwards, or has no goal after its start")
    return Problem(number, (x, y, orientation, speed), int(time), goals)


def _goals(state: Element, areas: dict[int, Points]) -> Iterator[GoalRegion]:
    """Yield a goal for each shape or lanelet of a goal's position, or one goal without
    a region.
    """
    parts = {part.tag for part in state}
    if unknown := parts - {"position", "time", "velocity", "orientation"}:
        raise ValueError(f"a goal has <{min(unknown)}>, which cannot be judged here")
    first, last = _interval(state, "time", MAX_STEPS)
    speeds = _interval(state, "velocity", MAX_SPEED) if "velocity" in parts else None
    headings = (
        _interval(state, "orientation", MAX_RADIANS) if "orientation" in parts else None
    )
    if headings and headings[1] - headings[0] >= FULL_TURN:
        headings = None
    regions: list[Points | None] = [None]
    if "position" in parts:
        numbers = _references(state, "position/lanelet")
        if missing := set(numbers) - areas.keys():
            raise ValueError(
                f"there is no lanelet {min(missing)}, to which a goal refers"
            )
        regions = [areas[number] for number in numbers] or [
            *_outlines(state, "position/*")
        ]
    for region in regions:
        yield GoalRegion((round(first), round(last)), region, speeds, headings)


def _interval(state: Element, tag: str, most: float) -> tuple[float, float]:
    """Return both ends of an interval; of an exact value, return it twice."""
    ends = (
        ("intervalStart", "intervalEnd")
        if state.find(f"{tag}/exact") is None
        else ("exact", "exact")
    )
    first, last = (_number(state, f"{tag}/{end}", most) for end in ends)
    if first > last:
        raise ValueError(f"<{tag}> of a goal ends before it begins")
    return first, last


def _outlines(element: Element, path: str = "shape/*") -> list[Points]:
    """Return the corners of each shape at a path below an element."""
    found = [_outline(piece) for piece in element.iterfind(path)]
    if not found:
        raise ValueError(f"<{element.tag}> lacks a shape")
    return found


def _outline(piece: Element) -> Points:
    if piece.tag == "polygon":
        corners = _points(piece, "point")
    elif piece.tag == "circle":
        corners = _number(piece, "radius") * np.stack(
            [np.cos(ANGLES), np.sin(ANGLES)], axis=-1
        )
    elif piece.tag == "rectangle":
        corners = SQUARE * [_number(piece, "length"), _number(piece, "width")]
        corners[:, 0] -= _number(piece, "originXShift", default=0.0)
        corners = _turned(corners, _number(piece, "orientation", MAX_RADIANS, 0.0))
    else:
        raise ValueError(
            f"<{piece.tag}> is none of the shapes that can be read: rectangle, circle"
            " and polygon"
        )
    if len(corners) < 3 or not np.ptp(corners, axis=0).all():
        raise ValueError(f"<{piece.tag}> has no area")
    return corners + [_number(piece, f"center/{axis}", default=0.0) for axis in "xy"]


def _turned(vectors: Points, angle: Any) -> Points:
    """Return vectors turned to the left by an angle [rad]."""
    return np.stack(rotated(vectors[..., 0], vectors[..., 1], -angle), axis=-1)
