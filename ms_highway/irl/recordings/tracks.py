"""A driver's smooth track, and the controls that drive a car along it."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ms_highway.game.dynamics import Dynamics, recover_control, step
from ms_highway.irl.recordings.recording import Recording

__all__ = ["Track", "smoothed", "track_of"]

# Standard deviations. Errors of position and jerks together decide how smooth tracks are: here, oscillations faster
# than (JERK dt / POSITION)^(1/3) / dt, a third of a hertz, count as noise. The other three are wide, and only decide
# what positions leave open, such as the steering of a standing car.
POSITION = 0.2  # m, error of recorded positions
JERK = 2.0  # m/s^3, along the road
LATERAL_JERK = 0.5  # m/s^3, across it
ACCELERATION = 4.0  # m/s^2, along the road
HEADING = 0.2  # rad, at first
CURVATURE = 0.02  # 1/m

CURVATURE_LIMIT = 0.2  # 1/m, of a front wheel turned by 45 degrees
ROUNDS = 2  # of fitting speeds, then headings, each with the other as last known; on a highway one is nearly enough


class Track(NamedTuple):
    """A track: one step of its dynamics with each control leads from each state to the next.

    Attributes:
        states: ``(x, y, heading, speed)``, one more than the controls.
        controls: ``(omega, acceleration)``.
    """

    states: Float[np.ndarray, "times 4"]
    controls: Float[np.ndarray, "steps 2"]


def track_of(recording: Recording, car: int, dynamics: Dynamics) -> Track:
    """Return a car's track: `smoothed` if it was measured, the recorded states if it was simulated.

    Raises:
        ValueError: if the car was seen less than twice, or the recording's time step is not that of the dynamics.
    """
    if not np.isclose(recording.time_step, dynamics.time_step):
        raise ValueError(
            f"{recording.name} has a time step of {recording.time_step} s; plans are made of steps of "
            f"{dynamics.time_step} s, so resample it"
        )
    states = recording.states[recording.seen[:, car], car]
    if len(states) < 2:
        raise ValueError(f"{recording.name}: car {car} was seen {len(states)} times; a track needs two samples")
    if recording.measured:
        return smoothed(states[:, :2], dynamics)
    return Track(states, recover_control(dynamics, states[:-1], states[1:]))


def smoothed(recorded: Float[np.ndarray, "times 2"], dynamics: Dynamics) -> Track:
    """Return the most likely track of a car, given its recorded positions and priors of accelerations and jerks.

    Recorded speeds and headings, themselves derived from noisy positions, are not used. With a step's distance
    ``d = (v + v_next) dt / 2``, two linear least-squares problems are solved in turn, for the initial x and speed v
    and accelerations a; and for the initial y and heading h and curvatures c::

        x = x_0 + sum of d cos(h)    v = v_0 + sum of a dt
        y = y_0 + sum of d sin(h)    h = h_0 + sum of v c dt

    They penalise errors of position, jerks ``a'`` and ``v^2 c'``, and, weakly, a, c and h_0: a standing car therefore
    keeps its heading, and its curvature decays to 0.
    """
    dt = float(dynamics.time_step)
    steps = len(recorded) - 1
    change = np.diff(np.eye(steps), axis=0)
    cosine = sine_per_heading = np.ones(steps)
    for _ in range(ROUNDS):
        speeds = _running(np.eye(steps) * dt)
        distances = (speeds[:-1] + speeds[1:]) * dt / 2
        likely = _without_initial(change / (JERK * dt), np.eye(steps) / ACCELERATION)
        x, *motion = _fit(_running(cosine[:, None] * distances), recorded[:, 0], likely)
        speed = np.maximum(speeds @ motion, 0)

        headings = _running(np.diag(speed[:-1] * dt))
        distance = (speed[:-1] + speed[1:]) * dt / 2
        lateral_jerk = change * speed[1:-1, None] ** 2 / (LATERAL_JERK * dt)
        likely = _without_initial(lateral_jerk, np.eye(steps) / CURVATURE)
        likely = np.vstack([likely, np.eye(1, steps + 2, 1) / HEADING])
        offsets = _running((distance * sine_per_heading)[:, None] * headings[:-1])
        y, *turning = _fit(offsets, recorded[:, 1], likely)
        heading = headings @ [turning[0], *np.clip(turning[1:], -CURVATURE_LIMIT, CURVATURE_LIMIT)]
        cosine, sine_per_heading = np.cos(heading[:-1]), np.sinc(heading[:-1] / np.pi)

    likeliest = np.stack([np.full_like(speed, x), np.full_like(speed, y), heading, speed], axis=-1)
    controls = recover_control(dynamics, likeliest[:-1], likeliest[1:])
    states = [likeliest[0]]
    for control in controls:
        states.append(step(dynamics, states[-1], control))
    return Track(np.stack(states), controls)


def _running(increments: Float[np.ndarray, "steps unknowns"]) -> Float[np.ndarray, "steps+1 unknowns+1"]:
    """Return the matrix that maps a quantity's initial value and the unknowns in its increments to all its values."""
    sums = np.pad(np.cumsum(increments, axis=0), ((1, 0), (0, 0)))
    return np.column_stack([np.ones(len(sums)), sums])


def _without_initial(*penalties: Float[np.ndarray, "_ steps"]) -> Float[np.ndarray, "rows steps+2"]:
    """Return penalties of controls only: zero columns for the two initial values come first."""
    return np.pad(np.vstack(penalties), ((0, 0), (2, 0)))


def _fit(
    positions: Float[np.ndarray, "times unknowns"],
    recorded: Float[np.ndarray, "times"],
    likely: Float[np.ndarray, "rows unknowns"],
) -> Float[np.ndarray, "unknowns"]:
    """Return the unknowns that fit the positions best, with penalties in units of standard deviations."""
    errors = np.pad(recorded / POSITION, (0, len(likely)))
    return np.linalg.lstsq(np.vstack([positions / POSITION, likely]), errors)[0]
