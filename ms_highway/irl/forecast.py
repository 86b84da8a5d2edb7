"""Forecast the cars of one moment of traffic, without recordings: modes, means and covariances, second by second."""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from ms_highway.game.learned_drivers import LearnedDrivers
from ms_highway.game.learned_reward import LearnedReward, shipped
from ms_highway.game.scenario import TIME_STEP
from ms_highway.irl.mixture import expected_path
from ms_highway.irl.prediction import check_drivers, predict_with
from ms_highway.irl.snapshots import STEPS, Snapshots
from ms_highway.planning.learned_driving import PAST

ROOM = 16  # cars: arrays grow by so many, so that few numbers of cars compile anew
WITHIN = 0.5  # probability of the region by which covariances are chosen


class Forecast(NamedTuple):
    """Where cars may be; in mode 0, a car stays in its lane, in modes 1 and 2, it changes to the left or to the right.

    Predicted distributions are Student's t, whose tails are heavier than normal and whose variance may be infinite. The
    covariance of a mode is that of the normal distribution with the same region of 50 % probability.

    Attributes:
        times: of what follows [s].
        weights: probability of each mode of each car.
        means: x and y in each mode [m].
        covariances: around these [m^2].
        mean: x and y over all modes [m].
        covariance: over all modes, of the mixture of normal distributions [m^2].
    """

    times: Float[Any, "times"]
    weights: Float[Any, "cars modes"]
    means: Float[Any, "cars modes times 2"]
    covariances: Float[Any, "modes times 2 2"]
    mean: Float[Any, "cars times 2"]
    covariance: Float[Any, "cars times 2 2"]


def predict(
    states: Any,
    lanes: Any,
    speed_limit: float,
    *,
    seconds: float = 5.0,
    predictor: str = "model",
    sizes: Any = (5.0, 2.0),
    lane_width: float = 4.0,
    learned: LearnedReward | LearnedDrivers | None = None,
) -> Forecast:
    """Predict all cars of a moment on a straight road, together, every 0.1 s.

    All in SI units: x along the road, y to the right. The first call for each predictor and 16 cars more compiles.

    Args:
        states: x, y, heading and speed of every car now [cars, 4]; or [times, cars, 4], now and up to 3 s before, every
            0.1 s, the present last, NaN where a car was not seen: the past shows what drivers want.
        lanes: lateral position of each lane's centre [m].
        speed_limit: of the road, which drivers' desired speeds follow [m/s].
        seconds: how far ahead, from 0.1 to 5 s.
        predictor: of `ms_highway.irl.prediction.PREDICTORS`: ``"model"``, the learned drivers; ``"idm"``, highway-env's
            Intelligent Driver Model; ``"fitted_idm"``, that model fitted to the same drivers; ``"constant_velocity"``.
        sizes: length and width of all cars, or of each [cars, 2] [m].
        lane_width: of a lane [m].
        learned: drivers, or the reward that has them, and how far off every predictor is; by default those of US-101
            that come with the package.

    Raises:
        ValueError: for arrays of other shapes, cars that are not seen now, an unknown predictor or a number out of
            range.
    """
    past = np.array(states, dtype=float)
    past = past[None] if past.ndim == 2 else past
    shaped = past.ndim == 3 and past.size and past.shape[-1] == 4 and len(past) <= PAST + 1
    if not (shaped and np.isfinite(past[-1]).all()):
        message = f"finite numbers [cars, 4], or up to {PAST + 1} times of them, finite at the last"
        raise ValueError(f"states are of shape {np.shape(states)}, or not all seen now; give {message}")
    cars, centres, bodies = past.shape[1], np.array(lanes, dtype=float), np.array(sizes, dtype=float)
    if centres.ndim != 1 or not centres.size or not np.isfinite(centres).all():
        raise ValueError(f"lanes are {lanes!r}; give the lateral position of each lane's centre in m")
    if bodies.shape not in ((2,), (cars, 2)) or not (bodies > 0).all():
        raise ValueError(f"sizes are {sizes!r}; give length and width of all cars, or of each, in m")
    for name, value in (("speed_limit", speed_limit), ("lane_width", lane_width)):
        if not 0 < value < np.inf:
            raise ValueError(f"{name} is {value!r}; give a positive number")
    if not TIME_STEP <= seconds <= STEPS * TIME_STEP:
        raise ValueError(f"seconds are {seconds!r}; give a number from {TIME_STEP:g} to {STEPS * TIME_STEP:g}")
    snapshot = _snapshot(past, np.sort(centres), np.broadcast_to(bodies, (cars, 2)), lane_width, speed_limit)
    learned = learned or shipped("us101")
    drivers = check_drivers(learned.drivers if isinstance(learned, LearnedReward) else learned)
    modes, spread = predict_with(predictor, snapshot, drivers)
    steps = round(seconds / TIME_STEP)
    weights, means = np.asarray(modes.probability)[:cars], np.asarray(modes.path)[:cars, :, :steps]
    freedom, scales = np.asarray(spread.freedom(steps)), np.asarray(spread.scales(means.shape[1], steps))
    wider = freedom * np.expm1(-2 / freedom * np.log1p(-WITHIN)) / (-2 * np.log1p(-WITHIN))  # squares at the edge
    covariances = (wider[:, None] * scales**2)[..., None] * np.eye(2)
    mean = expected_path(modes)[:cars, :steps]
    off = means - mean[:, None]
    apart = covariances + off[..., :, None] * off[..., None, :]
    covariance = np.einsum("cm,cmtij->ctij", weights, apart)
    return Forecast(TIME_STEP * np.arange(1, steps + 1), weights, means, covariances, mean, covariance)


def _snapshot(
    past: np.ndarray, lanes: np.ndarray, sizes: np.ndarray, lane_width: float, speed_limit: float
) -> Snapshots:
    """Return the snapshot of these cars, and of unseen ones that fill the arrays, all of them to be predicted."""
    more, before = -past.shape[1] % ROOM, PAST + 1 - len(past)
    seen = np.pad(past, ((before, 0), (0, more), (0, 0)), constant_values=np.nan)
    whole, numbers = np.pad(sizes, ((0, more), (0, 0)), constant_values=1.0), np.arange(seen.shape[1])
    future = np.full((STEPS, *seen.shape[1:]), np.nan)
    parts = seen, future, whole, lanes, lane_width, speed_limit, np.ones(len(numbers), bool), numbers, 0
    return Snapshots(*(np.asarray(part)[None] for part in parts))
