"""Driving regimes of recorded drivers, and examples, to see where predictions fail."""

import numpy as np
from jaxtyping import Bool, Float

from ms_highway.game.neighbours import places
from ms_highway.irl.prediction import STEPS, Cases, constant_velocity

__all__ = ["HORIZON", "driving_regimes", "errors_by_regime", "examples"]

HORIZON = 3  # s, at which regimes are told apart and errors compared
LANE_CHANGE = 1.5  # m to the side
HARD = 1.0  # m/s^2, on average
SLOW = 5.0  # m/s
LEADER = 50.0  # m ahead, from centre to centre


def driving_regimes(cases: Cases) -> dict[str, Bool[np.ndarray, "n"]]:
    """Return which cases belong to each regime, by name; a case may belong to several, or to none.

    A *lane change* is 1.5 m to the side within 3 s; *braking* and *accelerating* are more than 1 m/s^2 on average over
    that time; *slow* is below 5 m/s at the start; *no leader* is none within 50 m in the own lane at the start;
    *following* is a leader and none of the other regimes.
    """
    recorded = np.asarray(cases.recorded)
    start, later = recorded[:, 0], recorded[:, 10 * HORIZON]
    change = (later[:, 3] - start[:, 3]) / HORIZON
    others, present, width = map(np.asarray, (cases.others[:, 0], cases.present[:, 0], cases.scenes.lane_width))
    cars, taken = places(start, others, present, width)
    leader = np.take_along_axis(others, cars[:, :1, None], axis=1)[:, 0]
    led = taken[:, 0] & (leader[:, 0] - start[:, 0] < LEADER)
    found = {
        "lane change": np.abs(later[:, 1] - start[:, 1]) > LANE_CHANGE,
        "braking": change < -HARD,
        "accelerating": change > HARD,
        "slow": start[:, 3] < SLOW,
        "no leader": ~led,
    }
    return {**found, "following": ~np.any(list(found.values()), axis=0)}


def errors_by_regime(paths: dict[str, Float[np.ndarray, "n 50 2"]], cases: Cases) -> dict[str, dict[str, float]]:
    """Return the mean distance [m] between predicted and recorded driver after 3 s, by regime and predictor.

    Args:
        paths: predicted paths, by name of the predictor.
        cases: the predicted cases; those that end before 3 s are left out.
    """
    recorded = np.asarray(cases.recorded)[:, 10 * HORIZON, :2]
    reached, found = np.isfinite(recorded).all(axis=-1), {}
    for name, chosen in driving_regimes(cases).items():
        some = chosen & reached
        if some.any():
            off = {who: path[some, 10 * HORIZON - 1] - recorded[some] for who, path in paths.items()}
            errors = {who: float(np.linalg.norm(difference, axis=-1).mean()) for who, difference in off.items()}
            found[name] = {"windows": int(some.sum()), **errors}
    return found


def examples(cases: Cases) -> dict[str, int]:
    """Choose example cases, by what is special about them; each was recorded for the whole 5 s.

    The typical case has the median error of constant velocity. None is chosen by the model's error.

    Raises:
        ValueError: if no driver was recorded for 5 s.
    """
    recorded = np.asarray(cases.recorded)
    whole = np.flatnonzero(np.isfinite(recorded).all(axis=(1, 2)))
    if not len(whole):
        raise ValueError(f"no driver was recorded for {STEPS / 10:g} s on end; there is no example to be drawn")
    tracks = recorded[whole]
    end = np.linalg.norm(constant_velocity(cases)[whole, -1] - tracks[:, -1, :2], axis=-1)
    faster = tracks[:, -1, 3] - tracks[:, 0, 3]
    kinds = {
        "a typical case": np.abs(end - np.median(end)),
        "the strongest braking": faster,
        "the strongest acceleration": -faster,
        "the largest lateral motion": -np.abs(tracks[:, -1, 1] - tracks[:, 0, 1]),
    }
    chosen: dict[str, int] = {}
    for kind, order in kinds.items():
        rest = [int(whole[place]) for place in np.argsort(order) if int(whole[place]) not in chosen.values()]
        if rest:
            chosen[kind] = rest[0]
    return chosen
