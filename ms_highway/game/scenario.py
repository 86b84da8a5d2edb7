"""Define scenarios with one human or several, and build their games.

The numbers of a `Scenario` and of drawn starts are in SI units. Games are built in any
unit of length, such as that of the paper, 100/3 m, in which the released code computes.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from numbers import Real
from typing import ClassVar, Literal, TypeAlias

import jax
import numpy as np

from ms_highway.game.car_following import CAR_LIMITS
from ms_highway.game.dynamics import Dynamics
from ms_highway.game.game import Game
from ms_highway.game.reward import Reward, features_for, linear_reward
from ms_highway.game.scene import PAPER_SIZES, PAPER_UNIT, Scene
from ms_highway.numerics.convex_newton import NEWTON_STEPS
from ms_highway.numerics.second_derivatives import Influence
from ms_highway.numerics.solvers import (
    PAPER_PLANNING,
    Ascent,
    Newton,
    Planner,
    PlanningSettings,
    Solver,
    SolverName,
    gradient_steps,
)
from ms_highway.runtime.arrays import Published, Scalar, read_only

Semantics: TypeAlias = Literal["paper", "released", "physical"]

SPEED_LIMIT = 0.6 * PAPER_UNIT
"""The paper's speed limit [m/s]: 20."""

TIME_STEP = 0.1
"""The paper's time step [s]."""

PAPER_DYNAMICS = Dynamics("curvature", "linear", drag=0.2, time_step=TIME_STEP)
"""The paper's dynamics with friction, Sec. IV-A, in any unit of length.

The paper gives no value of its drag alpha; here it is 0.2 1/s.
"""

PHYSICAL_LIMIT = (0.2, 50.0)
"""Default bounds on the curvature and the acceleration of plans [1/m, m/s^2].

They are those of a front wheel turned by 45 degrees, and six times what tyres hold. The
paper's scenes are infeasible within the grip of tyres: at 20 m/s a horizon of half a
second sees a cone only 10 m ahead, so that gradient plans in Stay Back need 50 m/s^2,
and the human in Merger yields with up to 21 m/s^2.
"""

GRIP = CAR_LIMITS.braking
"""Grip of tyres on a dry road, steering and acceleration together [m/s^2].

It limits the first control of every plan and all executed controls. Later controls of a
plan may exceed it by a quarter (`ms_highway.game.game.bounded`). Version 0 has no limit
of grip unless ``grip`` is set.
"""

COMMON_WEIGHTS = Published(
    {
        "speed": 2,
        "lane_alignment": 75,
        "collision_risk": -1,
        "collision": -100,
        "off_road": -2500,
    }
)
"""Weights that every driver of every scenario has."""


@dataclass(frozen=True)
class Stream:
    """Humans that drive in one lane, one behind the other.

    Attributes:
        lane: lateral position of the lane's centre [m].
        speed: mean speed [m/s].
        spacing: from centre to centre, shortest and longest [m].
    """

    lane: float
    speed: float = SPEED_LIMIT
    spacing: tuple[float, float] = (8.0, 14.0)


@dataclass(frozen=True)
class Scenario:
    """A situation of a robot with one human, or with several.

    Several humans are drawn for every episode.

    Attributes:
        name: in commands and records.
        lanes: lateral position of each lane's centre, 3.3 m apart in the package's
            scenarios [m].
        cars: start (x, y) of the robot, the human, and the scripted cars [m]; with
            streams, of the robot alone. All start at heading 0 and at the speed limit,
            20 m/s; a third number is how much faster a car starts [m/s].
        steps: length of an episode.
        ladder: names of the human models to choose from by default, cheapest first.
        prices: two lambdas, aggressive and conservative, of the paper's comparison
            [reward per second].
        robot_weights, human_weights: reward weights by feature.
        robot_gap, human_gap: distance behind the leader at which the gap feature is
            highest [m].
        cones: centres of the cones [m].
        merging_car: index of the car with additional noise on its start.
        corner: see `Scene`.
        streams: of humans, who are shared out evenly, any remaining ones to the first
            streams. With streams, the robot succeeds if it ends in the target lane, the
            leftmost one, and never collides.
        humans: their number, by default.
        caution: factor of the humans' weight of ``collision_risk``: in dense traffic
            they accept short distances.
        careless: share of the humans in streams that hardly yield.
        semantics, planning, solver, control_limit, grip: defaults, see `build_game`.
        way_out: whether the robot keeps a way out by default, see
            `ms_highway.planning.way_out`.

    Raises:
        ValueError: for sizes that no road has, such as numbers in other units than
            metres, and for several humans without streams.
    """

    max_lane_distance: ClassVar[float] = 6.0
    """Largest distance between neighbouring lanes, and of a start from a lane [m]."""
    humans_with_streams: ClassVar[tuple[int, int]] = (2, 20)
    """The fewest and the most humans of a scenario with streams."""
    units: ClassVar[str] = "all numbers are in metres, y to the right"
    """What errors remind of."""

    name: str
    lanes: tuple[float, ...]
    cars: tuple[tuple[float, ...], ...]
    steps: int
    ladder: tuple[str, ...]
    prices: tuple[float, float]
    robot_weights: Mapping[str, float]
    human_weights: Mapping[str, float]
    robot_gap: float = 0.0
    human_gap: float = 0.0
    cones: tuple[tuple[float, float], ...] = ()
    merging_car: int | None = None
    corner: float = 0.5
    streams: tuple[Stream, ...] = ()
    humans: int = 1
    caution: float = 1.0
    careless: float = 0.2
    semantics: Semantics = "paper"
    planning: PlanningSettings = PAPER_PLANNING
    solver: SolverName = "gradient"
    control_limit: tuple[float, float] | None = PHYSICAL_LIMIT
    grip: float | None = None
    way_out: bool = False

    def __post_init__(self) -> None:
        """Make the weights unchangeable, and check all that is known by now."""
        for name in ("robot_weights", "human_weights"):
            weights = getattr(self, name)
            if not isinstance(weights, Mapping):
                raise ValueError(
                    f"scenario {self.name!r} has {name}={weights!r}; give weights by"
                    " name of a feature"
                )
            object.__setattr__(self, name, Published(weights))
        self._check_humans()
        self._check_lanes()
        for stream in self.streams:
            self._check_stream(stream)
        for car in self.cars:
            self._check_point("a car", car, (2, 3))
        for cone in self.cones:
            self._check_point("a cone", cone, (2,))

    @property
    def _place(self) -> str:
        """Where an error is, for its message."""
        return f"scenario {self.name!r}"

    def _check_humans(self) -> None:
        """Refuse a number of humans that there cannot be."""
        fewest, most = self.humans_with_streams if self.streams else (1, 1)
        if not fewest <= self.humans <= most:
            why = (
                "streams say where several humans drive, and without streams there"
                " is one"
            )
            if self.streams:
                why = f"give {fewest} to {most}"
            raise ValueError(
                f"{self._place} has humans={self.humans} and {len(self.streams)}"
                f" streams; {why}"
            )
        if not 0 <= self.careless <= 1:
            raise ValueError(
                f"{self._place} has careless {self.careless}; give a share from 0 to 1"
            )

    def _check_lanes(self) -> None:
        """Refuse lanes in which two cars overlap, or that are far from each other."""
        lanes = np.sort(np.asarray(self.lanes, float).ravel())
        apart = np.diff(lanes)
        _, car_width = PAPER_SIZES.car
        narrow = apart < car_width
        wide = apart > self.max_lane_distance
        if not len(lanes) or not np.isfinite(lanes).all() or np.any(narrow | wide):
            raise ValueError(
                f"{self._place} has lanes at {self.lanes}; neighbours must be"
                f" {car_width:g} to {self.max_lane_distance:g} m apart, and"
                f" {self.units}"
            )

    def _check_stream(self, stream: Stream) -> None:
        """Refuse spacings in which cars overlap, or that are not in order."""
        shortest, longest = stream.spacing
        length, _ = PAPER_SIZES.car
        if not length < min(stream.spacing) or shortest > longest:
            raise ValueError(
                f"{self._place} has a stream of spacing {stream.spacing}; give the"
                f" shortest, more than {length:g} m, then the longest"
            )

    def _check_point(
        self,
        kind: str,
        point: tuple[float, ...],
        lengths: tuple[int, ...],
    ) -> None:
        """Refuse a point that has other numbers than x and y, or is off all lanes.

        Args:
            kind: what is there.
            point: x and y [m], of a car perhaps a third number.
            lengths: how many numbers it may have.
        """
        if len(point) not in lengths:
            raise ValueError(
                f"{self._place} has {kind} at {point}; give x and y, and {self.units}"
            )
        from_lanes = np.abs(np.asarray(self.lanes, float).ravel() - point[1])
        if not np.isfinite(point).all() or np.min(from_lanes) > self.max_lane_distance:
            raise ValueError(
                f"{self._place} has {kind} at {point}, beside all lanes, at"
                f" {self.lanes}; {self.units}"
            )

    def check(self) -> None:
        """Check what an environment needs, and what may be registered only later.

        Raises:
            ValueError: naming the scenario, the value and a remedy.
        """
        if not self.streams and len(self.cars) < 2:
            remedy = (
                "give the starts of the robot and of the human, or streams of humans"
            )
            raise ValueError(
                f"{self._place} has no human, as its cars are {self.cars}; {remedy}"
            )
        if not isinstance(self.steps, int) or self.steps < 1:
            raise ValueError(
                f"{self._place} has steps={self.steps!r}; give a whole number of steps,"
                " 1 or more"
            )
        lambdas = [
            price
            for price in self.prices
            if isinstance(price, Real) and 0 <= price < np.inf
        ]
        if len(self.prices) != 2 or len(lambdas) != 2:
            raise ValueError(
                f"{self._place} has the prices {self.prices!r}; give two lambdas, 0 or"
                " more"
            )
        places = range(len(self.cars))
        if self.merging_car is not None and self.merging_car not in places:
            raise ValueError(
                f"{self._place} has merging_car={self.merging_car!r}; give the place of"
                f" one of its {len(self.cars)} cars, or None"
            )
        for name in ("robot_weights", "human_weights"):
            try:
                linear_reward(getattr(self, name), SPEED_LIMIT)
            except ValueError as error:
                raise ValueError(f"{self._place}, {name}: {error}") from None


def title(name: str) -> str:
    """Return the title of a scenario's name.

    It is ``Stay Back`` for ``stay_back``, ``Stay Back v1`` for ``stay-back-v1``.
    """
    words = name.replace("_", " ").replace("-", " ").split()
    return " ".join(word if word[1:].isdigit() else word.title() for word in words)


def build_game(
    scenario: Scenario,
    semantics: Semantics = "paper",
    control_limit: tuple[float, float] | None = None,
    grip: float | None = None,
    unit: float = PAPER_UNIT,
    solver: SolverName | None = None,
    human_driving: Mapping[str, float] | None = None,
    planning: PlanningSettings | None = None,
    humans: int | None = None,
) -> Game:
    """Build the game of a scenario, in which all humans have the same reward.

    Its arrays cannot be written.

    Args:
        scenario: to build.
        semantics: ``paper``: the paper's dynamics with friction, in the world and in
            the planners, and a damped response of humans. ``physical``: the same within
            the `GRIP` of tyres, where a collision is an overlap of bodies; only plans
            by the solver ``convex_newton`` keep whole bodies apart
            (`ms_highway.game.contact`). ``released``: the dynamics of the released
            code, where planners ignore the world's drag, and the exact response.
        control_limit: bounds on the magnitude of omega and acceleration in plans, in
            the units of the semantics; None for no bounds.
        grip: total acceleration that tyres hold, in the game's lengths per s^2, see
            `Planner`; None for no limit, in physical semantics for `GRIP`.
        unit: length of one paper unit, 100/3 m, in the game; 1 keeps the released
            code's numbers.
        solver: ``gradient`` or ``convex_newton``, see `ms_highway.numerics.solvers`;
            None for the scenario's.
        human_driving: weights by name that replace `COMMON_WEIGHTS` in the humans'
            reward; other weights of the scenario stay unless they are named here.
        planning: horizon and gradient steps of all plans, and the time step of plans
            and world; None for the scenario's.
        humans: their number; None for the scenario's.
    """
    # Rewards and road, in the game's unit of length.
    human_weights = _human_weights(scenario, human_driving)
    names = features_for(scenario.robot_weights, human_weights)
    metre = unit / PAPER_UNIT
    speed_limit = SPEED_LIMIT * metre
    robot = linear_reward(
        scenario.robot_weights, speed_limit, scenario.robot_gap * metre, names
    )
    human = linear_reward(human_weights, speed_limit, scenario.human_gap * metre, names)
    scene = _scene(scenario, semantics, unit)

    # Dynamics: the released planners neglect the world's drag, 0.2 per paper unit.
    planning = planning or scenario.planning
    if semantics == "released":
        drag = 0.2 / PAPER_UNIT / metre
        plans = Dynamics("yaw_rate", "linear", 0.0, planning.time_step)
        world = Dynamics("yaw_rate", "quadratic", drag, planning.time_step)
    else:
        plans = world = replace(PAPER_DYNAMICS, time_step=planning.time_step)

    # Solver and limits of plans.
    if semantics == "physical" and grip is None:
        grip = GRIP * metre
    name = solver or scenario.solver
    continues = bool(scenario.streams)
    improves = _solver(name, planning, continues, ease=NEWTON_STEPS.ease)
    planner = _planner(scene, plans, control_limit, grip, improves, planning.horizon)

    rewards = _humans(human, humans or scenario.humans)
    influence: Influence = "exact" if semantics == "released" else "damped"
    game = Game(scene, robot, rewards, plans, world, planner, influence)
    return read_only(
        jax.tree.map(lambda number: np.asarray(number, dtype=np.float32), game)
    )


def _human_weights(
    scenario: Scenario,
    human_driving: Mapping[str, float] | None,
) -> dict[str, float]:
    """Return the weights of the humans' reward, see `build_game`."""
    weights = dict(scenario.human_weights)
    if human_driving is not None:
        aims = {
            name: weight
            for name, weight in weights.items()
            if name not in COMMON_WEIGHTS
        }
        weights = {**aims, **human_driving}
    risk = weights.get("collision_risk", 0.0)
    weights["collision_risk"] = scenario.caution * risk
    return weights


def _scene(scenario: Scenario, semantics: Semantics, unit: float) -> Scene:
    """Return the road of a scenario in a unit of length, see `build_game`."""
    metre = unit / PAPER_UNIT
    return Scene(
        lanes=np.array(scenario.lanes) * metre,
        lane_width=PAPER_SIZES.lane_width * metre,
        obstacles=np.array(scenario.cones).reshape(-1, 2) * metre,
        obstacle_size=np.array(PAPER_SIZES.cone) * metre,
        car_size=np.array(PAPER_SIZES.car) * metre,
        corner=scenario.corner,
        target_lane=min(scenario.lanes) * metre,
        length_unit=unit,
        leader=2 if len(scenario.cars) > 2 else None,
        contact="bodies" if semantics == "physical" else "paper",
    )


def driving_game(
    scene: Scene,
    speed_limit: float,
    weights: Mapping[str, float] = COMMON_WEIGHTS,
    names: tuple[str, ...] | None = None,
    solver: SolverName = "gradient",
    planning: PlanningSettings = PAPER_PLANNING,
    grip: float | None = GRIP,
) -> Game:
    """Build a game on any scene, in which both cars have the same reward.

    It has the paper's dynamics. Its numbers are not converted to arrays: a driver on a
    road builds a game in every step, and the conversion would take longer than the
    plan.

    Args:
        scene: road, obstacles and bodies.
        speed_limit: speed that is rewarded most [m/s].
        weights: of the reward of both, by name.
        names: of the features to compute, see `ms_highway.game.reward.linear_reward`.
        solver: ``gradient`` or ``convex_newton``, see `ms_highway.numerics.solvers`.
        planning: see `build_game`.
        grip: of tyres [m/s^2], see `ms_highway.numerics.solvers.Planner`; None for
            `PHYSICAL_LIMIT` alone.
    """
    driver = linear_reward(weights, speed_limit, names=names)
    motion = replace(PAPER_DYNAMICS, time_step=planning.time_step)
    improves = _solver(solver, planning, continues=False, ease=0.0)
    planner = _planner(scene, motion, PHYSICAL_LIMIT, grip, improves, planning.horizon)
    return Game(scene, driver, _humans(driver, 1), motion, motion, planner)


def _humans(reward: Reward, number: int) -> Reward:
    return replace(reward, weights=np.tile(reward.weights, (number, 1)))


def _solver(
    name: SolverName,
    planning: PlanningSettings,
    continues: bool,
    ease: float,
) -> Solver:
    """Return the solver of a name; only `Newton` has an ease."""
    if name == "convex_newton":
        return Newton(ease, continues=continues)
    iterations, step_size = gradient_steps(planning)
    return Ascent(step_size, iterations, continues)


def _planner(
    scene: Scene,
    dynamics: Dynamics,
    control_limit: tuple[float, float] | None,
    grip: float | None,
    solver: Solver,
    horizon: int,
) -> Planner:
    """Return a planner with a scale of controls for gradient steps.

    In this scale, a step of 0.03 has the paper's effect. The unit of acceleration is
    one length unit per s^2, that of omega one rad/s of yaw rate. With steering by
    curvature, it is converted at the paper's speed limit, ``omega = yaw_rate / v``:
    omega's gradient step scales with 1/v^2.
    """
    turn_scale: Scalar = 1.0
    if dynamics.steering == "curvature":
        turn_scale = PAPER_UNIT / (SPEED_LIMIT * scene.length_unit)
    limit = np.full(2, np.inf) if control_limit is None else np.array(control_limit)
    return Planner(
        np.array([turn_scale, scene.length_unit]), limit, grip, solver, horizon
    )
