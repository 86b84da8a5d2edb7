"""What is learned of drivers beside their reward: how they differ, when they change lanes, how far off they are."""

from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field, fields
from typing import Any, NamedTuple, Self

import jax
import numpy as np
from jax import numpy as jnp
from jaxtyping import Float

from ms_highway.runtime.arrays import Array

__all__ = ["CHANGING", "LEARNED", "Intention", "LearnedDrivers", "RewardTraits", "Spread", "TraitPrior"]

Scalar = float | Float[Array, "*drivers"]

LEARNED = ("speed", "headway", "closing_speed", "lane_alignment", "direction", "comfort_steering")
"""Weights that are learned seconds ahead, relative to that of the comfort of acceleration."""

CHANGING = (*LEARNED, "desired speed", "typical headway")
"""Weights and traits that have a factor while a driver changes lanes."""


class RewardTraits(NamedTuple):
    """What a driver's reward has of its own.

    Attributes:
        desired_speed: at which its speed feature is highest [m/s].
        headway: time gap that its headway feature wants, besides 2 m [s].
        patience: factor of its comfort of acceleration, 1 for the typical driver; who is patient closes gaps slowly.
    """

    desired_speed: Scalar
    headway: Scalar
    patience: Scalar


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class TraitPrior:
    """Distribution of `RewardTraits` over drivers: independent and log-normal.

    Attributes:
        median: of each trait, the desired speed as a share of the speed limit.
        deviations: standard deviations of the traits' logarithms.
        noise: standard deviation of a driver's mean acceleration over a second around its plan's [m/s^2].
    """

    median: Float[Any, "3"]
    deviations: Float[Any, "3"]
    noise: float | Float[Array, ""]

    def __post_init__(self) -> None:
        numbers = [leaf for leaf in jax.tree.leaves(vars(self)) if isinstance(leaf, float | np.ndarray)]  # not traced
        if any((np.asarray(number) <= 0).any() for number in numbers):
            raise ValueError(f"the prior of traits is {vars(self)}; medians, deviations and noise must be positive")

    def traits(self, logarithms: Float[Any, "*drivers 3"], speed_limit: Scalar) -> RewardTraits:
        """Return the traits of drivers from the deviations of their logarithms from the medians'."""
        xp = jnp if isinstance(logarithms, jax.Array) else np
        speed, headway, patience = (
            xp.asarray(self.median)[trait] * xp.exp(logarithms[..., trait]) for trait in range(3)
        )
        return RewardTraits(speed * speed_limit, headway, patience)

    def draw(self, random: np.random.Generator, speed_limit: float) -> RewardTraits:
        """Draw the traits of a driver, within two standard deviations of the medians."""
        normal = np.clip(random.normal(size=3), -2.0, 2.0)
        return RewardTraits(*map(float, self.traits(normal * np.asarray(self.deviations), speed_limit)))


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Intention:
    """Log odds of changing to a lane beside within the next seconds, against keeping the lane: ``bias + sum w_i a_i``.

    Attributes:
        biases: to the left and to the right, with no advantage.
        weights: of the advantages of that lane: the offset towards it from the own lane's centre, in lane widths; the
            lateral speed towards it now, and over the last second [m/s]; the speed of the leader there beyond that of
            the own one, each relative to the driver and weighed by its nearness [m/s]; the distance to the leader there
            beyond that to the own one [10 m]; and the driver's speed [10 m/s].
    """

    biases: Float[Any, "2"]
    weights: Float[Any, "6"]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Spread:
    """How far drivers are off a predicted path: a bivariate Student t distribution, along and across the road.

    At t seconds, ``log scale = a + b log t + c (log t)^2``, plus a further constant where the driver changes lanes.

    Attributes:
        along: a, b and c of the scale along the road [m].
        across: a, b and c of the scale across it [m].
        changing: constants along and across in all modes but the first.
        tails: degrees of freedom after 1 s, and the power of t with which they grow; the normal distribution has
            infinitely many.
    """

    along: Float[Any, "3"]
    across: Float[Any, "3"]
    changing: Float[Any, "2"]
    tails: Float[Any, "2"]

    def scales(self, modes: int, steps: int) -> Float[jax.Array, "modes steps 2"]:
        """Return the scales of each mode after each step of 0.1 s [m]."""
        times = jnp.log(0.1 * jnp.arange(1, steps + 1))
        powers = jnp.stack([jnp.ones_like(times), times, times**2])
        logs = jnp.stack([jnp.asarray(self.along) @ powers, jnp.asarray(self.across) @ powers], axis=-1)
        changes = (jnp.arange(modes) > 0)[:, None, None] * jnp.asarray(self.changing)
        return jnp.exp(logs + changes)

    def freedom(self, steps: int) -> Float[jax.Array, "steps"]:
        """Return the degrees of freedom after each step."""
        first, power = jnp.asarray(self.tails)
        return first * (0.1 * jnp.arange(1, steps + 1)) ** power


@dataclass(frozen=True)
class LearnedDrivers:
    """What `ms-highway irl fit` learns of real drivers seconds ahead.

    Attributes:
        weights: of the reward, by name, under which they come closest to where they were recorded.
        prior: of their traits.
        changing: factors of weights and traits, by name, of a driver who changes lanes.
        intention: to change lanes.
        spread: around the predicted paths.
        deviations: standard deviations of the logarithms of what was learned, by name, with drivers as the independent
            units.
        peers: parameters and spread of each predictor that it is compared with, by name.
    """

    weights: Mapping[str, float]
    prior: TraitPrior
    changing: Mapping[str, float]
    intention: Intention
    spread: Spread
    deviations: Mapping[str, float] = field(default_factory=dict)
    peers: Mapping[str, Any] = field(default_factory=dict)

    @classmethod
    def read(cls, content: Any) -> Self:
        """Return what `written` wrote.

        Raises:
            ValueError: naming what is missing, unknown, of the wrong shape, not finite or not positive.
        """
        parts = _named(content, "drivers", [field.name for field in fields(cls)])
        for peer, found in _named(parts["peers"], "peers").items():
            both = _named(found, f"peers.{peer}", ("parameters", "spread"))
            _numbers(both["parameters"], f"peers.{peer}.parameters")
            _spread(both["spread"], f"peers.{peer}.spread")
        return cls(
            weights=_positive(parts["weights"], "weights", (*LEARNED, "comfort_acceleration")),
            prior=TraitPrior(**_numbers(parts["prior"], "prior", {"median": 3, "deviations": 3, "noise": 0})),
            changing=_positive(parts["changing"], "changing", CHANGING),
            intention=Intention(**_numbers(parts["intention"], "intention", {"biases": 2, "weights": 6})),
            spread=_spread(parts["spread"], "spread"),
            deviations=_numbers(parts["deviations"], "deviations"),
            peers=dict(parts["peers"]),
        )

    def written(self) -> dict[str, Any]:
        """Return plain numbers, lists, tuples and dictionaries."""
        return jax.tree.map(
            lambda value: np.asarray(value, dtype=float).tolist(),
            {
                **{name: asdict(getattr(self, name)) for name in ("prior", "intention", "spread")},
                **{name: dict(getattr(self, name)) for name in ("weights", "changing", "deviations", "peers")},
            },
        )


def _named(content: Any, place: str, names: Iterable[str] | None = None) -> dict[str, Any]:
    """Return a dictionary, which must have these names, if they are given."""
    if not isinstance(content, dict):
        raise ValueError(f"{place} is {content!r}; it must be given by name")
    wanted = set(content if names is None else names)
    for problem, wrong in (("lacks", wanted - set(content)), ("has unknown", set(content) - wanted)):
        if wrong:
            raise ValueError(f"{place} {problem} {', '.join(sorted(wrong))}")
    return dict(content)


def _numbers(content: Any, place: str, sizes: Mapping[str, int] | None = None) -> dict[str, Any]:
    """Return finite numbers by name, or tuples of them of these sizes; 0, the default, is a single number."""
    found = {}
    for name, value in _named(content, place, sizes).items():
        several, size = isinstance(value, list | tuple), sizes[name] if sizes else 0
        numbers = value if several else [value]
        if len(numbers) * several != size or not all(map(_finite, numbers)):
            raise ValueError(
                f"{place}.{name} is {value!r}; it must be {f'{size} finite numbers' if size else 'finite'}"
            )
        found[name] = tuple(map(float, numbers)) if several else float(value)
    return found


def _positive(content: Any, place: str, names: Iterable[str]) -> dict[str, Any]:
    found = _numbers(_named(content, place, names), place)
    if not all(value > 0 for value in found.values()):
        raise ValueError(f"{place} is {found}; all of it must be positive")
    return found


def _spread(content: Any, place: str) -> Spread:
    spread = Spread(**_numbers(content, place, {"along": 3, "across": 3, "changing": 2, "tails": 2}))
    if spread.tails[0] <= 0:
        raise ValueError(f"{place}.tails is {spread.tails}; the degrees of freedom must be positive")
    return spread


def _finite(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and bool(np.isfinite(value))
