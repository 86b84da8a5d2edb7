"""Draw the starts of episodes by NumPy, or by JAX in functions that JAX traces."""

from typing import Any, TypeAlias

import jax
import numpy as np
from jax import numpy as jnp

from ms_highway.game.reward import Reward
from ms_highway.game.scenario import PAPER_UNIT, SPEED_LIMIT, Scenario, Stream
from ms_highway.runtime.arrays import HumansWeights, State

POSITION_NOISE = 5e-4 * PAPER_UNIT  # m, standard deviation of x and y
HEADING_NOISE = 1e-3  # rad, standard deviation
START_SPEED_NOISE = 1e-3 * PAPER_UNIT  # m/s, standard deviation without streams
MERGING_NOISE = (
    0.01 * PAPER_UNIT
)  # m, further standard deviation of the merging car's x

SPACING_BETA = 20.0  # of Beta(1, 20): spacings are 0.3 m above the shortest on average
SPEED_NOISE = 0.3  # m/s, standard deviation of the speed of a human in a stream
CAUTION_SPREAD = (
    0.7  # standard deviation of the logarithm of what a human weighs collision_risk by
)
CARELESS_FACTOR = 0.05  # of the humans that hardly yield


def _shape(size: Any) -> list[int]:
    return np.atleast_1d(size).astype(int).tolist()


class TracedRandom:
    """Draw by JAX, from a key, with the methods of NumPy's generator that are used
    here.
    """

    def __init__(self, key: jax.Array) -> None:
        self._key = key

    def __getattr__(self, name: str) -> Any:
        remedy = (
            "draw by normal, uniform or beta, or use the vector environment, which"
            " draws by NumPy"
        )
        raise AttributeError(f"JAX draws no {name!r} here; {remedy}")

    def _next(self) -> jax.Array:
        self._key, key = jax.random.split(self._key)
        return key

    def normal(self, loc: Any = 0.0, scale: Any = 1.0, size: Any = ()) -> jax.Array:
        """Draw from a normal distribution."""
        return loc + jnp.asarray(scale) * jax.random.normal(self._next(), _shape(size))

    def uniform(self, low: Any = 0.0, high: Any = 1.0, size: Any = ()) -> jax.Array:
        """Draw from a uniform distribution."""
        return jax.random.uniform(self._next(), _shape(size), minval=low, maxval=high)

    def beta(self, a: float, b: float, size: Any = ()) -> jax.Array:
        """Draw from a beta distribution."""
        return jax.random.beta(self._next(), a, b, _shape(size))


Random: TypeAlias = np.random.Generator | TracedRandom


def draw_starts(scenario: Scenario, random: Random) -> State:
    """Draw the start of every car of a scenario without streams, with the noise of the
    paper's experiments.

    Normal noise of standard deviation 1.7 cm on x and y, 1e-3 rad on heading and 3.3
    cm/s on speed; another 33 cm on the x of the merging car.
    """
    cars = np.array(
        [(x, y, 0.0, SPEED_LIMIT + sum(faster)) for x, y, *faster in scenario.cars]
    )
    noise = [POSITION_NOISE, POSITION_NOISE, HEADING_NOISE, START_SPEED_NOISE]
    cars = cars + random.normal(scale=noise, size=cars.shape)
    if scenario.merging_car is not None:
        moved = np.zeros(cars.shape)
        moved[scenario.merging_car, 0] = 1.0
        cars = cars + moved * random.normal(scale=MERGING_NOISE)
    return cars


def draw_episode(
    scenario: Scenario, random: Random, humans: Reward
) -> tuple[State, HumansWeights]:
    """Draw the start of every car, in SI units, and the weights of every human's
    reward.

    Without streams, these are `draw_starts` and the given weights. In a stream, most
    spacings are near the shortest one, and the robot starts beside a random place in
    the middle. Every human multiplies its weight of ``collision_risk`` by its own
    factor: log-normal around 1, or `CARELESS_FACTOR` for careless humans.

    Args:
        scenario: to draw for.
        random: generator to draw from.
        humans: rewards around which those of the humans are drawn, see
            `ms_highway.game.game.Game`.
    """
    weights = np.array(humans.weights, np.float32)
    if not scenario.streams:
        return draw_starts(scenario, random), weights
    robot = np.array([*scenario.cars[0], 0.0, SPEED_LIMIT])
    number = len(weights)
    lanes = len(scenario.streams)
    dealt = [len(range(place, number, lanes)) for place in range(lanes)]
    streams = [
        _stream(stream, each, random)
        for stream, each in zip(scenario.streams, dealt, strict=True)
    ]
    xp = streams[0].__array_namespace__()
    cars = xp.concatenate([robot[None], *streams])
    noise = [POSITION_NOISE, POSITION_NOISE, HEADING_NOISE, SPEED_NOISE]
    cars = cars + random.normal(scale=noise, size=cars.shape)
    factors = xp.exp(random.normal(0.0, CAUTION_SPREAD, number))
    factors = xp.where(
        random.uniform(size=number) < scenario.careless, CARELESS_FACTOR, factors
    ).astype(np.float32)
    is_caution = np.array([name == "collision_risk" for name in humans.names])
    return cars, xp.where(is_caution, weights * factors[:, None], weights)


def _stream(stream: Stream, humans: int, random: Random) -> State:
    """Draw the starts of a stream, front first, with the robot at x = 0 beside its
    middle.
    """
    shortest, longest = stream.spacing
    spacings = shortest + (longest - shortest) * random.beta(1.0, SPACING_BETA, humans)
    ahead = (humans + 1) // 2  # of the robot
    beside = random.uniform(0.0, spacings[min(ahead, humans - 1)])
    xp = spacings.__array_namespace__()
    x = beside + xp.sum(spacings[:ahead]) - xp.cumsum(spacings)
    return xp.stack(
        [
            x,
            np.full(humans, stream.lane),
            np.zeros(humans),
            np.full(humans, stream.speed),
        ],
        axis=-1,
    )
