"""Driving regimes of recorded drivers, and examples, to see where predictions fail."""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Bool, Float

from ms_highway.game.neighbours import places
from ms_highway.irl.errors import HORIZONS
from ms_highway.irl.moments import STEPS, Moments

__all__ = ["by_regime", "driving_regimes", "examples"]

HORIZON = 3  # s, at which regimes are told apart
LANE_CHANGE = 1.5  # m to the side
HARD = 1.0  # m/s^2, on average
SLOW = 5.0  # m/s
LEADER = 50.0  # m ahead, from centre to centre


def driving_regimes(moments: Moments) -> dict[str, Bool[np.ndarray, "drivers"]]:
    """Return which predicted drivers are in each regime, by name; a driver may be in several, or in none.

    A *lane change* is 1.5 m to the side within 3 s; *braking* and *accelerating* are more than 1 m/s^2 on average over
    that time; *slow* is below 5 m/s at the start; *no leader* is none within 50 m in the own lane at the start;
    *following* is a leader and none of the other regimes.
    """
    which = np.argwhere(np.asarray(moments.predicted))
    now = np.asarray(moments.now)
    start = now[which[:, 0], which[:, 1]]
    later = np.moveaxis(np.asarray(moments.future), 1, 2)[moments.predicted][:, 10 * HORIZON - 1]
    others = now[which[:, 0]]
    present = np.isfinite(others).all(axis=-1)
    present[np.arange(len(which)), which[:, 1]] = False
    cars, taken = places(start, others, present, np.asarray(moments.lane_width)[which[:, 0]])
    leader = np.take_along_axis(others, cars[:, :1, None], axis=1)[:, 0]
    change, led = (later[:, 3] - start[:, 3]) / HORIZON, taken[:, 0] & (leader[:, 0] - start[:, 0] < LEADER)
    found = {
        "lane change": np.abs(later[:, 1] - start[:, 1]) > LANE_CHANGE,
        "braking": change < -HARD,
        "accelerating": change > HARD,
        "slow": start[:, 3] < SLOW,
        "no leader": ~led,
    }
    return {**found, "following": ~np.any(list(found.values()), axis=0)}


def by_regime(
    values: Mapping[str, Float[np.ndarray, "drivers 50"]], moments: Moments
) -> dict[str, dict[str, dict[str, float]]]:
    """Return the mean of what was measured of each predictor by regime and horizon in seconds.

    Args:
        values: by predictor, NaN where a driver was not seen.
        moments: of the drivers; those seen for less than 3 s are left out.

    Returns:
        For each regime, ``windows``: the number of drivers by horizon; and the means of each predictor.
    """
    found: dict[str, dict[str, dict[str, float]]] = {}
    reached = np.isfinite(np.moveaxis(np.asarray(moments.future), 1, 2)[moments.predicted][..., 0])
    for name, chosen in driving_regimes(moments).items():
        some = chosen & reached[:, 10 * HORIZON - 1]
        counts = {str(at): int((some & reached[:, 10 * at - 1]).sum()) for at in HORIZONS}
        if some.any():
            means = {
                who: {str(at): float(np.nanmean(value[some, 10 * at - 1])) for at in HORIZONS if counts[str(at)]}
                for who, value in values.items()
            }
            found[name] = {"windows": {at: float(count) for at, count in counts.items()}, **means}
    return found


def examples(moments: Moments, off: Float[np.ndarray, "drivers 50"]) -> dict[str, int]:
    """Choose example drivers, by what is special about them; each was recorded for the whole 5 s.

    The typical one has the median error of constant velocity. None is chosen by the model's error.

    Args:
        moments: of the drivers.
        off: distance between each driver and its prediction at constant velocity [m].

    Returns:
        The number of each among the predicted drivers.

    Raises:
        ValueError: if no driver was recorded for 5 s.
    """
    recorded = np.moveaxis(np.asarray(moments.future), 1, 2)[moments.predicted]
    start = np.asarray(moments.now)[moments.predicted]
    whole = np.flatnonzero(np.isfinite(recorded).all(axis=(1, 2)))
    if not len(whole):
        raise ValueError(f"no driver was recorded for {STEPS / 10:g} s on end; there is no example to be drawn")
    faster = recorded[whole, -1, 3] - start[whole, 3]
    kinds = {
        "a typical case": np.abs(off[whole, -1] - np.median(off[whole, -1])),
        "the strongest braking": faster,
        "the strongest acceleration": -faster,
        "the largest lateral motion": -np.abs(recorded[whole, -1, 1] - start[whole, 1]),
    }
    chosen: dict[str, int] = {}
    for kind, order in kinds.items():
        rest = [int(whole[place]) for place in np.argsort(order) if int(whole[place]) not in chosen.values()]
        if rest:
            chosen[kind] = rest[0]
    return chosen
