"""Measure predicted drivers against recorded ones: displacement, likelihood and calibration, by horizon."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ms_highway.game.learned_drivers import Spread
from ms_highway.irl.outlook import Modes, expected_path, log_density, region_level

__all__ = ["AT", "HORIZONS", "LEVELS", "MISS", "SCALES", "Outcomes", "errors", "measures", "outcomes"]

HORIZONS = (1, 2, 3, 5)  # s
AT = 10 * np.array(HORIZONS) - 1  # places of the horizons among the steps

SCALES = np.array([[0.4, 0.1], [1.0, 0.3], [1.8, 0.5], [3.5, 0.8]])
"""Usual errors at the horizons, along and across the road [m], by which fits weigh them."""

MISS = 2.0  # m
LEVELS = (50, 90, 99)
"""Percentages of probability in the predicted regions whose calibration is measured."""


def errors(paths: Float[np.ndarray, "n 50 2"], recorded: Float[np.ndarray, "n 50 2"]) -> dict[str, dict[str, float]]:
    """Return the displacement errors of predicted paths, by horizon in seconds, of those that any driver reaches.

    Returns:
        ``fde``: mean distance at the horizon [m]; ``ade``: mean distance up to it [m]; ``rmse``: root mean square of
        the distance at it [m]; ``miss``: share of drivers whose distance at it exceeds 2 m.
    """
    distance = np.linalg.norm(paths - recorded, axis=-1)
    found: dict[str, dict[str, float]] = {"fde": {}, "ade": {}, "rmse": {}, "miss": {}}
    for horizon in HORIZONS:
        until = distance[:, : 10 * horizon]
        until = until[np.isfinite(until[:, -1])]
        if not len(until):
            continue
        last = until[:, -1]
        values = last.mean(), until.mean(), np.sqrt((last**2).mean()), (last > MISS).mean()
        for kind, value in zip(found, values, strict=True):
            found[kind][str(horizon)] = float(value)
    return found


class Outcomes(NamedTuple):
    """What became of every prediction, NaN where the driver was not seen.

    Attributes:
        path: that was expected.
        log_p: log density of the recorded position [1/m^2].
        level: probability of the region of highest density that just reaches it.
    """

    path: Float[np.ndarray, "n 50 2"]
    log_p: Float[np.ndarray, "n 50"]
    level: Float[np.ndarray, "n 50"]


def outcomes(modes: Modes, spread: Spread, recorded: Float[np.ndarray, "n 50 2"]) -> Outcomes:
    """Compare predicted distributions with recorded positions."""
    positions = recorded.astype(np.float32)
    log_p, level = np.asarray(log_density(modes, spread, positions)), region_level(modes, spread, positions)
    return Outcomes(expected_path(modes), log_p, level)


def measures(found: Outcomes, recorded: Float[np.ndarray, "n 50 2"]) -> dict[str, dict[str, float]]:
    """Return what a predictor is worth, by horizon in seconds.

    Returns:
        `errors` of the expected paths; ``log_p``: mean log density of the recorded positions [1/m^2]; ``inside 50``
        and so on: share of drivers in the region of highest density that holds 50 % of the probability.
    """
    rows = errors(found.path, recorded)
    at = {horizon: 10 * int(horizon) - 1 for horizon in rows["fde"]}
    rows["log_p"] = {horizon: float(np.nanmean(found.log_p[:, step])) for horizon, step in at.items()}
    for percent in LEVELS:
        rows[f"inside {percent}"] = {
            horizon: float(np.mean(found.level[np.isfinite(found.level[:, step]), step] < percent / 100))
            for horizon, step in at.items()
        }
    return rows
