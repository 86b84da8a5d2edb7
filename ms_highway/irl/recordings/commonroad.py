"""Read CommonRoad scenarios, such as those of the US-101 highway, as recordings in lane coordinates."""

import gzip
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree import ElementTree

import numpy as np
from scipy.interpolate import BSpline, make_smoothing_spline
from scipy.spatial import cKDTree

from ms_highway.game.scenario import TIME_STEP
from ms_highway.irl.arrays import Points, Values
from ms_highway.irl.recordings.recording import Recording
from ms_highway.runtime.extras import needing
from ms_highway.runtime.files import reading, temporary_directory

SPEED_LIMIT = 29.06  # m/s, 65 mph: on US-101, whose scenarios have no traffic signs

LANE_SPREAD = 0.5  # m, median deviation from the median offset, above which lanes are not parallel
DISTINCT_LANES = 1.0  # m, offset below which chains of lanelets are one lane

COMPRESSED = ".xml.gz"

MOST_BYTES = 100_000_000  # of a scenario's XML; those of US-101 have some millions
MOST_METRES = 100_000.0  # from one end of a scenario to the other
MOST_SIZE = 100.0  # m, of a vehicle
MOST_RADIANS = 1000.0  # of an orientation
MOST_STATES = 10_000_000  # of all cars at all times
MOST_SAMPLED = 1e12, 1e8, 1e8, MOST_RADIANS, 200.0  # time step, m, m, rad and m/s, of a vehicle

MEND = "mend the file or leave it out"

SPACING = 5.0  # m, between the points that the curve is fitted to
STIFFNESS = 2000.0  # m^3; smooths what is shorter than 60 m, (2 pi / 60 m)^4 = 1 / (SPACING STIFFNESS)
FEWEST_POINTS = 5  # that a smoothing spline can be fitted to
ITERATIONS = 6  # each reduces the error to |offset / radius| of it, a few percent on a highway


class LanePosition(NamedTuple):
    """Positions of points on a road, arrays [points].

    Attributes:
        x: along the road [m].
        y: to the right of the reference line [m].
        heading: of the road at the point [rad], counterclockwise, in the coordinates of the map.
    """

    x: Values
    y: Values
    heading: Values


class LaneCoordinates(NamedTuple):
    """A smooth reference line, straight beyond its ends.

    Attributes:
        curve: from the distance along the line [m] to a point (x, y) of the map, whose y points to the left of its x.
        length: of the line [m].
    """

    curve: BSpline
    length: float

    def locate(self, points: Points) -> LanePosition:
        """Return the positions on the road of points of the map."""
        samples = np.linspace(0, self.length, max(int(self.length / SPACING), 2))
        x = samples[cKDTree(self.curve(samples)).query(points)[1]]
        for _ in range(ITERATIONS):
            nearest_end = np.clip(x, 0, self.length)
            tangent = self.curve(nearest_end, 1)
            tangent /= np.linalg.norm(tangent, axis=-1, keepdims=True)
            offset = points - self.curve(nearest_end) - (x - nearest_end)[:, None] * tangent
            x = x + (offset * tangent).sum(axis=-1)
        right = offset[:, 0] * tangent[:, 1] - offset[:, 1] * tangent[:, 0]
        return LanePosition(x, right, np.arctan2(tangent[:, 1], tangent[:, 0]))


def fit_lane_coordinates(line: Points) -> LaneCoordinates:
    """Fit coordinates to a line, smoothed: lines of maps have kinks that would look like steering."""
    line = line[np.r_[True, np.any(np.diff(line, axis=0) != 0, axis=-1)]]
    distance = np.r_[0, np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=-1))]
    even = np.linspace(0, distance[-1], max(round(distance[-1] / SPACING) + 1, FEWEST_POINTS))
    points = np.stack([np.interp(even, distance, coordinate) for coordinate in line.T], axis=-1)
    return LaneCoordinates(make_smoothing_spline(even, points, lam=STIFFNESS), float(distance[-1]))


def read_directory(directory: Path, first: int | None = None) -> list[Recording]:
    """Read the CommonRoad scenarios of a directory, files ``*.xml`` and ``*.xml.gz``, in the order of their names.

    Every moving obstacle is a driver, except those seen only once or moving against the road. Files of one recording,
    such as ``USA_US101-10_4_T-1`` and ``USA_US101-10_5_T-1``, form a group and may share tracks: a track is a driver in
    the first file that has it, and a neighbour in the others.

    Args:
        directory: of the files.
        first: number of files to read; None for all.

    Raises:
        ValueError: if there is no file, or one is no scenario with lanes, drivers and the time step 0.1 s.
        ImportError: without the packages of the extra ``commonroad``.
    """
    if not directory.is_dir():
        raise ValueError(f"{directory} is not a directory; give the one that holds the CommonRoad scenarios")
    paths = sorted(path for path in directory.iterdir() if path.name.endswith((".xml", COMPRESSED)))
    if not paths:
        raise ValueError(f"{directory} holds no CommonRoad scenarios, files *.xml or *.xml.gz")
    counted: set[tuple] = set()
    recordings = []
    for path in paths[:first]:
        scenario = _open(path)
        try:
            recordings.append(_convert(scenario, counted))
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from error
    return recordings


def _open(path: Path) -> Any:
    """Return the scenario of a file, an object of commonroad-io."""
    with temporary_directory() as directory, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # about irrelevant things, such as unknown locations
        with needing("commonroad"):
            from commonroad.common.reader.file_reader_xml import XMLFileReader  # by itself, without protobuf
        with reading(path, "fetch it again", " as a CommonRoad scenario"):
            readable = path
            if path.name.endswith(COMPRESSED):
                readable = directory / path.name.removesuffix(".gz")
                with gzip.open(path) as packed:
                    readable.write_bytes(packed.read(MOST_BYTES + 1))
            if readable.stat().st_size > MOST_BYTES:
                raise ValueError(f"more than {MOST_BYTES} bytes of XML")
            # commonroad-io subtracts one turn after the other from an orientation, which might never end.
            for orientation in ElementTree.parse(readable).iter("orientation"):
                for text in orientation.itertext():
                    if text.strip() and not abs(float(text)) <= MOST_RADIANS:
                        raise ValueError(f"an orientation of {text} rad")
            try:
                return XMLFileReader(readable).open()[0]
            except (AssertionError, AttributeError, TypeError) as error:  # of elements that lack
                raise ValueError(str(error)) from error


def _convert(scenario: Any, counted: set[tuple]) -> Recording:
    """Convert a scenario to a recording; add its drivers to those already counted."""
    if not np.isclose(scenario.dt, TIME_STEP):
        raise ValueError(f"the time step is {scenario.dt} s; it must be {TIME_STEP} s")
    road, lanes, lane_width = _road(scenario.lanelet_network)
    group = f"{scenario.scenario_id.map_name}-{scenario.scenario_id.map_id}"
    obstacles = scenario.dynamic_obstacles
    tracks = [_samples(obstacle) for obstacle in obstacles]
    if not any(len(track) > 1 for track in tracks):
        raise ValueError("there is no dynamic obstacle with two samples, and so no driving")
    times = 1 + max(int(track[-1, 0]) for track in tracks)
    if times * len(tracks) > MOST_STATES:
        raise ValueError(f"there are {len(tracks)} obstacles in {times} time steps; {MOST_STATES} states can be read")
    states, drivers = np.full((times, len(tracks), 4), np.nan), []
    for car, (obstacle, track) in enumerate(zip(obstacles, tracks, strict=True)):
        time, position, orientation, speed = track[:, 0].astype(int), track[:, 1:3], track[:, 3], track[:, 4]
        located = road.locate(position)
        # Headings turn right here, orientations left; only their difference is wrapped.
        heading = (located.heading - orientation + np.pi) % (2 * np.pi) - np.pi
        states[time, car] = np.stack([located.x, located.y, heading, speed], axis=-1)
        identity = (group, obstacle.obstacle_id, *position[0].round(2))
        along_the_road = np.abs(np.median(heading)) < np.pi / 2
        if len(track) > 1 and along_the_road and identity not in counted:
            drivers.append(car)
            counted.add(identity)
    sizes = np.array([_size(obstacle.obstacle_shape) for obstacle in obstacles])
    name, numbers = str(scenario.scenario_id), np.array(drivers, dtype=int)
    return Recording(name, group, states, numbers, sizes, lanes, lane_width, SPEED_LIMIT)


def _samples(obstacle: Any) -> np.ndarray:
    """Return time step, position x and y, orientation and speed of an obstacle, as in the file [times, 5]."""
    states = [obstacle.initial_state]
    states += getattr(getattr(obstacle.prediction, "trajectory", None), "state_list", [])
    name = f"obstacle {obstacle.obstacle_id}"
    try:
        rows = [(state.time_step, *state.position, state.orientation, state.velocity) for state in states]
        samples = np.array(rows, dtype=float).reshape(-1, 5)
    except (AttributeError, TypeError, ValueError) as error:
        raise ValueError(
            f"{name} lacks an exact time, position, orientation or velocity; only recorded driving can be read"
        ) from error
    usable = (np.abs(samples) <= MOST_SAMPLED).all(axis=1)
    if not usable.all():
        time, *rest = samples[~usable][0]
        raise ValueError(f"{name} is nowhere on Earth, or faster than any car, at step {time:g}: {np.array(rest)}")
    if not max(_size(obstacle.obstacle_shape)) <= MOST_SIZE:
        raise ValueError(f"{name} is longer than {MOST_SIZE:g} m; {MEND}")
    if samples[0, 0] < 0 or not (np.diff(samples[:, 0]) > 0).all():
        raise ValueError(f"the times of {name} do not follow each other from 0 on; {MEND}")
    return samples


def _size(shape: Any) -> tuple[float, float]:
    """Return length and width of an obstacle's shape."""
    if hasattr(shape, "length"):
        return shape.length, shape.width
    left, low, right, high = shape.shapely_object.bounds
    return right - left, high - low


def _road(network: Any) -> tuple[LaneCoordinates, Values, float]:
    """Return coordinates along the leftmost lane, the lateral positions of lanes, ascending, and their width."""
    chains = list(_chains(network))
    if not chains:
        raise ValueError("there are no lanelets from which lanes start; driving can only be judged on a road")
    lines = [np.concatenate([lanelet.center_vertices for lanelet in chain]) for chain in chains]
    if not np.ptp(np.concatenate(lines), axis=0).max() <= MOST_METRES:
        raise ValueError(f"lanelets are not finite, or more than {MOST_METRES:g} m apart; {MEND}")
    # Take the line that has most lines parallel to it, one of which stands for all: a ramp has none but itself.
    offsets, alone = np.full(len(lines), np.nan), np.full(len(lines), True)
    for place, line in enumerate(lines):
        if alone[place]:
            found = _offsets(fit_lane_coordinates(line), lines)
            alone &= np.isnan(found)
            offsets = max(offsets, found, key=lambda offset: np.isfinite(offset).sum())
    if not np.isfinite(offsets).any():
        raise ValueError("no lane is straight enough to measure driving along it")
    leftmost = int(np.nanargmin(offsets))
    road = fit_lane_coordinates(lines[leftmost])
    found = np.sort(_offsets(road, lines))
    found = found[np.isfinite(found)]
    lanes = found[np.r_[True, np.diff(found) > DISTINCT_LANES]]
    lanelet = chains[leftmost][0]
    widths = np.linalg.norm(lanelet.left_vertices - lanelet.right_vertices, axis=-1)
    return road, lanes, float(np.median(np.diff(lanes) if len(lanes) > 1 else widths))


def _chains(network: Any) -> Iterator[list[Any]]:
    """Yield every lane: a lanelet without predecessor, and its successors, always the first of several."""
    known = {lanelet.lanelet_id: lanelet for lanelet in network.lanelets}
    for start in network.lanelets:
        if known.keys() & set(start.predecessor):
            continue
        chain = {start.lanelet_id: start}
        while following := [i for i in known[next(reversed(chain))].successor if i in known and i not in chain]:
            chain[following[0]] = known[following[0]]
        yield list(chain.values())


def _offsets(road: LaneCoordinates, lines: list[Points]) -> Values:
    """Return how far to the right of a road's reference line other lines are; NaN for those that are no lanes of it.

    Lanes run in the road's direction and parallel to it, except at the ends. In recording 10 of US-101, a ramp comes
    from 40 m away: nobody drives at its median offset, 23 m.
    """
    offsets = np.full(len(lines), np.nan)
    located, ends = road.locate(np.concatenate(lines)), np.cumsum([len(line) for line in lines])[:-1]
    for line, (x, y) in enumerate(zip(np.split(located.x, ends), np.split(located.y, ends), strict=True)):
        middle = np.median(y)
        if x[-1] > x[0] and np.median(np.abs(y - middle)) < LANE_SPREAD:
            offsets[line] = middle
    return offsets
