"""Compute smooth tracks of drivers, with their controls, from noisy positions."""

from dataclasses import dataclass
from functools import partial
from itertools import accumulate
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ms_highway.game.dynamics import recover_control, step
from ms_highway.game.scenario import PAPER_DYNAMICS, TIME_STEP
from ms_highway.irl.recording import Recording

Values = Float[np.ndarray, "times"]
Points = Float[np.ndarray, "times 2"]
States = Float[np.ndarray, "times 4"]


@dataclass(frozen=True)
class TrackSmoothing:
    """Set the standard deviations by which tracks are smoothed.

    Errors of position and jerks together decide how smooth tracks are: oscillations
    faster than ``(jerk dt / position_error)^(1/3) / dt``, here a third of a hertz,
    count as noise. The other three are wide: they only decide what positions do not
    determine, such as the steering of a standing car.
    """

    position_error: float = 0.2
    """Error of recorded positions [m]."""
    jerk: float = 2.0
    """Jerk along the road [m/s^3]."""
    lateral_jerk: float = 0.5
    """Jerk across the road [m/s^3]."""
    acceleration: float = 4.0
    """Acceleration along the road [m/s^2]."""
    heading: float = 0.2
    """Heading at the start [rad]."""
    curvature: float = 0.02
    """Curvature of the path [1/m]."""
    largest_curvature: float = 0.2
    """Limit of the curvature, with the front wheels turned by 45 degrees [1/m]."""
    rounds: int = 2
    """Rounds of the fit: in each, speeds are fitted for the last headings, then
    headings for these speeds. One is nearly enough.
    """


TRACK_SMOOTHING = TrackSmoothing()


class Track(NamedTuple):
    """States and the controls between them.

    A control leads from a state to the next by `ms_highway.game.dynamics.step`.

    Attributes:
        states: ``(x, y, heading, speed)``, one more than the controls.
        controls: ``(omega, acceleration)``.
    """

    states: States
    controls: Float[np.ndarray, "steps 2"]


def track_of(recording: Recording, car: int) -> Track:
    """Return the track of a car while it was seen.

    It is `smoothed` if it was measured, as recorded if it was simulated.
    """
    states = recording.states[recording.seen[:, car], car]
    if recording.measured:
        return smoothed(states[:, :2])
    controls = recover_control(PAPER_DYNAMICS, states[:-1], states[1:])
    return Track(states, controls)


def smoothed(recorded: Points) -> Track:
    """Return the most likely track of a car, given its recorded positions.

    Recorded speeds and headings are not used: they were derived from noisy positions.
    With the distance of a step ``d = (v + v_next) dt / 2``, two linear least-squares
    problems are solved in turn: one for the initial x, the initial speed v and the
    accelerations a; one for the initial y, the initial heading h and the curvatures c::

        x = x_0 + sum of d cos(h)    v = v_0 + sum of a dt
        y = y_0 + sum of d sin(h)    h = h_0 + sum of v c dt

    They penalise errors of position, jerks ``a'`` and ``v^2 c'``, and, weakly, a, c and
    h_0: a standing car therefore keeps its heading, and its curvature decays to 0.
    """
    steps = len(recorded) - 1
    cosine = np.ones(steps)  # cos(h) of each step
    sine_per_heading = np.ones(steps)  # sin(h) / h
    for _ in range(TRACK_SMOOTHING.rounds):
        x, speed = _fit_along(recorded[:, 0], cosine)
        y, heading = _fit_across(recorded[:, 1], speed, sine_per_heading)
        cosine = np.cos(heading[:-1])
        sine_per_heading = np.sinc(heading[:-1] / np.pi)

    # The controls between these states, and the states to which they lead exactly.
    fields = np.broadcast_arrays(x, y, heading, speed)
    likeliest = np.stack(fields, axis=-1)
    controls = recover_control(PAPER_DYNAMICS, likeliest[:-1], likeliest[1:])
    one_step = partial(step, PAPER_DYNAMICS)
    states = accumulate(controls, one_step, initial=likeliest[0])
    return Track(np.stack(list(states)), controls)


def _fit_along(recorded: Values, cosine: Values) -> tuple[float, Values]:
    """Return the initial x and the speeds that fit recorded places along the road.

    Args:
        recorded: x [m].
        cosine: of the heading in each step.
    """
    dt = TIME_STEP
    identity = np.eye(len(cosine))  # the acceleration of each step

    # Speeds and places as linear functions of the unknowns: x_0, v_0, accelerations.
    speeds = _cumulative(identity * dt)
    distances = (speeds[:-1] + speeds[1:]) * dt / 2
    places = _cumulative(cosine[:, None] * distances)

    # Penalties, in standard deviations.
    changes = np.diff(identity, axis=0)
    jerks = changes / (TRACK_SMOOTHING.jerk * dt)
    accelerations = identity / TRACK_SMOOTHING.acceleration

    x, *motion = _least_squares(places, recorded, jerks, accelerations)
    fitted_speeds = speeds @ motion
    return x, np.maximum(fitted_speeds, 0)


def _fit_across(
    recorded: Values,
    speed: Values,
    sine_per_heading: Values,
) -> tuple[float, Values]:
    """Return the initial y and the headings that fit recorded places across the road.

    Args:
        recorded: y [m].
        speed: at each time [m/s].
        sine_per_heading: ``sin(h) / h`` in each step.
    """
    dt = TIME_STEP
    identity = np.eye(len(sine_per_heading))  # the curvature of each step

    # Headings and places as linear functions of the unknowns: y_0, h_0, curvatures.
    headings = _cumulative(np.diag(speed[:-1] * dt))
    distance = (speed[:-1] + speed[1:]) * dt / 2
    offset_per_heading = distance * sine_per_heading
    places = _cumulative(offset_per_heading[:, None] * headings[:-1])

    # Penalties, in standard deviations.
    changes = np.diff(identity, axis=0)
    lateral_jerks = changes * speed[1:-1, None] ** 2
    jerks = lateral_jerks / (TRACK_SMOOTHING.lateral_jerk * dt)
    curvatures = identity / TRACK_SMOOTHING.curvature
    first_heading = np.eye(1, len(identity) + 1) / TRACK_SMOOTHING.heading
    y, start, *turning = _least_squares(
        places, recorded, jerks, curvatures, first_heading
    )
    limit = TRACK_SMOOTHING.largest_curvature
    possible_turning = np.clip(turning, -limit, limit)
    return y, headings @ [start, *possible_turning]


def _cumulative(increments: np.ndarray) -> np.ndarray:
    """Return the matrix from an initial value and unknowns to all values.

    Args:
        increments: matrix from the unknowns to the increments.
    """
    sums = np.cumsum(increments, axis=0)
    with_start = np.pad(sums, ((1, 0), (0, 0)))
    per_initial = np.ones(len(with_start))
    return np.column_stack([per_initial, with_start])


def _least_squares(
    positions: np.ndarray,
    recorded: Values,
    *penalties: np.ndarray,
) -> Values:
    """Return the unknowns that fit recorded positions best, with penalties.

    Args:
        positions: matrix from the unknowns to the positions.
        recorded: positions [m].
        penalties: matrices from the last of the unknowns to errors in standard
            deviations.
    """
    # Errors of position and penalties, as rows of one system.
    unknowns = positions.shape[1]
    rows = [positions / TRACK_SMOOTHING.position_error]
    for penalty in penalties:
        first_unknowns = unknowns - penalty.shape[1]
        rows.append(np.pad(penalty, ((0, 0), (first_unknowns, 0))))
    matrix = np.vstack(rows)

    # Penalties are to be 0.
    rows_of_penalties = len(matrix) - len(recorded)
    scaled = recorded / TRACK_SMOOTHING.position_error
    targets = np.pad(scaled, (0, rows_of_penalties))
    return np.linalg.lstsq(matrix, targets)[0]
