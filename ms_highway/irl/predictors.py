"""All predictors of recorded drivers by name: what was learned, and the peers that it is compared with."""

from typing import NamedTuple

from msgspec import structs

from ms_highway.game.learned_drivers import FittedPeer, LearnedDrivers, Spread
from ms_highway.irl import Others
from ms_highway.irl.driving import predict
from ms_highway.irl.moments import Moments
from ms_highway.irl.outlook import Modes, fit_spread
from ms_highway.irl.peers import HIGHWAY_ENV_IDM, IdmParameters, fit_idm, idm, steady_motion
from ms_highway.runtime import retired
from ms_highway.runtime.structures import read

PEERS = {
    "constant_velocity": "constant velocity",
    "idm": "IDM of highway-env",
    "fitted_idm": "IDM, fitted",
}
"""Names and labels of the predictors of the literature."""

PREDICTORS = {"model": "learned drivers", **PEERS}
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


def _peer_modes(name: str, moments: Moments, parameters: dict[str, float]) -> Modes:
    if name == "constant_velocity":
        return steady_motion(moments)
    return idm(moments, IdmParameters(**parameters) if parameters else HIGHWAY_ENV_IDM)


def learn_peers(moments: Moments) -> dict[str, FittedPeer]:
    """Fit the parameters and the spread of every peer, by name, to be kept with learned drivers."""
    peers = {}
    for name in PEERS:
        parameters = structs.asdict(fit_idm(moments)) if name == "fitted_idm" else {}
        peers[name] = FittedPeer(parameters, fit_spread(_peer_modes(name, moments, parameters), moments.recorded))
    return peers


def prediction(name: str, moments: Moments, learned: LearnedDrivers, others: Others = "predicted") -> Prediction:
    """Predict the drivers of moments by one of `PREDICTORS`.

    Args:
        name: of the predictor.
        moments: to predict.
        learned: the drivers, and parameters and spread of the peers, see `check_drivers`.
        others: motion of the others around learned drivers, see `ms_highway.irl.Others`; peers predict all cars alone.

    Raises:
        ValueError: for an unknown name, or motion of the others.
    """
    if name not in PREDICTORS:
        gone = retired.replacement(retired.PREDICTORS, name)
        raise ValueError(gone or f"predictor is {name!r}; choose one of {', '.join(PREDICTORS)}")
    if name == "model":
        return Prediction(predict(moments, learned, others), learned.spread)
    peer = learned.peers[name]
    return Prediction(_peer_modes(name, moments, peer.parameters), peer.spread)


def check_drivers(drivers: LearnedDrivers | None, reward: str = "this reward") -> LearnedDrivers:
    """Return the drivers of a learned reward.

    Raises:
        ValueError: if it has none, or a peer or one of its parameters is missing.
    """
    if drivers is None:
        raise ValueError(f"{reward} has no drivers that were learned seconds ahead; {REMEDY}")
    if lacking := set(PEERS) - set(drivers.peers):
        raise ValueError(f"{reward} lacks the peers {', '.join(sorted(lacking))}; {REMEDY}")
    try:
        read(drivers.peers["fitted_idm"].parameters, IdmParameters)
    except ValueError as error:
        raise ValueError(f"the peer fitted_idm of {reward} is damaged: {error}; {REMEDY}") from error
    return drivers
