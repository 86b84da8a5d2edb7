"""A learned reward and its file: weights, their covariance, and provenance."""

from collections.abc import Iterable
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Annotated, ClassVar

import msgspec
import numpy as np
from jaxtyping import Float

from ms_highway.data.learned_drivers import Finite, LearnedDrivers, Positive
from ms_highway.game.reward import RewardModel, linear_reward
from ms_highway.game.scenario import COMMON_WEIGHTS
from ms_highway.runtime.arrays import Published, Structure, read
from ms_highway.runtime.files import read_json, reading, write_json

Count = Annotated[int, msgspec.Meta(ge=0, le=10**9)]

SHIPPED = {
    "demonstrations": "learned from simulated demonstrations",
    "us101": "learned from drivers on US-101",
}
"""Name and description of the learned rewards in the package."""


class LearnedReward(Structure):
    """Result of `ms-highway irl fit`.

    Attributes:
        weights: of features and comfort, by name; the given comfort weights set their
            scale.
        temperature: T of maximum entropy, at the same scale.
        learned: names of the weights that were learned; the others were given.
        covariance: of the logarithms of the learned weights' sizes, of the temperature
            and, if any, of the tails. The independent units are drivers if they are
            real, and segments if they are simulated.
        horizon: K, number of steps of 0.1 s in the segments.
        converged: whether the optimiser reached the maximum.
        iterations: of the optimiser.
        windows: number of segments that were fitted.
        log_likelihood: mean per segment: ``train``, and ``held_out``, cross-validated
            by group of recordings (None if there is only one group).
        feature_counts: mean sums of the features over a segment: ``human``, recorded,
            and ``model``, expected under the reward.
        provenance: data, groups of recordings, and versions of the software.
        tails: nu of `ms_highway.irl.maximum_entropy`, None for a normal distribution.
        drivers: what was learned seconds ahead; None from simulated demonstrations.
        learned_from: the recordings that were learned from, as fingerprints of their
            content by group; empty in files of earlier versions.
    """

    version: ClassVar[int] = 3
    """Version of the file format; files of others are refused."""
    remedy: ClassVar[str] = "learn it again with `ms-highway irl fit`"
    """What to do about a file that cannot be read."""

    weights: dict[str, float]
    temperature: Positive
    learned: tuple[str, ...]
    covariance: list[list[Finite]]
    horizon: Annotated[int, msgspec.Meta(ge=1, le=10**9)]
    converged: bool
    iterations: Count
    windows: Count
    log_likelihood: dict[str, Finite | None]
    feature_counts: dict[str, dict[str, Finite]]
    provenance: dict[str, object]
    tails: Positive | None = None
    drivers: LearnedDrivers | None = None
    learned_from: dict[str, list[str]] = msgspec.field(default_factory=dict)

    def __post_init__(self) -> None:
        """Check the reward.

        Raises:
            ValueError: naming the problem.
        """
        linear_reward(self.weights, 1.0)
        if unknown := sorted(set(self.learned) - set(self.weights)):
            raise ValueError(
                f"learned has {', '.join(unknown)}, which is not among the weights"
            )
        RewardModel(self.learned, self._given())
        self._check_covariance()
        self._check_means()

    def _given(self) -> dict[str, float]:
        """Return the weights that were not learned."""
        return {
            name: value
            for name, value in self.weights.items()
            if name not in self.learned
        }

    def _check_covariance(self) -> None:
        """Refuse a covariance of another size, or without variances."""
        covariance = np.array(self.covariance, dtype=float)
        size = len(self.learned) + 1 + (self.tails is not None)
        fits = covariance.shape == (size, size) and np.isfinite(covariance).all()
        if not fits or (np.diag(covariance) < 0).any():
            raise ValueError(
                f"the covariance is no finite array of shape {(size, size)} with"
                " variances"
            )

    def _check_means(self) -> None:
        """Refuse counts of features and likelihoods under other names."""
        if set(self.feature_counts) != {"human", "model"}:
            raise ValueError(
                f"feature_counts are of {', '.join(self.feature_counts) or 'nobody'},"
                " not human and model"
            )
        for who, counts in self.feature_counts.items():
            if set(counts) != set(self.weights):
                raise ValueError(
                    f"feature_counts.{who} lacks or has unknown"
                    f" {_differing(counts, self.weights)}"
                )
        if set(self.log_likelihood) != {"train", "held_out"}:
            raise ValueError("log_likelihood has other keys than train and held_out")

    @property
    def model(self) -> RewardModel:
        """The learned and the given weights."""
        return RewardModel(self.learned, self._given(), self.tails is not None)

    def interval(self, name: str) -> Float[np.ndarray, "2"]:
        """Return the 90 % interval of a learned weight."""
        index = self.learned.index(name)
        return log_normal_interval(
            self.weights[name], np.sqrt(self.covariance[index][index])
        )


def _differing(names: Iterable[str], others: Iterable[str]) -> str:
    """Return the names that are only in one of two collections."""
    return ", ".join(sorted(set(names) ^ set(others)))


def log_normal_interval(value: float, deviation: float) -> Float[np.ndarray, "2"]:
    """Return the 90 % interval of a number.

    Args:
        value: median.
        deviation: standard deviation of the number's logarithm.
    """
    return value * np.exp([-1.645 * deviation, 1.645 * deviation])


def save(learned: LearnedReward, path: Path) -> None:
    """Write a learned reward as JSON, atomically."""
    write_json(path, {"version": LearnedReward.version} | msgspec.to_builtins(learned))


def load(path: Path) -> LearnedReward:
    """Read a learned reward that `save` wrote.

    Raises:
        ValueError: if the file cannot be read, is damaged, or is of another version.
    """
    with reading(path, LearnedReward.remedy, " as a learned reward"):
        content = read_json(path)
        version = content.pop("version", None) if isinstance(content, dict) else None
        if version != LearnedReward.version:
            raise ValueError(f"it is of version {version}, not {LearnedReward.version}")
        return read(content, LearnedReward)


@cache
def shipped(name: str) -> LearnedReward:
    """Return a learned reward of the package, see `SHIPPED`.

    Raises:
        ValueError: for an unknown name.
    """
    if name not in SHIPPED:
        raise ValueError(
            f"no learned reward {name!r} comes with ms_highway; there are"
            f" {', '.join(SHIPPED)}"
        )
    learned = load(Path(str(resources.files("ms_highway") / "data" / f"{name}.json")))
    return msgspec.structs.replace(learned, weights=Published(learned.weights))


def named(name: str) -> LearnedReward:
    """Return the package's learned reward of this name, or else that of the file."""
    return shipped(name) if name in SHIPPED else load(Path(name))


@cache
def shipped_drivers() -> LearnedDrivers:
    """Return the drivers learned on US-101."""
    drivers = shipped("us101").drivers
    assert drivers is not None  # the package's own file
    return drivers


def commuter_weights() -> dict[str, float]:
    """Return the weights of a driver in everyday traffic, by name.

    They are learned on US-101, in units of log-probability.

    Weights for driving in a lane are learned seconds ahead, see
    `ms_highway.irl.seconds_ahead`. Weights of leaving the lane or the road and of
    collisions are the paper's: the recordings say little about them.
    """
    learned = shipped("us101")
    papers = {
        name: float(COMMON_WEIGHTS[name])
        for name in ("lane_alignment", "collision_risk", "off_road")
    }
    weights = {**learned.weights, **shipped_drivers().weights, **papers}
    return {name: weight / learned.temperature for name, weight in weights.items()}
