"""Read CommonRoad scenarios, such as those of the US-101 highway, as recordings in lane coordinates."""

import gzip
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
from jaxtyping import Float

from ms_highway.game.scenario import TIME_STEP
from ms_highway.irl.recordings.lane_coordinates import LaneCoordinates, fit_lane_coordinates
from ms_highway.irl.recordings.recording import Recording
from ms_highway.runtime.files import temporary_directory

__all__ = ["SPEED_LIMIT", "read_directory"]

SPEED_LIMIT = 29.06  # m/s, 65 mph: on US-101, whose scenarios have no traffic signs

LANE_SPREAD = 0.5  # m, median deviation from the median offset, above which lanes are not parallel
DISTINCT_LANES = 1.0  # m, offset below which chains of lanelets are one lane

COMPRESSED = ".xml.gz"

MOST_BYTES = 100_000_000  # of a scenario's XML; those of US-101 have some millions
MOST_METRES = 100_000.0  # from one end of a scenario to the other
MOST_SPEED, MOST_SIZE = 200.0, 100.0  # m/s and m, of a vehicle
MOST_RADIANS = 1000.0  # of an orientation
MOST_STATES = 10_000_000  # of all cars at all times


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
    return [_convert(_open(path), path, counted) for path in paths[:first]]


def _open(path: Path) -> Any:
    """Return the scenario of a file, an object of commonroad-io."""
    with temporary_directory() as directory, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # about irrelevant things, such as unknown locations
        try:
            from commonroad.common.reader.file_reader_xml import XMLFileReader  # by itself, without protobuf
        except ImportError as error:
            raise ImportError(
                "CommonRoad needs the extra 'commonroad': pip install 'ms-highway[commonroad]'"
            ) from error
        try:
            readable = path
            if path.name.endswith(COMPRESSED):
                readable = directory / path.name.removesuffix(".gz")
                with gzip.open(path) as packed:
                    readable.write_bytes(packed.read(MOST_BYTES + 1))
            if readable.stat().st_size > MOST_BYTES:
                raise ValueError(f"more than {MOST_BYTES} bytes of XML")
            _check_orientations(readable)
            scenario, _ = XMLFileReader(readable).open()
        except Exception as error:  # unpacking, parsing and the library raise many kinds
            raise ValueError(
                f"{path} is no CommonRoad scenario, or damaged ({type(error).__name__}: {error}); fetch it again"
            ) from error
    return scenario


def _check_orientations(path: Path) -> None:
    """Refuse large angles: commonroad-io subtracts one turn after the other, which might never end."""
    for orientation in ElementTree.parse(path).iter("orientation"):
        for text in orientation.itertext():
            if text.strip() and not abs(float(text)) <= MOST_RADIANS:
                raise ValueError(f"an orientation of {text} rad")


def _convert(scenario: Any, path: Path, counted: set[tuple]) -> Recording:
    """Convert a scenario to a recording; add its drivers to those already counted."""
    if not np.isclose(scenario.dt, TIME_STEP):
        raise ValueError(f"{path} has a time step of {scenario.dt} s; it must be {TIME_STEP} s")
    road, lanes, lane_width = _road(scenario.lanelet_network, path)
    group = f"{scenario.scenario_id.map_name}-{scenario.scenario_id.map_id}"
    obstacles = scenario.dynamic_obstacles
    tracks = [_samples(obstacle, path) for obstacle in obstacles]
    if not any(len(track) > 1 for track in tracks):
        raise ValueError(f"{path} has no dynamic obstacle with two samples; there is no driving in it")
    _check_extent(np.concatenate([track[:, 1:3] for track in tracks]), path, "obstacles")
    times = 1 + max(int(track[-1, 0]) for track in tracks)
    if times * len(tracks) > MOST_STATES:
        raise ValueError(f"{path} has {len(tracks)} obstacles in {times} time steps; {MOST_STATES} states can be read")
    states = np.full((times, len(tracks), 4), np.nan)
    drivers = []
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
    return Recording(
        name=str(scenario.scenario_id),
        group=group,
        time_step=TIME_STEP,
        states=states,
        drivers=np.array(drivers, dtype=int),
        sizes=np.array([_size(obstacle.obstacle_shape) for obstacle in obstacles]),
        lanes=lanes,
        lane_width=lane_width,
        speed_limit=SPEED_LIMIT,
    )


def _samples(obstacle: Any, path: Path) -> Float[np.ndarray, "times 5"]:
    """Return time step, position x and y, orientation and speed of an obstacle, as in the file."""
    states = [obstacle.initial_state]
    states += getattr(getattr(obstacle.prediction, "trajectory", None), "state_list", [])
    try:
        rows = [(state.time_step, *state.position, state.orientation, state.velocity) for state in states]
        samples = np.array(rows, dtype=float).reshape(-1, 5)
    except (AttributeError, TypeError, ValueError) as error:
        raise ValueError(
            f"{path}: obstacle {obstacle.obstacle_id} lacks an exact time, position, orientation or velocity; "
            "only recorded driving can be read"
        ) from error
    if not np.isfinite(samples).all():
        sample = samples[~np.isfinite(samples).all(axis=1)][0]
        raise ValueError(
            f"{path}: obstacle {obstacle.obstacle_id} is not finite at time step {sample[0]:g}: {sample[1:]}; "
            "mend the file or leave it out"
        )
    if np.abs(samples[:, 4]).max() > MOST_SPEED or max(_size(obstacle.obstacle_shape)) > MOST_SIZE:
        raise ValueError(
            f"{path}: obstacle {obstacle.obstacle_id} is longer than {MOST_SIZE:g} m, or faster than {MOST_SPEED:g}; "
            "mend the file or leave it out"
        )
    if samples[0, 0] < 0 or not (np.diff(samples[:, 0]) > 0).all():
        raise ValueError(
            f"{path}: the times of obstacle {obstacle.obstacle_id} do not follow each other from 0 on; "
            "mend the file or leave it out"
        )
    return samples


def _check_extent(points: Float[np.ndarray, "points 2"], path: Path, of: str) -> None:
    """Refuse points that are not finite or too far apart for a road."""
    if not np.isfinite(points).all():
        raise ValueError(f"{path}: coordinates of {of} are not finite; mend the file or leave it out")
    extent = np.ptp(points, axis=0).max()
    if extent > MOST_METRES:
        raise ValueError(f"{path}: {of} are up to {extent:.3g} m apart; roads of up to {MOST_METRES:g} m can be read")


def _size(shape: Any) -> tuple[float, float]:
    """Return length and width of an obstacle's shape."""
    if hasattr(shape, "length"):
        return shape.length, shape.width
    left, low, right, high = shape.shapely_object.bounds
    return right - left, high - low


def _road(network: Any, path: Path) -> tuple[LaneCoordinates, Float[np.ndarray, "lanes"], float]:
    """Return coordinates along the leftmost lane, the lateral positions of lanes, ascending, and their width."""
    chains = list(_chains(network))
    if not chains:
        raise ValueError(f"{path} has no lanelets from which lanes start; driving can only be judged on a road")
    lines = [np.concatenate([lanelet.center_vertices for lanelet in chain]) for chain in chains]
    _check_extent(np.concatenate(lines), path, "lanelets")
    # Take the line that has most lines parallel to it: a ramp has none but itself.
    offsets = max(
        (_offsets(fit_lane_coordinates(line), lines) for line in lines), key=lambda offset: np.isfinite(offset).sum()
    )
    if not np.isfinite(offsets).any():
        raise ValueError(f"{path} has no lane that is straight enough to measure driving along it")
    road = fit_lane_coordinates(lines[int(np.nanargmin(offsets))])
    found = np.sort(_offsets(road, lines))
    found = found[np.isfinite(found)]
    lanes = found[np.r_[True, np.diff(found) > DISTINCT_LANES]]
    if len(lanes) > 1:
        return road, lanes, float(np.median(np.diff(lanes)))
    lanelet = chains[int(np.nanargmin(offsets))][0]
    return road, lanes, float(np.median(np.linalg.norm(lanelet.left_vertices - lanelet.right_vertices, axis=-1)))


def _chains(network: Any) -> Iterator[list[Any]]:
    """Yield every lane: a lanelet without predecessor, and its successors, always the first of several."""
    known = {lanelet.lanelet_id: lanelet for lanelet in network.lanelets}
    for start in network.lanelets:
        if known.keys() & set(start.predecessor):
            continue
        chain = [start]
        while following := [known[i] for i in chain[-1].successor if i in known and known[i] not in chain]:
            chain.append(following[0])
        yield chain


def _offsets(road: LaneCoordinates, lines: list[Float[np.ndarray, "points 2"]]) -> Float[np.ndarray, "lines"]:
    """Return how far to the right of a road's reference line other lines are; NaN for those that are no lanes of it.

    Lanes run in the road's direction and parallel to it, except at the ends. In recording 10 of US-101, a ramp comes
    from 40 m away: nobody drives at its median offset, 23 m.
    """
    offsets = np.full(len(lines), np.nan)
    for line, points in enumerate(map(road.locate, lines)):
        middle = np.median(points.y)
        if points.x[-1] > points.x[0] and np.median(np.abs(points.y - middle)) < LANE_SPREAD:
            offsets[line] = middle
    return offsets
