"""CommonRoad scenarios: US-101 as it was recorded, and small ones written by hand."""

import gzip

import numpy as np
import pytest
from recordings import SPEED, STEPS, car, lanelet, pedestrian, scenario, straight, two_lanes

from ms_highway.irl.commonroad import read_directory


def read(directory, *texts):
    for number, text in enumerate(texts):
        (directory / f"scenario_{number}.xml").write_text(text)
    return read_directory(directory)


def test_a_road_at_an_angle_becomes_straight_with_y_to_the_right_and_without_ramps_and_opposite_lanes(tmp_path):
    opposite = lanelet(6, -12.0, straight(200, 0))
    ramp = lanelet(5, -14.0, np.linspace(0, 1, 30)[:, None] * [120, -40])
    (recording,) = read(tmp_path, scenario(lanelets=opposite + ramp + two_lanes()))
    assert (recording.name, recording.group) == ("USA_Test-1_1_T-1", "Test-1")
    np.testing.assert_allclose([*recording.lanes, recording.lane_width], [0, 3.5, 3.5], atol=1e-6)
    np.testing.assert_array_equal(recording.sizes, [[4.5, 1.8]] * 2)
    ahead = SPEED * 0.1 * np.arange(STEPS)
    for states, start, y in zip(recording.states.swapaxes(0, 1), (20, 40), (0.0, 3.0), strict=True):
        expected = np.stack(np.broadcast_arrays(start + ahead, y, 0.0, SPEED), axis=-1)
        np.testing.assert_allclose(states, expected, atol=1e-6)


def test_a_track_is_a_driver_only_once_among_the_files_of_one_recording_and_a_pedestrian_never(tmp_path):
    second = scenario(cars=pedestrian(103, 80) + car(100, 20, 0) + car(102, 60, 3.0), number=2)
    recordings = read(tmp_path, scenario(), second, second.replace("Test-1_2", "Test-2_2"))
    assert [recording.drivers.tolist() for recording in recordings] == [[0, 1], [2], [1, 2]]
    assert all(recording.seen.all() for recording in recordings)


def test_a_file_that_unpacks_to_more_than_any_scenario_is_refused(tmp_path):
    (tmp_path / "bomb.xml.gz").write_bytes(gzip.compress(bytes(100_000_001), compresslevel=1))
    with pytest.raises(ValueError, match=r"bomb\.xml\.gz cannot be read as .*more than 100000000 bytes"):
        read_directory(tmp_path)
