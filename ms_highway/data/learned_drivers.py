"""Hold what is learned of drivers besides rewards: traits, lane changes and errors."""

from typing import Annotated, ClassVar, NamedTuple

import msgspec
import numpy as np
from jax import numpy as jnp
from jaxtyping import Float

from ms_highway.runtime.arrays import (
    Array,
    Numeric,
    Structure,
    pytree,
)

PerDriver = float | Float[Array, "*drivers"]

# Learned numbers are computed with as float32.
_LARGEST = 1e30
Finite = Annotated[float, msgspec.Meta(ge=-_LARGEST, le=_LARGEST)]
Positive = Annotated[float, msgspec.Meta(gt=0, le=_LARGEST)]
NotNegative = Annotated[float, msgspec.Meta(ge=0, le=_LARGEST)]


class RewardTraits(NamedTuple):
    """Traits of one driver's reward.

    Attributes:
        desired_speed: at which its speed feature is highest [m/s].
        headway: time gap that its headway feature wants, besides 2 m [s].
        patience: factor of its weight of comfortable acceleration, 1 for the typical
            driver; a patient driver closes gaps slowly.
    """

    desired_speed: PerDriver
    headway: PerDriver
    patience: PerDriver


@pytree
class TraitPrior(Structure):
    """Distribution of `RewardTraits` over drivers: independent and log-normal.

    Attributes:
        median: of each trait, the desired speed as a share of the speed limit.
        deviations: standard deviations of the traits' logarithms.
        noise: standard deviation of a driver's mean acceleration over a second around
            its plan's [m/s^2].
    """

    median: tuple[Positive, Positive, Positive]
    deviations: tuple[Positive, Positive, Positive]
    noise: Positive

    def traits(
        self,
        logarithms: Float[Array, "*drivers 3"],
        speed_limit: Numeric,
    ) -> RewardTraits:
        """Return the traits of drivers.

        Args:
            logarithms: of the traits relative to the medians.
            speed_limit: of the road [m/s].
        """
        xp = logarithms.__array_namespace__()
        shares = xp.asarray(self.median) * xp.exp(logarithms)
        desired_speed = shares[..., 0] * speed_limit
        return RewardTraits(desired_speed, shares[..., 1], shares[..., 2])

    def draw(self, random: np.random.Generator, speed_limit: float) -> RewardTraits:
        """Draw the traits of a driver, within two deviations of the medians."""
        normal = np.clip(random.normal(size=3), -2.0, 2.0)
        drawn = self.traits(normal * np.asarray(self.deviations), speed_limit)
        return RewardTraits(*map(float, drawn))


@pytree
class Intention(Structure):
    """Log odds of changing to an adjacent lane within the next seconds.

    Over keeping the lane, they are ``bias + sum w_i a_i``.

    Attributes:
        biases: to the left and to the right, with no advantage.
        weights: of the advantages a_i of the adjacent lane. These are the offset
            towards it from the centre of the present lane, in lane widths; the lateral
            speed towards it now, and over the last second [m/s]; the speed of its
            leader less that of the present leader, each relative to the driver and
            weighed by nearness [m/s]; the distance to its leader less that to the
            present leader [10 m]; and the driver's speed [10 m/s].
    """

    biases: tuple[Finite, Finite]
    weights: tuple[Finite, Finite, Finite, Finite, Finite, Finite]


@pytree
class Spread(Structure):
    """Distribution of drivers around a predicted path.

    It is a bivariate Student t, along and across the road. After t seconds, ``log scale
    = a + b log t + c (log t)^2``, plus a constant where the driver changes lanes.

    Attributes:
        along: a, b and c of the scale along the road [m].
        across: a, b and c of the scale across it [m].
        changing: constants along and across in all modes but the first.
        tails: degrees of freedom after 1 s, and the power of t with which they grow.
    """

    along: tuple[Finite, Finite, Finite]
    across: tuple[Finite, Finite, Finite]
    changing: tuple[Finite, Finite]
    tails: tuple[Positive, Finite]

    def scales(self, modes: int, steps: int) -> Float[Array, "modes steps 2"]:
        """Return the scales of each mode after each step of 0.1 s [m]."""
        # a + b log t + c (log t)^2, along and across [steps, 2].
        times = jnp.log(0.1 * jnp.arange(1, steps + 1))
        powers = jnp.stack([jnp.ones_like(times), times, times**2])
        along = jnp.asarray(self.along) @ powers
        across = jnp.asarray(self.across) @ powers
        logs = jnp.stack([along, across], axis=-1)

        # The driver keeps its lane in the first mode.
        changes = (jnp.arange(modes) > 0)[:, None, None] * jnp.asarray(self.changing)
        return jnp.exp(logs + changes)

    def freedom(self, steps: int) -> Float[Array, "steps"]:
        """Return the degrees of freedom after each step."""
        first, power = jnp.asarray(self.tails)
        return first * (0.1 * jnp.arange(1, steps + 1)) ** power


@pytree
class Drivers(Structure):
    """How real drivers drive, learned seconds ahead.

    Attributes:
        weights: of the reward, by name, under which predicted drivers come closest to
            recorded ones.
        prior: of their traits.
        changing: factors of weights and traits, by name, while a driver changes lanes.
        intention: to change lanes.
    """

    learned_weights: ClassVar[tuple[str, ...]] = (
        "speed",
        "headway",
        "closing_speed",
        "lane_alignment",
        "direction",
        "comfort_steering",
    )
    """Weights that are learned, relative to that of the comfort of acceleration."""
    in_lane_changes: ClassVar[tuple[str, ...]] = (
        *learned_weights,
        "desired speed",
        "typical headway",
    )
    """Weights and traits that have a factor while a driver changes lanes."""

    weights: dict[str, Positive]
    prior: TraitPrior
    changing: dict[str, Positive]
    intention: Intention

    def __post_init__(self) -> None:
        self._check("weights", (*self.learned_weights, "comfort_acceleration"))
        self._check("changing", self.in_lane_changes)

    def _check(self, part: str, names: tuple[str, ...]) -> None:
        """Check that numbers by name have these names.

        Raises:
            ValueError: naming those that lack or are unknown.
        """
        if wrong := set(getattr(self, part)) ^ set(names):
            raise ValueError(
                f"{part} of drivers lack or have unknown {', '.join(sorted(wrong))}"
            )


@pytree
class FittedPeer(Structure):
    """A predictor of the literature, fitted to the same drivers.

    Attributes:
        parameters: by name.
        spread: around its predictions.
    """

    parameters: dict[str, Finite]
    spread: Spread


@pytree
class LearnedDrivers(Drivers):
    """What `ms-highway irl fit` learns of real drivers.

    Attributes:
        spread: around the predicted paths.
        deviations: standard deviations of the logarithms of the learned numbers, by
            name; drivers are the independent units.
        peers: predictors of the literature to compare with, by name.
    """

    spread: Spread
    deviations: dict[str, NotNegative]
    peers: dict[str, FittedPeer]
