"""All predictors of recorded drivers by name: what was learned, and the peers that it is compared with."""

from collections.abc import Callable, Mapping
from dataclasses import asdict, fields
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool

from ms_highway.game.learned_drivers import LearnedDrivers, Spread
from ms_highway.irl.driving import Others, predict
from ms_highway.irl.moments import Moments
from ms_highway.irl.outlook import Modes, fit_spread
from ms_highway.irl.peers.following import HIGHWAY_ENV_IDM, IdmParameters, fit_idm, idm
from ms_highway.irl.peers.kinematic import constant_velocity, turn_and_accelerate
from ms_highway.irl.peers.lane_following import KalmanSettings, fit_kalman, lane_modes
from ms_highway.irl.seconds_ahead import drivers_of

__all__ = ["PREDICTORS", "Prediction", "check_drivers", "learn_peers", "predictions"]

PREDICTORS = {
    "model": "learned drivers",
    "constant_velocity": "constant velocity",
    "turn_and_accelerate": "CTRA",
    "idm": "IDM of highway-env",
    "fitted_idm": "IDM, fitted",
    "lane_modes": "Kalman over lanes",
}
"""Names and labels of the predictors, the learned one first; CTRA is constant turn rate and acceleration."""

PARAMETERS = {"fitted_idm": IdmParameters, "lane_modes": KalmanSettings}  # of the peers that have any
REMEDY = "learn it from real recordings with `ms-highway irl fit`, or use us101, which comes with the package"


class Prediction(NamedTuple):
    """Where drivers may be, and how far off.

    Attributes:
        modes: of every predicted driver.
        spread: around them.
    """

    modes: Modes
    spread: Spread


def learn_peers(moments: Moments, chosen: Bool[np.ndarray, "n"] | None = None) -> dict[str, Any]:
    """Fit the parameters and the spread of every peer, by name, as plain numbers, to be kept with learned drivers.

    Args:
        moments: to learn from.
        chosen: which of them; all by default.
    """
    some = moments if chosen is None else moments.of(chosen)
    parameters = {"fitted_idm": asdict(fit_idm(some)), "lane_modes": asdict(fit_kalman(some))}
    modes = _peers(some, parameters)
    return {
        name: {"parameters": parameters.get(name, {}), "spread": asdict(fit_spread(predicted(), some.recorded))}
        for name, predicted in modes.items()
    }


def predictions(moments: Moments, learned: LearnedDrivers, others: Others = "predicted") -> dict[str, Prediction]:
    """Predict the drivers of moments by what was learned and by every peer that was fitted beside it.

    Args:
        moments: to predict.
        learned: the drivers, and parameters and spread of the peers.
        others: what learned drivers meet, see `ms_highway.irl.driving.Others`; peers predict everybody by themselves.

    Raises:
        ValueError: if a peer lacks, see `check_drivers`, or the motion of the others is unknown.
    """
    check_drivers(learned)
    found = {"model": Prediction(predict(moments, drivers_of(learned), others), learned.spread)}
    modes = _peers(moments, {name: peer["parameters"] for name, peer in learned.peers.items()})
    for name in modes:  # in the order of `PREDICTORS`
        spread = learned.peers[name]["spread"]
        found[name] = Prediction(modes[name](), Spread(**{key: np.asarray(value) for key, value in spread.items()}))
    return found


def check_drivers(drivers: LearnedDrivers | None) -> LearnedDrivers:
    """Return the drivers of a learned reward.

    Raises:
        ValueError: if it has none, or a peer or one of its parameters is missing or unknown.
    """
    if drivers is None:
        raise ValueError(f"this reward has no drivers that were learned seconds ahead; {REMEDY}")
    wanted = {name: PARAMETERS.get(name) for name in PREDICTORS if name != "model"}
    for name in wanted:
        if name not in drivers.peers:
            raise ValueError(f"this reward lacks the peer {name}; {REMEDY}")
    for name, peer in drivers.peers.items():
        kind = wanted.get(name)
        names, found = {part.name for part in fields(kind)} if kind else set(), set(peer["parameters"])
        if name not in wanted or names != found:
            wrong = ", ".join(sorted(names ^ found)) or name
            raise ValueError(f"the peer {name} of this reward lacks or does not know {wrong}; {REMEDY}")
    return drivers


def _peers(moments: Moments, parameters: Mapping[str, Mapping[str, Any]]) -> dict[str, Callable[[], Modes]]:
    """Return what predicts moments by each peer, with these parameters of those that have any."""
    return {
        "constant_velocity": lambda: constant_velocity(moments),
        "turn_and_accelerate": lambda: turn_and_accelerate(moments),
        "idm": lambda: idm(moments, HIGHWAY_ENV_IDM),
        "fitted_idm": lambda: idm(moments, IdmParameters(**parameters["fitted_idm"])),
        "lane_modes": lambda: lane_modes(moments, KalmanSettings(**parameters["lane_modes"])),
    }
