"""The model of a linear reward: the weights to learn, their signs, and the weights given."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from ms_highway.game.reward import COMFORT, weight_names

PENALTIES = ("collision_risk", "collision", "off_road")
"""Features with negative weights; all others are positive."""

NO_GRADIENT = ("collision", "merged", "partner_merged")
"""Indicators: without a gradient, driving carries no information about their weights."""

FLOOR = 0.5  # of the least given comfort weight: the least curvature of -R in a fit


@dataclass(frozen=True)
class RewardModel:
    """A reward that is linear in its features: the weights to learn, and those given.

    Attributes:
        learned: names of the weights to learn, of `weight_names`.
        given: fixed weights, by name; those of comfort set the scale of all others.
        tails: whether drivers are now and then far from what is best, see `ms_highway.irl.maximum_entropy`.

    Raises:
        ValueError: for unknown names, indicators, a weight named twice, or no given comfort weight.
    """

    learned: tuple[str, ...]
    given: Mapping[str, float]
    tails: bool = False

    def __post_init__(self) -> None:
        known = [name for name in weight_names() if name not in NO_GRADIENT]
        for name in self.names:
            if name not in known:
                raise ValueError(f"{name!r} cannot be learned; the weights to learn are {', '.join(known)}")
        twice = sorted(set(self.learned) & set(self.given))
        if twice or len(set(self.learned)) < len(self.learned):
            raise ValueError(f"weights {twice or list(self.learned)} are named twice")
        if not any(self.given.get(name, 0.0) > 0 for name in COMFORT):
            raise ValueError(f"one of {', '.join(COMFORT)} must be given: it sets the scale of all weights")

    @property
    def names(self) -> tuple[str, ...]:
        """All names: the learned ones, then the given ones."""
        return (*self.learned, *self.given)

    @property
    def floor(self) -> float:
        """The least curvature of -R in any direction that a fit assumes."""
        return FLOOR * min(value for name, value in self.given.items() if name in COMFORT and value > 0)

    def signs(self) -> Float[np.ndarray, "learned"]:
        """Return the signs of the learned weights, which are fixed."""
        return np.array([-1.0 if name in PENALTIES else 1.0 for name in self.learned])

    def weights(self, logarithms: Float[np.ndarray, "parameters"]) -> dict[str, float]:
        """Return all weights by name, from the logarithms that a fit finds; those of the learned ones come first."""
        learned = (self.signs() * np.exp(logarithms[: len(self.learned)])).tolist()
        return {**dict(zip(self.learned, learned, strict=True)), **self.given}
