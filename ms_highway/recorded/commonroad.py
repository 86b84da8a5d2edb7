"""Read CommonRoad scenarios, such as those of the US-101 highway.

This package parses the XML elements itself. Versions of commonroad-io drop different parts of shapes, replace missing
numbers by zeros, and raise errors that do not name the element.
"""

import gzip
from collections.abc import Iterator
from functools import partial
from itertools import chain
from pathlib import Path
from xml.etree.ElementTree import Element, fromstring

import numpy as np

from ms_highway.game.scenario import TIME_STEP
from ms_highway.recorded.elements import (
    MOST_RADIANS,
    attribute,
    box,
    child,
    each,
    interval,
    number,
    outlines,
    points,
    pose,
    references,
    turned,
)
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

MOST_BYTES = 100_000_000  # of a scenario's XML; those of US-101 have some millions
MOST_METRES = 100_000.0  # from one end of a scenario to the other
MOST_STEPS = 1e5
MOST_SPEED = 200.0  # m/s
LIMITS = 1.0, 100.0  # m/s, least and most of a speed limit


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
    _check(root)
    limits = dict(each(root, "trafficSign", _speed_limits))
    lanelets = each(root, "lanelet", partial(_lanelet, limits=limits))
    areas = {lanelet.number: np.vstack([lanelet.left, lanelet.right[::-1]]) for lanelet, _ in lanelets}
    lanes = tuple(lanelet for lanelet, kinds in lanelets if not kinds & NO_LANES)
    if lanes and np.ptp(np.concatenate([lane.centre for lane in lanes]), axis=0).max() > MOST_METRES:
        raise ValueError(f"lanelets are more than {MOST_METRES:g} m apart")
    tracks = each(root, "dynamicObstacle", _track)
    if not any(len(track.samples) > 1 for track in tracks):
        raise ValueError("there is no dynamic obstacle with two samples, and so no driving")
    name = root.attrib["benchmarkID"]
    return TrafficRecording(
        name=name,
        group=name.split("_")[min(1, name.count("_"))],  # USA_US101-17_1_T-1 is cut from US101-17
        source=source,
        lanelets=lanes,
        tracks=tuple(tracks),
        obstacles=tuple(chain(*each(root, "staticObstacle", _obstacles))),
        problems=tuple(each(root, "planningProblem", partial(_problem, areas=areas)) if with_problems else ()),
    )


def _check(root: Element) -> None:
    """Refuse what is no scenario of a known version and time step, and obstacles that cannot be read."""
    version, name = root.get("commonRoadVersion"), root.get("benchmarkID")
    if root.tag != "commonRoad" or version not in VERSIONS or not name:
        raise ValueError(
            f"<{root.tag}> of version {version!r} and benchmarkID {name!r}; it must be a <commonRoad> of version "
            f"{' or '.join(VERSIONS)} with a benchmarkID"
        )
    if not np.isclose(step := attribute(root, "timeStepSize", float), TIME_STEP):
        raise ValueError(f"the time step is {step} s; it must be {TIME_STEP} s")
    for obstacle in root.iterfind("obstacle"):  # of version 2018b
        obstacle.tag = f"{obstacle.findtext('role')}Obstacle"
    for element in root:
        if element.tag.endswith("Obstacle") and element.tag not in ROLES:
            raise ValueError(f"{element.tag} {element.get('id')!r:.40} cannot be read; only {', '.join(ROLES)} can")


def _text(element: Element, tag: str) -> str:
    return (element.findtext(tag) or "").strip()


def _speed_limits(identity: int, element: Element) -> tuple[int, list[float]]:
    """Return the id of a traffic sign and the speed limits that it shows."""
    with needing("commonroad"):
        from commonroad.scenario.traffic_sign import TrafficSignIDCountries
    known = {sign.value for signs in TrafficSignIDCountries.values() for sign in signs if sign.name == "MAX_SPEED"}
    shown = [one for one in element.iterfind("trafficSignElement") if _text(one, "trafficSignID") in known]
    return identity, [number(one, "additionalValue", *LIMITS) for one in shown]


def _lanelet(identity: int, element: Element, limits: dict[int, list[float]]) -> tuple[Lanelet, set[str]]:
    """Return a lanelet and its types."""
    left, right = (points(child(element, side)) for side in ("leftBound", "rightBound"))
    if len(left) != len(right) or len(left) < 2 or not np.ptp(left + right, axis=0).any():
        counts = f"its bounds have {len(left)} and {len(right)} points"
        raise ValueError(f"{counts}; they need the same number, two or more, around a middle line")
    shown = [number(element, "speedLimit", *LIMITS)] if element.find("speedLimit") is not None else []
    for sign in references(element, "trafficSignRef"):
        if sign not in limits:
            raise ValueError(f"there is no trafficSign {sign}, which it refers to")
        shown += limits[sign]
    sides = [element.find(tag) for tag in ("adjacentLeft", "adjacentRight")]
    beside = [None if side is None else attribute(side, "ref") for side in sides]
    opposite = [side for side in sides if side is not None and side.get("drivingDir") != "same"]
    lanelet = Lanelet(
        number=identity,
        left=left,
        right=right,
        before=references(element, "predecessor"),
        after=references(element, "successor"),
        beside=(beside[0], beside[1]),
        opposite=tuple(attribute(side, "ref") for side in opposite),
        limit=min(shown, default=None),
    )
    return lanelet, {(kind.text or "").strip() for kind in element.iterfind("laneletType")}


def _track(identity: int, element: Element) -> RecordedTrack:
    """Return the track of a moving obstacle; x and y are those of its centre."""
    if element.find("occupancySet") is not None:
        raise ValueError("<occupancySet> does not say where it goes; only a <trajectory> can be read")
    states = [child(element, "initialState"), *element.iterfind("trajectory/state")]
    samples = np.array([_sample(state) for state in states])
    if not (np.diff(samples[:, 0]) >= 1).all():
        raise ValueError("its times do not follow each other")
    size, centre = box(np.concatenate(outlines(child(element, "shape"))))
    samples[:, 1:3] += turned(np.tile(centre, (len(samples), 1)), samples[:, 3])
    return RecordedTrack(identity, size, samples, _text(element, "type") in DRIVERS)


def _sample(state: Element) -> list[float]:
    """Return the time step, x, y, orientation and speed of a state; intervals are refused."""
    time = round(number(state, "time/exact", 0, MOST_STEPS))
    return [time, *pose(state), number(state, "velocity/exact", -MOST_SPEED, MOST_SPEED)]


def _obstacles(identity: int, element: Element) -> list[Obstacle]:
    """Return a box along the longest edge of each shape of a static obstacle."""
    x, y, orientation = pose(child(element, "initialState"))
    found = []
    for outline in outlines(child(element, "shape")):
        edges = np.diff(outline, axis=0, append=outline[:1])
        turn = float(np.arctan2(*edges[np.hypot(*edges.T).argmax(), ::-1]))
        size, centre = box(outline, turn)
        aside = turned(centre, orientation)
        found.append(Obstacle(identity, size, (x + aside[0], y + aside[1], orientation + turn)))
    return found


def _problem(identity: int, element: Element, areas: dict[int, Points]) -> Problem:
    time, x, y, orientation, speed = _sample(child(element, "initialState"))
    goals = tuple(goal for state in element.iterfind("goalState") for goal in _goals(state, areas))
    if speed < 0 or not goals or max(goal.times[1] for goal in goals) <= time:
        raise ValueError("it starts backwards, or has no goal after its start")
    return Problem(identity, (x, y, orientation, speed), int(time), goals)


def _goals(state: Element, areas: dict[int, Points]) -> Iterator[GoalRegion]:
    """Yield a goal for each shape or lanelet of a goal's position."""
    if unknown := {part.tag for part in state} - {"position", "time", "velocity", "orientation"}:
        raise ValueError(f"a goal has <{min(unknown)}>, which cannot be judged here")
    times = interval(state, "time", 0, MOST_STEPS)
    if times is None:
        raise ValueError("a goal has no <time>")
    speeds = interval(state, "velocity", -MOST_SPEED, MOST_SPEED)
    headings = interval(state, "orientation", -MOST_RADIANS, MOST_RADIANS)
    if headings and headings[1] - headings[0] >= 2 * np.pi:
        headings = None
    places: list[Points | None] = [None]
    if (position := state.find("position")) is not None:
        numbers = references(position, "lanelet")
        if missing := set(numbers) - areas.keys():
            raise ValueError(f"there is no lanelet {min(missing)}, which a goal refers to")
        places = [areas[lanelet] for lanelet in numbers] or [*outlines(position)]
    for place in places:
        yield GoalRegion((round(times[0]), round(times[1])), place, speeds, headings)
