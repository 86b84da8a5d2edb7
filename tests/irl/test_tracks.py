"""Smooth tracks and their controls, computed from recorded positions."""

from functools import partial
from itertools import accumulate

import numpy as np

from ms_highway.game.dynamics import step
from ms_highway.game.scenario import PAPER_DYNAMICS
from ms_highway.irl.recording import Recording
from ms_highway.irl.tracks import track_of

TIME = np.arange(80) * 0.1
# A gentle swerve and some braking, at 20 m/s.
WAVE = np.stack([0.001 * np.sin(TIME), 4 + np.sin(TIME / 2)], axis=-1)


def tracked(states):
    """The smooth track of one car on a single lane."""
    road = np.array([0]), np.array([[5.0, 2.0]]), np.zeros(1), 3.5, 30.0
    return track_of(Recording("a road", "roads", states[:, None], *road), 0)


def driven(start, controls):
    """The states of a car that starts in a state and is driven by controls."""
    states = accumulate(controls, partial(step, PAPER_DYNAMICS), initial=start)
    return np.stack(list(states))


STATES = driven(np.array([5.0, 1.0, 0.02, 20.0]), WAVE)


def error(track):
    """Root mean square distance from the true states [m]."""
    return np.sqrt(2 * np.mean((track.states - STATES)[:, :2] ** 2))


def test_controls_drive_the_car_along_its_track_wherever_it_is():
    track = tracked(STATES)
    far = tracked(STATES + np.array([400.0, 17.0, 0, 0]))
    np.testing.assert_allclose(
        driven(track.states[0], track.controls), track.states, atol=1e-9
    )
    np.testing.assert_allclose(far.controls, track.controls, atol=1e-6)
    assert error(track) < 0.1


def test_noise_is_not_taken_for_driving():
    noise = np.random.default_rng(0).normal(size=STATES.shape)
    track = tracked(STATES + noise * [0.1, 0.1, 0, 0])
    assert error(track) < 0.06
    curvatures, accelerations = (track.controls - WAVE).std(axis=0)
    assert curvatures < 0.0005
    assert accelerations < 0.3  # second differences would give 24
