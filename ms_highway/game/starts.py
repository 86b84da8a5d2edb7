"""Draw the starts of episodes by NumPy, or by JAX in functions that JAX traces."""

from dataclasses import dataclass
from typing import NoReturn, TypeAlias

import jax
import numpy as np
from jax import numpy as jnp
from jaxtyping import Float
from numpy.typing import ArrayLike

from ms_highway.game.reward import Reward
from ms_highway.game.scenario import PAPER_UNIT, SPEED_LIMIT, Scenario, Stream
from ms_highway.runtime.arrays import (
    Array,
    HumansWeights,
    Numeric,
    State,
)


@dataclass(frozen=True)
class StartNoise:
    """Standard deviations of the noise on starts, those of the paper's experiments."""

    position: float = 5e-4 * PAPER_UNIT
    """Of x and of y [m]: 1.7 cm."""
    heading: float = 1e-3
    """Of the heading [rad]."""
    speed: float = 1e-3 * PAPER_UNIT
    """Of the speed, without streams [m/s]: 3.3 cm/s."""
    merging: float = 0.01 * PAPER_UNIT
    """Of further noise on the x of the merging car [m]: 33 cm."""


START_NOISE = StartNoise()


@dataclass(frozen=True)
class StreamVariety:
    """Set how the humans of streams differ from each other."""

    spacing_beta: float = 20.0
    """b of Beta(1, b), by which spacings exceed the shortest: by 0.3 m on average."""
    speed_noise: float = 0.3
    """Standard deviation of the speed [m/s]."""
    caution_spread: float = 0.7
    """Standard deviation of the logarithm of a human's factor of ``collision_risk``."""
    careless_factor: float = 0.05
    """This factor of humans that hardly yield."""


STREAM_VARIETY = StreamVariety()


def _shape(size: ArrayLike) -> list[int]:
    return np.atleast_1d(np.asarray(size)).astype(int).tolist()


class TracedRandom:
    """Draw by JAX, with the methods of NumPy's generator that are used here."""

    def __init__(self, key: jax.Array) -> None:
        self._key = key

    def __getattr__(self, name: str) -> NoReturn:
        remedy = (
            "draw by normal, uniform or beta, or use the vector environment, which"
            " draws by NumPy"
        )
        raise AttributeError(f"JAX draws no {name!r} here; {remedy}")

    def _next(self) -> jax.Array:
        self._key, key = jax.random.split(self._key)
        return key

    def normal(
        self,
        loc: float = 0.0,
        scale: ArrayLike = 1.0,
        size: ArrayLike = (),
    ) -> jax.Array:
        """Draw from a normal distribution."""
        return loc + jnp.asarray(scale) * jax.random.normal(self._next(), _shape(size))

    def uniform(
        self,
        low: float = 0.0,
        high: Numeric = 1.0,
        size: ArrayLike = (),
    ) -> jax.Array:
        """Draw from a uniform distribution."""
        return jax.random.uniform(self._next(), _shape(size), minval=low, maxval=high)

    def beta(self, a: float, b: float, size: ArrayLike = ()) -> jax.Array:
        """Draw from a beta distribution."""
        return jax.random.beta(self._next(), a, b, _shape(size))


Random: TypeAlias = np.random.Generator | TracedRandom


def draw_starts(scenario: Scenario, random: Random) -> State:
    """Draw the start of every car of a scenario without streams, by `START_NOISE`."""
    cars = np.array(
        [(x, y, 0.0, SPEED_LIMIT + sum(faster)) for x, y, *faster in scenario.cars]
    )
    deviations = [
        START_NOISE.position,
        START_NOISE.position,
        START_NOISE.heading,
        START_NOISE.speed,
    ]
    cars = cars + random.normal(scale=deviations, size=cars.shape)
    if scenario.merging_car is not None:
        moved = np.zeros(cars.shape)
        moved[scenario.merging_car, 0] = 1.0
        cars = cars + moved * random.normal(scale=START_NOISE.merging)
    return cars


def draw_episode(
    scenario: Scenario,
    random: Random,
    humans: Reward,
) -> tuple[State, HumansWeights]:
    """Draw the start of every car, in SI units, and the weights of every human.

    Without streams, these are `draw_starts` and the given weights. In a stream, most
    spacings are near the shortest one, and the robot starts beside a random place in
    the middle. Every human multiplies its weight of ``collision_risk`` by its own
    factor: log-normal around 1, or much smaller for careless humans, see
    `StreamVariety`.

    Args:
        scenario: to draw for.
        random: generator to draw from.
        humans: rewards around which those of the humans are drawn, see
            `ms_highway.game.game.Game`.
    """
    weights = np.array(humans.weights, np.float32)
    if not scenario.streams:
        return draw_starts(scenario, random), weights

    # Share out the humans, and draw each stream.
    robot = np.array([*scenario.cars[0], 0.0, SPEED_LIMIT])
    number = len(weights)
    lanes = len(scenario.streams)
    humans_of_streams = [len(range(place, number, lanes)) for place in range(lanes)]
    streams = [
        _draw_stream(stream, humans_of_stream, random)
        for stream, humans_of_stream in zip(
            scenario.streams, humans_of_streams, strict=True
        )
    ]
    xp = streams[0].__array_namespace__()
    cars = xp.concatenate([robot[None], *streams])  # [cars, 4]
    deviations = [
        START_NOISE.position,
        START_NOISE.position,
        START_NOISE.heading,
        STREAM_VARIETY.speed_noise,
    ]
    cars = cars + random.normal(scale=deviations, size=cars.shape)

    # Draw how much each human avoids collisions [humans].
    factors = xp.exp(random.normal(0.0, STREAM_VARIETY.caution_spread, number))
    careless = random.uniform(size=number) < scenario.careless
    factors = xp.where(careless, STREAM_VARIETY.careless_factor, factors)
    factors = factors.astype(np.float32)
    is_caution = np.array([name == "collision_risk" for name in humans.names])
    return cars, xp.where(is_caution, weights * factors[:, None], weights)


def _draw_stream(
    stream: Stream,
    humans: int,
    random: Random,
) -> Float[Array, "humans_of_stream 4"]:
    """Draw the starts of a stream, front first, with the robot at x = 0 amidst."""
    shortest, longest = stream.spacing
    share = random.beta(1.0, STREAM_VARIETY.spacing_beta, humans)
    spacings = shortest + (longest - shortest) * share

    # Half of the humans start ahead of the robot, the last of them within a spacing.
    ahead = (humans + 1) // 2
    beside = random.uniform(0.0, spacings[min(ahead, humans - 1)])
    xp = spacings.__array_namespace__()
    x = beside + xp.sum(spacings[:ahead]) - xp.cumsum(spacings)
    y = np.full(humans, stream.lane)
    speed = np.full(humans, stream.speed)
    return xp.stack([x, y, np.zeros(humans), speed], axis=-1)
