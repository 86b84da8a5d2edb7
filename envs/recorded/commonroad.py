"""Read CommonRoad scenarios, such as those of the US-101 highway."""

import gzip
import warnings
from collections.abc import Iterable, Iterator
from io import BytesIO
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from ms_highway.envs.recorded.scenario import GoalRegion, Lanelet, Obstacle, Problem, RecordedTrack, TrafficRecording
from ms_highway.game.scenario import TIME_STEP
from ms_highway.runtime.extras import needing
from ms_highway.runtime.files import reading

COMPRESSED = ".xml.gz"

MOST_BYTES = 100_000_000  # of a scenario's XML; those of US-101 have some millions
MOST_METRES = 100_000.0  # from one end of a scenario to the other
MOST_RADIANS = 1000.0  # of an orientation
MOST_SAMPLED = 1e5, 1e8, 1e8, MOST_RADIANS, 200.0  # time step, m, m, rad and m/s, of a vehicle

MEND = "mend the file or leave it out"


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
        ValueError: naming the file, if it is damaged, or holds something else.
        ImportError: without the packages of the extra ``commonroad``.
    """
    scenario, problems = open_commonroad(path)
    try:
        return _converted(scenario, problems.planning_problem_dict.values() if with_problems else (), path.name)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


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


def open_commonroad(path: Path) -> tuple[Any, Any]:
    """Return the scenario and the planning problems of a file, objects of commonroad-io.

    Raises:
        ValueError: naming the file, if it is damaged, or holds something else.
        ImportError: without the packages of the extra ``commonroad``.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # about irrelevant things, such as unknown locations
        with needing("commonroad"):
            from commonroad.common.reader.file_reader_xml import XMLFileReader  # by itself, without protobuf
        with reading(path, "fetch it again", " as a CommonRoad scenario"):
            xml = read_xml(path)
            # commonroad-io subtracts one turn after the other from an orientation, which might never end.
            for orientation in ElementTree.fromstring(xml).iter("orientation"):
                for text in orientation.itertext():
                    if text.strip() and not abs(float(text)) <= MOST_RADIANS:
                        raise ValueError(f"an orientation of {text} rad")
            try:
                return XMLFileReader(BytesIO(xml)).open()
            except (AssertionError, AttributeError, TypeError) as error:  # of elements that lack
                raise ValueError(str(error)) from error


def _converted(scenario: Any, problems: Iterable[Any], source: str) -> TrafficRecording:
    if not np.isclose(scenario.dt, TIME_STEP):
        raise ValueError(f"the time step is {scenario.dt} s; it must be {TIME_STEP} s")
    tracks = tuple(map(_track, scenario.dynamic_obstacles))
    if not any(len(track.samples) > 1 for track in tracks):
        raise ValueError("there is no dynamic obstacle with two samples, and so no driving")
    network = scenario.lanelet_network
    lanelets = tuple(_lanelet(lanelet, network) for lanelet in network.lanelets)
    if lanelets:
        lines = np.concatenate([lanelet.centre for lanelet in lanelets])
        if not np.ptp(lines, axis=0).max() <= MOST_METRES:
            raise ValueError(f"lanelets are not finite, or more than {MOST_METRES:g} m apart; {MEND}")
    return TrafficRecording(
        name=str(scenario.scenario_id),
        group=f"{scenario.scenario_id.map_name}-{scenario.scenario_id.map_id}",
        source=source,
        lanelets=lanelets,
        tracks=tracks,
        obstacles=tuple(map(_obstacle, scenario.static_obstacles)),
        problems=tuple(map(_problem, problems)),
    )


def _lanelet(lanelet: Any, network: Any) -> Lanelet:
    signs = [network.find_traffic_sign_by_id(number) for number in lanelet.traffic_signs]
    elements = [element for sign in signs if sign for element in sign.traffic_sign_elements]
    limits = [float(one.additional_values[0]) for one in elements if one.traffic_sign_element_id.name == "MAX_SPEED"]
    return Lanelet(
        lanelet.lanelet_id,
        np.array(lanelet.left_vertices, dtype=float),
        np.array(lanelet.right_vertices, dtype=float),
        tuple(lanelet.predecessor),
        tuple(lanelet.successor),
        (lanelet.adj_left, lanelet.adj_right),
        (lanelet.adj_left_same_direction, lanelet.adj_right_same_direction),
        min(limits, default=None),
    )


def _track(obstacle: Any) -> RecordedTrack:
    """Return a vehicle with its time step, position x and y, orientation and speed, as in the file."""
    states = [obstacle.initial_state]
    states += getattr(getattr(obstacle.prediction, "trajectory", None), "state_list", [])
    name = f"obstacle {obstacle.obstacle_id}"
    samples = np.array([_exact(state, name) for state in states])
    if samples[0, 0] < 0 or not (np.diff(samples[:, 0]) > 0).all():
        raise ValueError(f"the times of {name} do not follow each other from 0 on; {MEND}")
    return RecordedTrack(obstacle.obstacle_id, _size(obstacle), samples)


def _exact(state: Any, name: str) -> list[float]:
    """Return the time step, position, orientation and speed of a state.

    Raises:
        ValueError: naming whose it is, if one lacks, is an interval, or is not of this world.
    """
    try:
        x, y = state.position
        sample = [float(part) for part in (state.time_step, x, y, state.orientation, state.velocity)]
    except (AttributeError, TypeError, ValueError) as error:
        raise ValueError(
            f"{name} lacks an exact time, position, orientation or velocity; only exact ones can be read"
        ) from error
    if not (np.abs(sample) <= MOST_SAMPLED).all():
        raise ValueError(f"{name} has a time, place or speed that is out of range: {sample}; {MEND}")
    return sample


def _size(obstacle: Any) -> tuple[float, float]:
    """Return length and width of an obstacle's shape."""
    shape = obstacle.obstacle_shape
    if hasattr(shape, "length"):
        return float(shape.length), float(shape.width)
    left, low, right, high = shape.shapely_object.bounds
    return float(right - left), float(high - low)


def _obstacle(obstacle: Any) -> Obstacle:
    state = obstacle.initial_state
    x, y = map(float, state.position)
    return Obstacle(obstacle.obstacle_id, _size(obstacle), (x, y, float(state.orientation)))


def _problem(problem: Any) -> Problem:
    name = f"planning problem {problem.planning_problem_id}"
    time, x, y, orientation, speed = _exact(problem.initial_state, name)
    goals = tuple(goal for state in problem.goal.state_list for goal in _goals(state))
    if speed < 0 or not goals or max(goal.times[1] for goal in goals) <= time:
        raise ValueError(f"{name} starts backwards, or has no goal after its start; {MEND}")
    return Problem(problem.planning_problem_id, (x, y, orientation, speed), int(time), goals)


def _goals(state: Any) -> Iterator[GoalRegion]:
    """Yield a goal for each of the polygons that a goal's position is made of."""
    between: dict[str, tuple[float, float]] = {}
    for name in ("time_step", "velocity", "orientation"):
        if (value := getattr(state, name, None)) is not None:
            between[name] = float(getattr(value, "start", value)), float(getattr(value, "end", value))
    if "time_step" not in between:
        raise ValueError(f"a goal has no time; {MEND}")
    first, last = map(round, between["time_step"])
    position = getattr(state, "position", None)
    for shape in getattr(position, "shapes", [position]):
        area = None if shape is None else np.array(shape.shapely_object.exterior.coords)[:-1]
        yield GoalRegion((first, last), area, between.get("velocity"), between.get("orientation"))
