"""Read CommonRoad scenarios, such as those of the US-101 highway.

This module parses the XML elements itself. Versions of commonroad-io drop different parts of shapes, replace missing
numbers by zeros, and raise errors that do not name the element.
"""

import gzip
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from pathlib import Path
from typing import Any, TypeVar
from xml.etree.ElementTree import Element, fromstring

import numpy as np

from ms_highway.game.scenario import TIME_STEP
from ms_highway.geometry.curve import rotated
from ms_highway.recorded.scenario import (
    GoalRegion,
    Lanelet,
    Obstacle,
    Points,
    Problem,
    RecordedTrack,
    TrafficRecording,
)
from ms_highway.runtime.extras import needing
from ms_highway.runtime.files import reading

COMPRESSED = ".xml.gz"
VERSIONS = "2018b", "2020a"

ROLES = "dynamicObstacle", "staticObstacle", "environmentObstacle"  # buildings, the last, are ignored

DRIVERS = {"bus", "car", "motorcycle", "priorityVehicle", "taxi", "truck"}
"""Types of obstacles that drive in lanes; all others only go as they were recorded."""

NO_LANES = {"bicycleLane", "border", "crosswalk", "restricted_area", "sidewalk"}
"""Types of lanelets on which cars do not drive."""

CIRCLE = 64  # corners of the polygon that a circle is read as

MOST_BYTES = 100_000_000  # of a scenario's XML; those of US-101 have some millions
MOST_METRES = 100_000.0  # from one end of a scenario to the other
FARTHEST = 1e8  # m, of coordinates
MOST_STEPS = 1e5
MOST_RADIANS = 1000.0  # of an orientation
MOST_SPEED = 200.0  # m/s
LEAST_LIMIT, MOST_LIMIT = 1.0, 100.0  # m/s, of a speed limit

Read = TypeVar("Read")


def scenario_files(directory: Path) -> list[Path]:
    """Return the CommonRoad scenarios of a directory, files ``*.xml`` and ``*.xml.gz``, in the order of their names.

    Raises:
        ValueError: if there is no such directory, or no such file in it.
    """
    if not directory.is_dir():
        raise ValueError(f"{directory} is not a directory; give the one that holds the CommonRoad scenarios")
    paths = sorted(path for path in directory.iterdir() if path.name.endswith((".xml", COMPRESSED)))
    if not paths:
        raise ValueError(f"{directory} holds no CommonRoad scenarios, files *.xml or *.xml.gz")
    return paths


def read_scenario(path: Path, with_problems: bool = True) -> TrafficRecording:
    """Read a CommonRoad scenario whose vehicles were recorded every 0.1 s.

    Args:
        path: of the file.
        with_problems: whether its planning problems are read, too.

    Raises:
        ValueError: naming the file and the element, if it is damaged, or holds something else.
        ImportError: for a file with traffic signs, without the packages of the extra ``commonroad``.
    """
    with reading(path, "fetch it again, mend it or leave it out", " as a CommonRoad scenario"):
        return _recording(fromstring(read_xml(path)), path.name, with_problems)


def read_xml(path: Path) -> bytes:
    """Return the XML of a file, unpacked.

    Raises:
        ValueError: if it is larger than any scenario.
        OSError: if it cannot be read.
    """
    opened = gzip.open if path.name.endswith(COMPRESSED) else open
    with opened(path, "rb") as file:
        xml = file.read(MOST_BYTES + 1)
    if len(xml) > MOST_BYTES:
        raise ValueError(f"more than {MOST_BYTES} bytes of XML")
    return xml


def _recording(root: Element, source: str, with_problems: bool) -> TrafficRecording:
    version, name = root.get("commonRoadVersion"), root.get("benchmarkID")
    if root.tag != "commonRoad" or version not in VERSIONS or not name:
        raise ValueError(
            f"<{root.tag}> of version {version!r} and benchmarkID {name!r}; it must be a <commonRoad> of version "
            f"{' or '.join(VERSIONS)} with a benchmarkID"
        )
    if not np.isclose(step := _attribute(root, "timeStepSize", float), TIME_STEP):
        raise ValueError(f"the time step is {step} s; it must be {TIME_STEP} s")
    for obstacle in root.iterfind("obstacle"):  # of version 2018b
        obstacle.tag = f"{obstacle.findtext('role')}Obstacle"
    for element in root:
        if element.tag.endswith("Obstacle") and element.tag not in ROLES:
            raise ValueError(f"{element.tag} {element.get('id')!r:.40} cannot be read; only {', '.join(ROLES)} can")
    lanelets = _each(root, partial(_lanelet, signs=dict(_each(root, _sign, "trafficSign"))), "lanelet")
    areas = {lanelet.number: np.vstack([lanelet.left, lanelet.right[::-1]]) for lanelet, _ in lanelets}
    lanes = tuple(lanelet for lanelet, kinds in lanelets if not kinds & NO_LANES)
    if lanes and not np.ptp(np.concatenate([lane.centre for lane in lanes]), axis=0).max() <= MOST_METRES:
        raise ValueError(f"lanelets are more than {MOST_METRES:g} m apart")
    tracks = tuple(_each(root, _track, "dynamicObstacle"))
    if not any(len(track.samples) > 1 for track in tracks):
        raise ValueError("there is no dynamic obstacle with two samples, and so no driving")
    problems = _each(root, partial(_problem, areas=areas), "planningProblem") if with_problems else ()
    return TrafficRecording(
        name=name,
        group=name.split("_")[min(1, name.count("_"))],  # USA_US101-17_1_T-1 is cut from US101-17
        source=source,
        lanelets=lanes,
        tracks=tracks,
        obstacles=tuple(one for some in _each(root, _standing, "staticObstacle") for one in some),
        problems=tuple(problems),
    )


def _each(root: Element, read: Callable[[int, Element], Read], *tags: str) -> list[Read]:
    """Apply ``read`` to the id and the element of all elements with these tags; an error names the element."""
    found: dict[int, Read] = {}
    for element in root:
        if element.tag in tags:
            number = _attribute(element, "id")
            try:
                if number in found:
                    raise ValueError("it has the id of another one")
                found[number] = read(number, element)
            except ValueError as error:
                raise ValueError(f"{element.tag} {number}: {error}") from error
    return list(found.values())


def _attribute(element: Element, name: str, kind: Callable[[str], Any] = int) -> Any:
    text = element.get(name, "")
    try:
        return kind(text)
    except ValueError as error:
        raise ValueError(f"{name} of <{element.tag}> is {text!r:.40}; it must be a number") from error


def _child(element: Element, name: str) -> Element:
    child = element.find(name)
    if child is None:
        raise ValueError(f"<{element.tag}> lacks <{name}>")
    return child


def _number(
    element: Element, path: str, least: float = -FARTHEST, most: float = FARTHEST, lacking: float | None = None
) -> float:
    """Return the number at a path of tags below an element, or the value ``lacking`` if there is none.

    Raises:
        ValueError: naming the path, if the number is missing, an interval, no number, or out of range.
    """
    text = element.findtext(path)
    if text is None:
        if lacking is not None:
            return lacking
        raise ValueError(f"<{element.tag}> lacks <{path}>")
    try:
        number = float(text)
    except ValueError:
        number = np.nan
    if not least <= number <= most:
        raise ValueError(f"<{path}> of <{element.tag}> is {text!r:.40}; it must be from {least:g} to {most:g}")
    return number


def _points(element: Element) -> Points:
    points = [[_number(point, axis) for axis in "xy"] for point in element.iterfind("point")]
    return np.array(points).reshape(-1, 2)


def _sign(number: int, element: Element) -> tuple[int, list[float]]:
    """Return the number of a traffic sign and the speed limits that it shows."""
    with needing("commonroad"):
        from commonroad.scenario.traffic_sign import TrafficSignIDCountries
    known = {sign.value for signs in TrafficSignIDCountries.values() for sign in signs if sign.name == "MAX_SPEED"}
    shown = [
        one for one in element.iterfind("trafficSignElement") if (one.findtext("trafficSignID") or "").strip() in known
    ]
    return number, [_number(one, "additionalValue", LEAST_LIMIT, MOST_LIMIT) for one in shown]


def _lanelet(number: int, element: Element, signs: dict[int, list[float]]) -> tuple[Lanelet, set[str]]:
    """Return a lanelet and its types."""
    left, right = (_points(_child(element, side)) for side in ("leftBound", "rightBound"))
    if len(left) != len(right) or len(left) < 2 or not np.ptp(left + right, axis=0).any():
        points = f"its bounds have {len(left)} and {len(right)} points"
        raise ValueError(f"{points}; they need the same number, two or more, around a middle line")
    limits = [_number(element, "speedLimit", LEAST_LIMIT, MOST_LIMIT)] if element.find("speedLimit") is not None else []
    for reference in element.iterfind("trafficSignRef"):
        sign = _attribute(reference, "ref")
        if sign not in signs:
            raise ValueError(f"there is no trafficSign {sign}, which it refers to")
        limits += signs[sign]
    before, after = (
        [_attribute(one, "ref") for one in element.iterfind(name)] for name in ("predecessor", "successor")
    )
    sides = [element.find(name) for name in ("adjacentLeft", "adjacentRight")]
    beside = [None if side is None else _attribute(side, "ref") for side in sides]
    same_way = [None if side is None else side.get("drivingDir") == "same" for side in sides]
    lanelet = Lanelet(
        number,
        left,
        right,
        tuple(before),
        tuple(after),
        (beside[0], beside[1]),
        (same_way[0], same_way[1]),
        min(limits, default=None),
    )
    return lanelet, {(kind.text or "").strip() for kind in element.iterfind("laneletType")}


def _track(number: int, element: Element) -> RecordedTrack:
    """Return the track of a moving obstacle; x and y are those of its centre."""
    if element.find("occupancySet") is not None:
        raise ValueError("<occupancySet> does not say where it goes; only a <trajectory> can be read")
    states = [_child(element, "initialState"), *element.iterfind("trajectory/state")]
    samples = np.array([_sample(state) for state in states])
    if not (np.diff(samples[:, 0]) >= 1).all():
        raise ValueError("its times do not follow each other")
    size, middle = _box(np.concatenate(_outlines(_child(element, "shape"))))
    samples[:, 1:3] += _turned(np.tile(middle, (len(samples), 1)), samples[:, 3])
    return RecordedTrack(number, size, samples, (element.findtext("type") or "").strip() in DRIVERS)


def _sample(state: Element) -> list[float]:
    """Return the time step, x, y, orientation and speed of a state; intervals are refused."""
    time = _number(state, "time/exact", 0, MOST_STEPS)
    return [float(round(time)), *_pose(state), _number(state, "velocity/exact", -MOST_SPEED, MOST_SPEED)]


def _pose(state: Element) -> tuple[float, float, float]:
    x, y = (_number(state, f"position/point/{axis}") for axis in "xy")
    return x, y, _number(state, "orientation/exact", -MOST_RADIANS, MOST_RADIANS)


def _standing(number: int, element: Element) -> list[Obstacle]:
    """Return a box along the longest edge of each shape of a static obstacle."""
    x, y, orientation = _pose(_child(element, "initialState"))
    found = []
    for outline in _outlines(_child(element, "shape")):
        edges = np.diff(outline, axis=0, append=outline[:1])
        turn = float(np.arctan2(*edges[np.hypot(*edges.T).argmax(), ::-1]))
        size, middle = _box(outline, turn)
        aside = _turned(middle, orientation)
        found.append(Obstacle(number, size, (x + aside[0], y + aside[1], orientation + turn)))
    return found


def _outlines(shape: Element) -> list[Points]:
    """Return the corners of each shape of an element.

    Raises:
        ValueError: if there is none, or one of an unknown kind, or without an area.
    """
    found = [_outline(piece) for piece in shape]
    if not found:
        raise ValueError(f"<{shape.tag}> lacks a shape")
    return found


def _outline(piece: Element) -> Points:
    if piece.tag == "polygon":
        corners = _points(piece)
    elif piece.tag == "circle":
        angles = 2 * np.pi / CIRCLE * np.arange(CIRCLE)
        corners = _number(piece, "radius", 0) * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    elif piece.tag in ("rectangle", "truckShape"):
        sides = piece if piece.tag == "rectangle" else _child(piece, "truckDims")
        corners = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]])
        corners *= [_number(sides, name, 0) for name in ("length", "width")]
        corners[:, 0] -= _number(piece, "originXShift", lacking=0.0 if piece is sides else None)
        corners = _turned(corners, _number(piece, "orientation", -MOST_RADIANS, MOST_RADIANS, lacking=0.0))
    else:
        raise ValueError(f"<{piece.tag}> is no shape that can be read: rectangle, circle, polygon or truckShape")
    if len(corners) < 3 or not (np.ptp(corners, axis=0) > 0).all():
        raise ValueError(f"<{piece.tag}> has no area")
    return corners + [_number(piece, f"center/{axis}", lacking=0.0) for axis in "xy"]


def _box(corners: Points, turn: float = 0.0) -> tuple[tuple[float, float], Points]:
    """Return length, width and centre of the box around points, its length along a direction [rad]."""
    turned = _turned(corners, -turn)
    low, high = turned.min(axis=0), turned.max(axis=0)
    length, width = (high - low).tolist()
    return (length, width), _turned((low + high) / 2, turn)


def _turned(points: Points, angle: Any) -> Points:
    """Return points turned to the left around the origin."""
    return np.stack(rotated(points[..., 0], points[..., 1], -angle), axis=-1)


def _problem(number: int, element: Element, areas: dict[int, Points]) -> Problem:
    time, x, y, orientation, speed = _sample(_child(element, "initialState"))
    goals = tuple(goal for state in element.iterfind("goalState") for goal in _goals(state, areas))
    if speed < 0 or not goals or max(goal.times[1] for goal in goals) <= time:
        raise ValueError("it starts backwards, or has no goal after its start")
    return Problem(number, (x, y, orientation, speed), int(time), goals)


def _goals(state: Element, areas: dict[int, Points]) -> Iterator[GoalRegion]:
    """Yield a goal for each shape or lanelet of a goal's position."""
    if unknown := {part.tag for part in state} - {"position", "time", "velocity", "orientation"}:
        raise ValueError(f"a goal has <{min(unknown)}>, which cannot be judged here")
    times = _between(state, "time", 0, MOST_STEPS)
    if times is None:
        raise ValueError("a goal has no <time>")
    speeds = _between(state, "velocity", -MOST_SPEED, MOST_SPEED)
    headings = _between(state, "orientation", -MOST_RADIANS, MOST_RADIANS)
    if headings and headings[1] - headings[0] >= 2 * np.pi:
        headings = None
    places: Iterable[Points | None] = [None]
    if (position := state.find("position")) is not None:
        numbers = [_attribute(lanelet, "ref") for lanelet in position.iterfind("lanelet")]
        if missing := set(numbers) - areas.keys():
            raise ValueError(f"there is no lanelet {min(missing)}, which a goal refers to")
        places = [areas[number] for number in numbers] or _outlines(position)
    for place in places:
        yield GoalRegion((round(times[0]), round(times[1])), place, speeds, headings)


def _between(state: Element, name: str, least: float, most: float) -> tuple[float, float] | None:
    """Return both ends of an interval, an exact value twice, or None without the element."""
    element = state.find(name)
    if element is None:
        return None
    ends = ("intervalStart", "intervalEnd") if element.find("exact") is None else ("exact", "exact")
    first, last = (_number(element, end, least, most) for end in ends)
    if first > last:
        raise ValueError(f"<{name}> of a goal ends before it begins")
    return first, last
