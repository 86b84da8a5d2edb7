"""Predict where the cars of one moment of traffic will be, without a recording."""

from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from ms_highway.data.learned_drivers import LearnedDrivers, Spread
from ms_highway.data.learned_reward import LearnedReward, shipped_drivers
from ms_highway.game.dynamics import without_turns
from ms_highway.game.scenario import TIME_STEP
from ms_highway.irl.mixture import expected_path
from ms_highway.irl.prediction import predict_with
from ms_highway.irl.snapshots import SNAPSHOT, Snapshots


class Forecast(NamedTuple):
    """Where cars may be, by mode, and over all modes.

    In mode 0 a car stays in its lane, in mode 1 it changes to the left, in mode 2 to
    the right. The predicted distributions are Student's t: their tails are heavier than
    normal, and their variance may be infinite. The covariance of a mode is therefore
    that of the normal distribution whose region of 50 % probability is the same.

    Attributes:
        times: of the predicted positions [s].
        weights: probability of each mode of each car.
        means: x and y in each mode [m].
        covariances: around the means of the modes [m^2].
        mean: x and y over all modes [m].
        covariance: over all modes, of the mixture of normal distributions [m^2].
    """

    times: Float[np.ndarray, "times"]
    weights: Float[np.ndarray, "cars modes"]
    means: Float[np.ndarray, "cars modes times 2"]
    covariances: Float[np.ndarray, "modes times 2 2"]
    mean: Float[np.ndarray, "cars times 2"]
    covariance: Float[np.ndarray, "cars times 2 2"]


def predict(
    states: ArrayLike,
    lanes: ArrayLike,
    speed_limit: float,
    *,
    seconds: float = 5.0,
    predictor: str = "model",
    sizes: ArrayLike = (5.0, 2.0),
    lane_width: float = 4.0,
    learned: LearnedReward | LearnedDrivers | None = None,
) -> Forecast:
    """Predict all cars of a moment on a straight road, together, every 0.1 s.

    All numbers are in SI units, with x along the road and y to the right. The first
    call for each predictor compiles functions, and so does the first call for each
    further 16 cars.

    Args:
        states: x, y, heading and speed of every car now [cars, 4]; or [times, cars, 4],
            every 0.1 s from up to 3 s before until now, NaN where a car was not seen.
            The past shows what drivers want.
        lanes: lateral position of each lane's centre [m].
        speed_limit: of the road, to which drivers' desired speeds are proportional
            [m/s].
        seconds: how far ahead to predict, from 0.1 to 5 s.
        predictor: of `ms_highway.irl.prediction.PREDICTORS`: ``"model"``, the learned
            drivers; ``"idm"``, highway-env's Intelligent Driver Model;
            ``"fitted_idm"``, that model fitted to the same drivers;
            ``"constant_velocity"``.
        sizes: length and width of all cars, or of each [cars, 2] [m].
        lane_width: of a lane [m].
        learned: the learned drivers, or a reward with such drivers; they also hold the
            spread of every predictor. By default, the drivers of US-101 that come with
            the package.

    Raises:
        ValueError: for arrays of other shapes, cars that are not seen now, an unknown
            predictor or a number out of range.
    """
    past = _checked_past(states)
    cars = past.shape[1]
    centres = np.array(lanes, dtype=float)
    bodies = np.array(sizes, dtype=float)
    steps = round(seconds / TIME_STEP)
    are_centres = centres.ndim == 1 and centres.size > 0
    _check("lanes", lanes, are_centres and bool(np.isfinite(centres).all()))
    are_sizes = bodies.shape in ((2,), (cars, 2))
    _check("sizes", sizes, are_sizes and bool((bodies > 0).all()))
    _check("speed_limit", speed_limit, 0 < speed_limit < np.inf)
    _check("lane_width", lane_width, 0 < lane_width < np.inf)
    _check("seconds", seconds, 1 <= steps <= SNAPSHOT.future_steps)

    snapshot = _snapshot(past, bodies, np.sort(centres), lane_width, speed_limit)
    if isinstance(learned, LearnedReward):
        drivers = learned.drivers
    else:
        drivers = learned or shipped_drivers()
    modes, spread = predict_with(predictor, snapshot, drivers)

    # Only the cars and the steps that were asked for.
    weights = np.asarray(modes.probability)[:cars]
    means = np.asarray(modes.path)[:cars, :, :steps]
    expected = np.asarray(expected_path(modes))
    mean = expected[:cars, :steps]

    # The mixture's covariance: that of each mode, and of the means of modes.
    covariances = _covariances(spread, means.shape[1], steps)
    deviations = means - mean[:, None]  # [cars, modes, times, 2]
    outer = deviations[..., :, None] * deviations[..., None, :]
    covariance = np.einsum("cm,cmtij->ctij", weights, covariances + outer)
    times = TIME_STEP * np.arange(1, steps + 1)
    return Forecast(times, weights, means, covariances, mean, covariance)


def _check(name: str, value: object, is_possible: bool) -> None:
    """Check an argument of `predict`.

    Raises:
        ValueError: if its value is impossible.
    """
    if not is_possible:
        raise ValueError(
            f"{name} cannot be {value!r}; give positive finite numbers as"
            " `help(predict)` says"
        )


def _checked_past(states: ArrayLike) -> Float[np.ndarray, "times cars 4"]:
    """Return the past of all cars, with headings within a turn.

    Raises:
        ValueError: for arrays of other shapes, and cars that are not seen now.
    """
    past = np.array(states, dtype=float)
    past = past[None] if past.ndim == 2 else past
    past[..., 2:3] = without_turns(past[..., 2:3])
    times = SNAPSHOT.past_steps + 1
    is_past = past.ndim == 3 and past.shape[2] == 4 and len(past) <= times
    is_complete = is_past and past.size > 0 and np.isfinite(past[-1]).all()
    if not is_complete:
        raise ValueError(
            f"states are of shape {np.shape(states)}, or not all seen now; give finite"
            f" numbers [cars, 4], or up to {times} times of them, finite at the last"
        )
    return past


def _snapshot(
    past: Float[np.ndarray, "times cars 4"],
    sizes: Float[np.ndarray, "*cars 2"],
    lanes: Float[np.ndarray, "lanes"],
    lane_width: float,
    speed_limit: float,
) -> Snapshots:
    """Return a single snapshot of the last moment, whose future is not seen.

    Cars are padded to a multiple of 16, so that functions are compiled for few numbers
    of cars.
    """
    cars = past.shape[1]
    missing = (0, -cars % 16)
    unseen = SNAPSHOT.past_steps + 1 - len(past)
    states = np.pad(
        past,
        ((unseen, SNAPSHOT.future_steps), missing, (0, 0)),
        constant_values=np.nan,
    )
    of_each = np.broadcast_to(sizes, (cars, 2))
    padded_sizes = np.pad(of_each, (missing, (0, 0)), constant_values=1.0)
    numbers = np.arange(len(padded_sizes))
    snapshot = Snapshots(
        past=states[: -SNAPSHOT.future_steps],
        future=states[-SNAPSHOT.future_steps :],
        sizes=padded_sizes,
        lanes=lanes,
        lane_width=np.asarray(lane_width),
        speed_limit=np.asarray(speed_limit),
        predicted=numbers >= 0,
        track=numbers,
        group=np.asarray(0),
    )
    return jax.tree.map(lambda part: np.asarray(part)[None], snapshot)


def _covariances(
    spread: Spread,
    modes: int,
    steps: int,
) -> Float[np.ndarray, "modes times 2 2"]:
    """Return covariances of normal distributions that are as wide as a spread [m^2].

    Their region of 50 % probability is that of its Student t distributions. The squared
    radius r^2 of that region, in scales, is ``2 log 2`` for the normal distribution,
    and ``nu (exp(2 log 2 / nu) - 1)`` for Student's with nu degrees of freedom.
    """
    normal_square = 2 * np.log(2)
    freedom = np.asarray(spread.freedom(steps))
    scales = np.asarray(spread.scales(modes, steps))
    wider = freedom * np.expm1(normal_square / freedom) / normal_square
    variances = wider[:, None] * scales**2  # [modes, times, 2]
    return variances[..., None] * np.eye(2)
