"""Predict where the cars of one moment of traffic will be, without a recording: modes,
means and covariances.
"""

from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from ms_highway.data.learned_drivers import LearnedDrivers
from ms_highway.data.learned_reward import LearnedReward, shipped_drivers
from ms_highway.game.dynamics import without_turns
from ms_highway.game.scenario import TIME_STEP
from ms_highway.irl.mixture import expected_path
from ms_highway.irl.prediction import predict_with
from ms_highway.irl.snapshots import PAST_STEPS, STEPS, Snapshots

# cars are padded to a multiple of this, so that functions are compiled for few numbers
# of cars
ROOM = 16
WITHIN = (
    2 * np.log(2)
)  # squared radius, in standard deviations, that holds half of a bivariate normal distribution


class Forecast(NamedTuple):
    """Where cars may be. In mode 0 a car stays in its lane, in mode 1 it changes to the
    left, in mode 2 to the right.

    The predicted distributions are Student's t: their tails are heavier than normal,
    and their variance may be infinite. The covariance of a mode is therefore that of
    the normal distribution whose region of 50 % probability is the same.

    Attributes:
        times: of the predicted positions [s].
        weights: probability of each mode of each car.
        means: x and y in each mode [m].
        covariances: around the means of the modes [m^2].
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
    past, centres, bodies = (
        np.array(values, dtype=float) for values in (states, lanes, sizes)
    )
    past = past[None] if past.ndim == 2 else past
    past[..., 2:3] = without_turns(past[..., 2:3])
    shaped = past.ndim == 3 and past.shape[2] == 4 and len(past) <= PAST_STEPS + 1
    if not (shaped and past.size and np.isfinite(past[-1]).all()):
        message = (
            f"finite numbers [cars, 4], or up to {PAST_STEPS + 1} times of them, finite"
            " at the last"
        )
        raise ValueError(
            f"states are of shape {np.shape(states)}, or not all seen now; give"
            f" {message}"
        )
    cars = past.shape[1]
    steps = round(seconds / TIME_STEP)
    for name, value, right in (
        (
            "lanes",
            lanes,
            centres.ndim == 1 and centres.size and np.isfinite(centres).all(),
        ),
        ("sizes", sizes, bodies.shape in ((2,), (cars, 2)) and (bodies > 0).all()),
        ("speed_limit", speed_limit, 0 < speed_limit < np.inf),
        ("lane_width", lane_width, 0 < lane_width < np.inf),
        ("seconds", seconds, 1 <= steps <= STEPS),
    ):
        if not right:
            raise ValueError(
                f"{name} cannot be {value!r}; give positive finite numbers as"
                " `help(predict)` says"
            )
    missing = 0, -cars % ROOM
    near = np.pad(
        past,
        ((PAST_STEPS + 1 - len(past), STEPS), missing, (0, 0)),
        constant_values=np.nan,
    )
    bodies = np.pad(
        np.broadcast_to(bodies, (cars, 2)), (missing, (0, 0)), constant_values=1.0
    )
    numbers = np.arange(len(bodies))
    snapshot = Snapshots(
        near[:-STEPS],
        near[-STEPS:],
        bodies,
        np.sort(centres),
        np.asarray(lane_width),
        np.asarray(speed_limit),
        numbers >= 0,
        numbers,
        0,
    )
    drivers = (
        learned.drivers
        if isinstance(learned, LearnedReward)
        else learned or shipped_drivers()
    )
    modes, spread = predict_with(
        predictor, jax.tree.map(lambda part: np.asarray(part)[None], snapshot), drivers
    )
    weights = np.asarray(modes.probability)[:cars]
    means = np.asarray(modes.path)[:cars, :, :steps]
    freedom = np.asarray(spread.freedom(steps))
    scales = np.asarray(spread.scales(means.shape[1], steps))
    wider = (
        freedom * np.expm1(WITHIN / freedom) / WITHIN
    )  # squared radius of Student's region, relative to WITHIN
    covariances = (wider[:, None] * scales**2)[..., None] * np.eye(2)
    mean = expected_path(modes)[:cars, :steps]
    deviations = means - mean[:, None]
    outer = deviations[..., :, None] * deviations[..., None, :]
    covariance = np.einsum("cm,cmtij->ctij", weights, covariances + outer)
    return Forecast(
        TIME_STEP * np.arange(1, steps + 1),
        weights,
        means,
        covariances,
        mean,
        covariance,
    )
