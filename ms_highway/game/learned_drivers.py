"""What is learned of drivers beside their reward: how they differ, when they change lanes, how far off they are."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any, NamedTuple, Self

import jax
import numpy as np
from jax import numpy as jnp
from jaxtyping import Float

from ms_highway.runtime.arrays import Array

__all__ = ["Intention", "LearnedDrivers", "Spread", "TraitPrior", "Traits"]

Number = float | Float[Array, "*drivers"]


class Traits(NamedTuple):
    """What a driver's reward has of its own.

    Attributes:
        desired_speed: at which its speed feature is highest [m/s].
        headway: time gap that its headway feature wants, besides 2 m [s].
        patience: factor of its comfort of acceleration, 1 for the typical driver; who is patient closes gaps slowly.
    """

    desired_speed: Number
    headway: Number
    patience: Number


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class TraitPrior:
    """Distribution of `Traits` over drivers: independent and log-normal.

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

    def traits(self, logarithms: Float[Any, "*drivers 3"], speed_limit: Number) -> Traits:
        """Return the traits of drivers from the deviations of their logarithms from the medians'."""
        xp = jnp if isinstance(logarithms, jax.Array) else np
        speed, headway, patience = (
            xp.asarray(self.median)[trait] * xp.exp(logarithms[..., trait]) for trait in range(3)
        )
        return Traits(speed * speed_limit, headway, patience)

    def draw(self, random: np.random.Generator, speed_limit: float) -> Traits:
        """Draw the traits of a driver, within two standard deviations of the medians."""
        normal = np.clip(random.normal(size=3), -2.0, 2.0)
        return Traits(*map(float, self.traits(normal * np.asarray(self.deviations), speed_limit)))


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Intention:
    """Log odds of changing to a lane beside within the next seconds, against keeping the lane: ``bias + sum w_i a_i``.

    Attributes:
        biases: to the left and to the right, with no advantage.
        weights: of the advantages of that lane: the offset from the own lane's centre, in lane widths; the lateral
            speed now, and over the last second [m/s]; the mean closing speed that is avoided, weighed by the nearness
            of the leaders [m/s]; the distance to the leader there beyond that to the own one [10 m]; and the driver's
            speed [10 m/s].
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
    def read(cls, content: Mapping[str, Any]) -> Self:
        """Return what `written` wrote.

        Raises:
            KeyError, TypeError, ValueError: if a part is missing, of the wrong shape or not finite.
        """
        parts: dict[str, Any] = {}
        for name, (kind, sizes) in PARTS.items():
            values = {key: _array(value) for key, value in content[name].items()}
            if tuple(map(np.size, values.values())) != sizes or not all(map(_finite, values.values())):
                raise ValueError(f"{name} of the drivers is {content[name]}; it must hold {sizes} finite numbers")
            parts[name] = kind(**values)
        rest = {name: dict(content[name]) for name in ("weights", "changing", "deviations", "peers")}
        for name in ("weights", "changing"):
            if not all(isinstance(value, float) and 0 < value < np.inf for value in rest[name].values()):
                raise ValueError(f"{name} of the drivers is {rest[name]}; it must have positive numbers by name")
        return cls(**{**parts, **rest})

    def written(self) -> dict[str, Any]:
        """Return plain numbers, lists and dictionaries."""
        return jax.tree.map(
            lambda value: np.asarray(value, dtype=float).tolist(),
            {
                **{name: asdict(getattr(self, name)) for name in ("prior", "intention", "spread")},
                **{name: dict(getattr(self, name)) for name in ("weights", "changing", "deviations", "peers")},
            },
        )


PARTS = {"prior": (TraitPrior, (3, 3, 1)), "intention": (Intention, (2, 6)), "spread": (Spread, (3, 3, 2, 2))}


def _array(value: Any) -> Any:
    return tuple(map(float, value)) if isinstance(value, list) else float(value)


def _finite(value: Any) -> bool:
    return bool(np.isfinite(value).all())
