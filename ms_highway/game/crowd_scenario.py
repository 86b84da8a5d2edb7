"""Define the scenarios of a robot among several humans: geometry, streams of humans, their rewards and starts.

Numbers of scenarios are in the paper's unit of length, see `ms_highway.game.scenario`; drawn starts are in SI units.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from ms_highway.game.crowd import Crowd
from ms_highway.game.learned_reward import shipped
from ms_highway.game.planning_settings import PlanningSettings
from ms_highway.game.reward import Reward
from ms_highway.game.scenario import (
    COMMON_WEIGHTS,
    GRIP,
    MOTION_NOISE,
    PAPER_UNIT,
    POSITION_NOISE,
    SPEED_LIMIT,
    Scenario,
    build_game,
)
from ms_highway.optimization.solvers import Solver

__all__ = [
    "CROSSING_CROWD",
    "CROWD_LIMIT",
    "CROWD_PLANNING",
    "DENSE_MERGE",
    "HUMANS",
    "REACHED",
    "CrowdScenario",
    "Stream",
    "crowd_game",
    "crowd_scenario",
    "draw_crowd",
]

CROWD_PLANNING = PlanningSettings(horizon=20)
"""Plans two seconds ahead: merging among humans that yield takes longer than the paper's half second."""

CROWD_LIMIT = (0.2, 8.0)  # 1/m and m/s^2
"""Bounds on plans, with `ms_highway.game.scenario.GRIP`: what tyres hold on a dry road."""

REACHED = 0.8  # m
"""Distance from the centre of the target lane within which the robot has reached it."""

HUMANS = 2, 12
"""The fewest and the most humans of a crowd."""

SPACING = 8.0, 14.0  # m from centre to centre, shortest and longest
SHORTNESS = 20.0  # of Beta(1, SHORTNESS), the share of a spacing between the two: 8.3 m on average
SPEED_NOISE = 0.3  # m/s, standard deviation of a human's speed
CAUTION_SPREAD = 0.7  # standard deviation of the logarithm of what a human weighs collision_risk by
CARELESS, CARELESS_FACTOR = 0.2, 0.05  # share of the humans that hardly yield, and what they weigh collision_risk by


@dataclass(frozen=True)
class Stream:
    """Humans that drive in one lane, one behind the other.

    Attributes:
        lane: lateral position of the lane's centre.
        speed: mean speed.
    """

    lane: float
    speed: float = SPEED_LIMIT


@dataclass(frozen=True)
class CrowdScenario(Scenario):
    """A situation with several humans, who are drawn for every episode; ``cars`` holds the robot's start only.

    The robot succeeds if it ends in the target lane, the leftmost one, and never collides.

    Attributes:
        streams: of the humans, who are dealt out evenly, the first streams get what remains.
        humans: their default number.
        caution: factor on the humans' weight of ``collision_risk``: in dense traffic they accept short distances.
    """

    streams: tuple[Stream, ...] = ()
    humans: int = 8
    caution: float = 0.3


def _cones(first: float, lane: float) -> tuple[tuple[float, float], ...]:
    """Return three cones that close a lane from a place on."""
    return tuple((first + 0.09 * place, lane + 0.02) for place in range(3))


DENSE_MERGE = CrowdScenario(
    name="dense_merge",
    lanes=(-0.1, 0.0),
    cars=((0.0, 0.0),),
    steps=80,
    ladder=("naive", "turn", "tom"),
    prices=(10.0, 1.0),
    robot_weights=COMMON_WEIGHTS | {"target_lane": 150, "merged": 5},
    human_weights=COMMON_WEIGHTS,
    cones=_cones(2.0, 0.0),
    streams=(Stream(-0.1),),
)
"""The robot's lane ends, and most gaps of the stream beside it are too short for a car unless somebody yields."""

CROSSING_CROWD = CrowdScenario(
    name="crossing_crowd",
    lanes=(-0.2, -0.1, 0.0),
    cars=((0.0, 0.0),),
    steps=100,
    ladder=("naive", "turn", "tom"),
    prices=(10.0, 1.0),
    robot_weights=COMMON_WEIGHTS | {"target_lane": 150, "merged": 5},
    human_weights=COMMON_WEIGHTS,
    cones=_cones(1.5, 0.0),
    streams=(Stream(-0.1, 0.95 * SPEED_LIMIT), Stream(-0.2, 1.05 * SPEED_LIMIT)),
)
"""The robot's lane ends, and it wants to cross the stream of humans beside it, to join another one in the left lane.

Which human matters changes during the episode: first those of the middle lane, between whom it has to get before the
cones; then those of the left lane, who drive faster, so that its neighbours there are others than at the start."""


def crowd_scenario(name: str) -> CrowdScenario:
    """Return a scenario with several humans by its name.

    Raises:
        ValueError: if there is none of that name.
    """
    known = {scenario.name: scenario for scenario in (DENSE_MERGE, CROSSING_CROWD)}
    if name not in known:
        raise ValueError(f"{name!r} is no scenario with several humans; these are {', '.join(known)}")
    return known[name]


def crowd_game(
    scenario: CrowdScenario,
    humans: int,
    weights: Float[np.ndarray, "humans features"] | None = None,
    *,
    solver: Solver = "damped_newton",
    control_limit: tuple[float, float] | None = CROWD_LIMIT,
    grip: float | None = GRIP,
    planning: PlanningSettings = CROWD_PLANNING,
    human_driving: Mapping[str, float] | None = None,
) -> Crowd:
    """Build the game of a scenario with a number of humans, in paper semantics and SI units.

    Args:
        scenario: to build.
        humans: their number.
        weights: of every human's reward; by default, all have that of ``human_driving``.
        solver: see `ms_highway.game.scenario.build_game`.
        control_limit: see there.
        grip: see there.
        planning: see there.
        human_driving: weights by name, by default those learned from demonstrations.

    Raises:
        ValueError: if weights are given that are not an array [humans, features].
    """
    driving = shipped("demonstrations").weights if human_driving is None else human_driving
    driving = {**driving, "collision_risk": scenario.caution * driving.get("collision_risk", 0.0)}
    game = build_game(
        scenario,
        control_limit=control_limit,
        grip=grip,
        solver=solver,
        human_driving=driving,
        planning=planning,
    )
    shape = (humans, len(game.human.names))
    everybodys = np.broadcast_to(game.human.weights, shape) if weights is None else np.asarray(weights)
    if everybodys.shape != shape:
        raise ValueError(f"the humans' weights have shape {everybodys.shape}; {humans} humans need {shape}")
    return Crowd(game, np.array(everybodys, np.float32))


def draw_crowd(
    scenario: CrowdScenario, humans: int, random: np.random.Generator, driver: Reward | None = None
) -> tuple[Float[np.ndarray, "cars 4"], Float[np.ndarray, "humans features"]]:
    """Draw the start of every car, the robot first, and the weights of every human's reward.

    Centres are 8 to 14 m apart, most of them near 8, and the robot starts beside a random place in the middle of every
    stream. Humans weigh ``collision_risk`` by a factor of their own, log-normal around 1; every fifth, on average, by
    `CARELESS_FACTOR`: it hardly yields.

    Args:
        scenario: to draw for.
        humans: their number.
        random: what is drawn from.
        driver: reward that the humans' rewards are drawn around, by default the learned one of `crowd_game`.

    Returns:
        Starts (x, y, heading, speed) in SI units, and weights in the order of the driver's features.
    """
    driver = crowd_game(scenario, humans).game.human if driver is None else driver
    robot = np.array([*scenario.cars[0], 0.0, SPEED_LIMIT]) * [PAPER_UNIT, PAPER_UNIT, 1.0, PAPER_UNIT]
    dealt = [len(range(place, humans, len(scenario.streams))) for place in range(len(scenario.streams))]
    streams = [_stream(stream, each, random) for stream, each in zip(scenario.streams, dealt, strict=True)]
    cars = np.concatenate([robot[None], *streams])
    noise = [POSITION_NOISE * PAPER_UNIT, POSITION_NOISE * PAPER_UNIT, MOTION_NOISE, SPEED_NOISE]
    cars += random.normal(scale=noise, size=cars.shape)
    factors = np.exp(random.normal(0.0, CAUTION_SPREAD, humans))
    factors = np.where(random.uniform(size=humans) < CARELESS, CARELESS_FACTOR, factors)
    weights = np.tile(np.asarray(driver.weights, np.float32), (humans, 1))
    weights[:, driver.names.index("collision_risk")] *= factors.astype(np.float32)
    return cars, weights


def _stream(stream: Stream, humans: int, random: np.random.Generator) -> Float[np.ndarray, "humans 4"]:
    """Draw the starts of a stream, front first; the robot, at x = 0, is beside a gap in the middle, or the last one."""
    shortest, longest = SPACING
    spacings = shortest + (longest - shortest) * random.beta(1.0, SHORTNESS, humans)
    ahead = (humans + 1) // 2  # of the robot
    beside = random.uniform(0.0, spacings[min(ahead, humans - 1)])
    x = beside + np.sum(spacings[:ahead]) - np.cumsum(spacings)
    y, speed = stream.lane * PAPER_UNIT, stream.speed * PAPER_UNIT
    return np.stack([x, np.full(humans, y), np.zeros(humans), np.full(humans, speed)], axis=-1)
