"""CommonRoad scenarios: US-101 as it was recorded, and small ones written by hand."""

import gzip

import numpy as np
import pytest
from recordings import (
    SPEED,
    STEPS,
    TURN,
    car,
    lanelet,
    moving,
    pedestrian,
    place,
    scenario,
    straight,
    two_lanes,
)

from ms_highway.irl.commonroad import read_directory
from ms_highway.irl.usable import usable_recordings


def read(directory, *texts):
    for number, text in enumerate(texts):
        (directory / f"scenario_{number}.xml").write_text(text)
    return read_directory(directory)


def test_a_road_at_an_angle_becomes_straight(tmp_path):
    """Its y is to the right, and ramps and opposite lanes are left out."""
    opposite = lanelet(6, -12.0, straight(200, 0))
    ramp = lanelet(5, -14.0, np.linspace(0, 1, 30)[:, None] * [120, -40])
    (recording,) = read(tmp_path, scenario(lanelets=opposite + ramp + two_lanes()))
    assert (recording.name, recording.group) == ("USA_Test-1_1_T-1", "Test-1")
    np.testing.assert_allclose(
        [*recording.lanes, recording.lane_width], [0, 3.5, 3.5], atol=1e-6
    )
    np.testing.assert_array_equal(recording.sizes, [[4.5, 1.8]] * 2)
    ahead = SPEED * 0.1 * np.arange(STEPS)
    for states, start, y in zip(
        recording.states.swapaxes(0, 1), (20, 40), (0.0, 3.0), strict=True
    ):
        expected = np.stack(np.broadcast_arrays(start + ahead, y, 0.0, SPEED), axis=-1)
        np.testing.assert_allclose(states, expected, atol=1e-6)


def test_a_track_is_a_driver_in_one_file_only(tmp_path):
    """A pedestrian never is one."""
    cars = pedestrian(103, 80) + car(100, 20, 0) + car(102, 60, 3.0)
    second = scenario(cars=cars, number=2)
    of_another_recording = second.replace("Test-1_2", "Test-2_2")
    recordings = read(tmp_path, scenario(), second, of_another_recording)
    drivers = [recording.drivers.tolist() for recording in recordings]
    assert drivers == [[0, 1], [2], [1, 2]]
    assert all(recording.seen.all() for recording in recordings)


def test_a_file_that_unpacks_to_too_much_is_refused(tmp_path):
    packed = gzip.compress(bytes(100_000_001), compresslevel=1)
    (tmp_path / "bomb.xml.gz").write_bytes(packed)
    with pytest.raises(
        ValueError, match=r"bomb\.xml\.gz cannot be read as .*more than 100000000 bytes"
    ):
        read_directory(tmp_path)


def along_the_road(number, steps, ahead, speed=SPEED):
    """A car in the right lane, which is at these distances along the road at these
    steps.
    """
    states = [
        (step, *place(along, 3.5), TURN, speed)
        for step, along in zip(steps, ahead, strict=True)
    ]
    return moving(number, states)


def test_unusable_drivers_are_left_out_and_named(tmp_path):
    """Their driving is impossible, or says nothing."""
    steps = np.arange(STEPS)
    ahead = SPEED * 0.1 * steps
    odd = {
        200: along_the_road(200, steps, np.full(STEPS, 150.0), speed=0.0),
        201: along_the_road(201, steps, 60 + ahead + 30.0 * (steps > 9)),
        202: along_the_road(202, steps, 100 + ahead, speed=-SPEED),
        203: along_the_road(203, np.delete(steps, 7), np.delete(10 + ahead, 7)),
        204: car(204, 20, 0),  # where the car 100 is
    }
    short = car(205, 80, 3.5, samples=2)
    cars = car(100, 20, 0) + car(101, 40, 3.0) + short + "".join(odd.values())
    (recording,) = read(tmp_path, scenario(cars=cars))
    with pytest.warns(
        UserWarning,
        match=(
            "5 drivers are left out: obstacle 203 of USA_Test-1_1_T-1, which was not"
            " seen"
        ),
    ):
        (kept,), left_out = usable_recordings([recording])
    assert [kept.label(driver) for driver in kept.drivers] == [
        "obstacle 100",
        "obstacle 101",
        "obstacle 205",
    ]
    assert {name.split()[1]: reason for name, reason in left_out.items()} == {
        "200": "only stands",
        "201": "jumps at step 10 of its track",
        "202": "drives backwards, at -12.0 m/s",
        "203": "was not seen at each step from 0 to 19",
        "204": "is always where obstacle 100 is",
    }
    present = [kept.label(number) for number in np.flatnonzero(kept.seen.any(axis=0))]
    assert present == [
        "obstacle 100",
        "obstacle 101",
        "obstacle 205",
        *(f"obstacle {number}" for number in range(200, 204)),
    ]
    (alone,) = read(tmp_path, scenario(cars=odd[200]))
    with pytest.raises(
        ValueError,
        match="have no driver but obstacle 200 of USA_Test-1_1_T-1, which only stands",
    ):
        usable_recordings([alone])
