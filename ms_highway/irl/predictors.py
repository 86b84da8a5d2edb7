"""All predictors of recorded drivers by name: what was learned, and the peers that it is compared with."""

from collections.abc import Callable
from typing import Any, NamedTuple

from msgspec import structs

from ms_highway.game.learned_drivers import FittedPeer, LearnedDrivers, Spread
from ms_highway.irl import Others
from ms_highway.irl.driving import predict
from ms_highway.irl.lane_following import KalmanSettings, fit_kalman, lane_modes
from ms_highway.irl.moments import Moments
from ms_highway.irl.outlook import Modes, fit_spread
from ms_highway.irl.peers import HIGHWAY_ENV_IDM, IdmParameters, fit_idm, idm, steady_motion, turn_and_accelerate
from ms_highway.runtime.structures import Structure, read


class Nothing(Structure):
    """Parameters of peers that have none."""


class KnownPeer(NamedTuple):
    """A predictor of the literature.

    Attributes:
        label: for tables and figures.
        predict: from moments and parameters.
        parameters: their type.
        fit: parameters to moments.
    """

    label: str
    predict: Callable[[Moments, Any], Modes]
    parameters: type[Structure] = Nothing
    fit: Callable[[Moments], Structure] = lambda moments: Nothing()


PEERS = {
    "constant_velocity": KnownPeer("constant velocity", lambda moments, _: steady_motion(moments)),
    "turn_and_accelerate": KnownPeer("CTRA", lambda moments, _: turn_and_accelerate(moments)),
    "idm": KnownPeer("IDM of highway-env", lambda moments, _: idm(moments, HIGHWAY_ENV_IDM)),
    "fitted_idm": KnownPeer("IDM, fitted", idm, IdmParameters, fit_idm),
    "lane_modes": KnownPeer("Kalman over lanes", lane_modes, KalmanSettings, fit_kalman),
}
"""The peers by name; CTRA is constant turn rate and acceleration."""

PREDICTORS = {"model": "learned drivers", **{name: peer.label for name, peer in PEERS.items()}}
"""Names and labels of all predictors, the learned one first."""

REMEDY = "learn it from real recordings with `ms-highway irl fit`, or use us101, which comes with the package"


class Prediction(NamedTuple):
    """Where drivers may be, and how far off.

    Attributes:
        modes: of every predicted driver.
        spread: around them.
    """

    modes: Modes
    spread: Spread


def learn_peers(moments: Moments) -> dict[str, FittedPeer]:
    """Fit the parameters and the spread of every peer, by name, to be kept with learned drivers."""
    fitted = {}
    for name, peer in PEERS.items():
        parameters = peer.fit(moments)
        spread = fit_spread(peer.predict(moments, parameters), moments.recorded)
        fitted[name] = FittedPeer(structs.asdict(parameters), spread)
    return fitted


def prediction(name: str, moments: Moments, learned: LearnedDrivers, others: Others = "predicted") -> Prediction:
    """Predict the drivers of moments by one of `PREDICTORS`, see `predictions`.

    Raises:
        ValueError: for an unknown name, or motion of the others.
    """
    if name not in PREDICTORS:
        raise ValueError(f"predictor is {name!r}; choose one of {', '.join(PREDICTORS)}")
    if name == "model":
        return Prediction(predict(moments, learned, others), learned.spread)
    peer, fitted = PEERS[name], learned.peers[name]
    return Prediction(peer.predict(moments, peer.parameters(**fitted.parameters)), fitted.spread)


def predictions(moments: Moments, learned: LearnedDrivers, others: Others = "predicted") -> dict[str, Prediction]:
    """Predict the drivers of moments by what was learned and by every peer that was fitted beside it.

    Args:
        moments: to predict.
        learned: the drivers, and parameters and spread of the peers.
        others: what learned drivers meet, see `ms_highway.irl.Others`; peers predict everybody by themselves.

    Raises:
        ValueError: if a peer lacks, see `check_drivers`, or the motion of the others is unknown.
    """
    check_drivers(learned)
    return {name: prediction(name, moments, learned, others) for name in PREDICTORS}


def check_drivers(drivers: LearnedDrivers | None, reward: str = "this reward") -> LearnedDrivers:
    """Return the drivers of a learned reward.

    Raises:
        ValueError: if it has none, or a peer or one of its parameters is missing or unknown.
    """
    if drivers is None:
        raise ValueError(f"{reward} has no drivers that were learned seconds ahead; {REMEDY}")
    if wrong := set(PEERS) ^ set(drivers.peers):
        raise ValueError(f"{reward} lacks or does not know the peers {', '.join(sorted(wrong))}; {REMEDY}")
    try:
        for name, peer in PEERS.items():
            read(drivers.peers[name].parameters, peer.parameters)
    except ValueError as error:
        raise ValueError(f"the peer {name} of {reward} is damaged: {error}; {REMEDY}") from error
    return drivers
