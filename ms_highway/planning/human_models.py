"""Define the human models of the ladder: naive, IDM, turn and theory of mind.

A `HumanModel` predicts one human, in the game of the robot with that human alone
(`ms_highway.game.game.pair`), or lets it respond to the robot's plan;
`ms_highway.planning.compiled_plans` plans with a model for every human. Predictions are
in SI units; plans and their starts are scaled, see `ms_highway.game.game`.

A model has an effort: its number of steps, and the plan from which they start.
``tom@8`` is theory of mind in 8 ascent steps, ``tom+warm`` starts from the rest of the
last plan, and ``tom@8+warm`` does both.
"""

from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, fields, replace
from typing import ClassVar
from warnings import warn

import jax
import numpy as np
from jax import numpy as jnp
from jaxtyping import Float

from ms_highway.game.car_following import FREE_GAP, STREAM_IDM
from ms_highway.game.dynamics import keep_velocity, step
from ms_highway.game.game import Game, bounded, constant_velocity, pair, swap_players
from ms_highway.geometry.bodies import nearest_ahead
from ms_highway.numerics.solvers import Ascent, Solver, longest_step
from ms_highway.planning.joint import joint_ascent, plan_against
from ms_highway.planning.plans import Plan, Solution, cold_start
from ms_highway.planning.responders import Interaction, KnownResponders
from ms_highway.runtime.arrays import (
    Car,
    Control,
    Controls,
    State,
    naming_writes,
    read_only,
)


@dataclass(frozen=True)
class HumanModel:
    """A rung of the ladder; hashable, as a plan is compiled once per model.

    A model predicts the human, by `predict`, or it ``responds``: then the human
    improves its own controls in every step of the ascent that plans for the robot,
    alone and among several humans, in the steps of `solver` from `start`.

    Attributes:
        name: in configurations and reports, with the effort; that of the class is
            without.
        responds: whether the human responds to the robot's plan.
        steps: number of steps of each ascent; None for the planner's.
        warm: whether plans start from the rest of the last plan, of any model, instead
            of a cold start.
    """

    name: ClassVar[str]
    responds: ClassVar[bool] = False
    steps: int | None = field(default=None, kw_only=True)
    warm: bool = field(default=False, kw_only=True)

    def __post_init__(self) -> None:
        """Add the effort to the name."""
        of_steps = f"@{self.steps}" if self.steps else ""
        of_start = "+warm" if self.warm else ""
        effort = of_steps + of_start
        if effort:
            object.__setattr__(self, "name", type(self).name + effort)

    def solver(self, game: Game) -> Solver:
        """Return the solver of plans under this model.

        It is the planner's, in the model's number of steps.

        A model of one's own may return the planner's solver with other steps:
        ``iterations`` and ``step_size`` of an `ms_highway.numerics.solvers.Ascent`,
        ``steps`` and ``joint_steps`` of a `ms_highway.numerics.solvers.Newton`.
        Everything else belongs to the robot's plan, which all humans share.
        """
        usual = game.planner.solver
        if self.steps is None:
            return usual
        longest = longest_step(game.planner.horizon, game.dynamics.time_step)
        return usual.with_steps(self.steps, longest)

    def start(self, game: Game, state: State, last: Plan) -> Plan:
        """Return the scaled plan from which plans under this model start.

        Only models that respond have a start of their own. Among several humans, the
        robot starts as the most expensive of these models in use wants.

        Args:
            game: of the robot and this human.
            state: of the robot, the human and all other cars.
            last: rest of the last plan, if the model or the planner continues it, or
                else a cold start.
        """
        return last

    def seconds(self, costs: Mapping[str, float], usual: int) -> float | None:
        """Return T(M) [s]; None where it does not follow from the costs.

        It is the cost of the model's name, or else of the name without ``+warm``, as a
        start costs nothing, or else it is proportional to the number of steps.

        Args:
            costs: T(M) by name [s].
            usual: number of steps of the model without an effort.
        """
        for name in (self.name, self.name.removesuffix("+warm")):
            if name in costs:
                return costs[name]
        base = costs.get(type(self).name)
        if base is None or self.steps is None:
            return None
        return base * self.steps / usual

    def predict(self, game: Game, state: State, start: Plan | None = None) -> Controls:
        """Predict the human's controls over the horizon, in SI units and traced by JAX.

        Under a control (omega, a), the speed v changes by ``v' = a - friction v`` and
        the heading by ``v omega``; so `ms_highway.game.dynamics.keep_velocity` plus (0,
        -4) brakes by 4 m/s^2. Plans cut predictions to their limits, with a warning if
        they do so at the start of an episode.

        Args:
            game: of the robot and this human; ``game.planner.horizon`` steps of
                ``game.dynamics.time_step`` seconds.
            state: x, y [m], heading [rad] and speed [m/s] of the robot, the human and
                all other cars, [cars, 4].
            start: scaled plan that the robot's starts from; None for a cold start.

        Returns:
            Curvature omega [1/m], or yaw rate [rad/s] under ``steering="yaw_rate"`` of
            `ms_highway.game.dynamics.Dynamics`, and acceleration a before friction
            [m/s^2] of each step, [horizon, 2].
        """
        if not self.responds:
            raise NotImplementedError(f"human model {self.name!r} defines no `predict`")
        last = cold_start(game, state) if start is None else start
        begin = own_start(self, game, state, last)
        interaction = Interaction(game, state, KnownResponders((0,)))
        solution = joint_ascent(interaction, begin)
        return solution.plan.humans[0] * game.planner.control_scale


@dataclass(frozen=True)
class PredictedHuman(HumanModel):
    """Base of models that predict the human whatever the robot plans."""


@dataclass(frozen=True)
class Naive(PredictedHuman):
    """The human keeps its velocity."""

    name: ClassVar[str] = "naive"

    def predict(self, game: Game, state: State, start: Plan | None = None) -> Controls:
        """Return the controls that keep the human's speed and heading."""
        control = keep_velocity(game.dynamics, state[1])
        xp = control.__array_namespace__()  # of NumPy or JAX
        return xp.tile(control, (game.planner.horizon, 1))


@dataclass(frozen=True)
class IntelligentDriver(PredictedHuman):
    """The human follows the car ahead in its lane, such as the robot, by IDM.

    The parameters are `ms_highway.game.car_following.STREAM_IDM`, and the desired speed
    is the speed limit. All others keep their velocity.
    """

    name: ClassVar[str] = "idm"

    def predict(self, game: Game, state: State, start: Plan | None = None) -> Controls:
        """Return the controls of a human that keeps its heading and follows."""

        def follow(state: jax.Array, _: None) -> tuple[jax.Array, Control]:
            control = following_control(game, state)
            steady = keep_velocity(game.dynamics, state)
            controls = steady.at[1].set(control)
            return step(game.dynamics, state, controls), control

        start_state = jnp.asarray(state)
        horizon = game.planner.horizon
        _, controls = jax.lax.scan(follow, start_state, None, horizon)
        return controls


def following_control(game: Game, state: State) -> Control:
    """Return the control, not scaled, of car 1 if it follows the car ahead by IDM."""
    scene = game.scene
    own = state[1]
    others = jnp.concatenate([state[:1], state[2:]])

    # The nearest car ahead whose centre is within half a lane to the side.
    offset = others[:, :2] - own[:2]  # [others, 2]
    half_lane = jnp.asarray(scene.lane_width) / 2
    in_lane = jnp.abs(offset[:, 1]) < half_lane
    leader, leads = nearest_ahead(offset[:, 0], in_lane)

    # The gap between bumpers.
    length = jnp.asarray(scene.car_size)[0]
    to_leader = offset[leader, 0] - length
    gap = jnp.where(leads, to_leader, FREE_GAP)

    limit = jnp.asarray(game.humans.speed_limit)
    leader_speed = others[leader, 3]
    change = STREAM_IDM.acceleration(own[3], limit, gap, leader_speed)
    return keep_velocity(game.dynamics, own).at[1].add(change)


@dataclass(frozen=True)
class Turn(PredictedHuman):
    """The human optimises its own reward against a robot that keeps its velocity.

    It does so whatever the robot plans.
    """

    name: ClassVar[str] = "turn"

    def predict(self, game: Game, state: State, start: Plan | None = None) -> Controls:
        """Return the human's plan against a robot that keeps its velocity."""
        mirrored = None
        if start is not None:
            mirrored = Plan(start.humans[0], start.robot[None])
        own_game, own_state = swap_players(game, state)
        solution = plan_alone(own_game, own_state, mirrored)
        return solution.plan.robot * game.planner.control_scale


@dataclass(frozen=True)
class TheoryOfMind(HumanModel):
    """The human responds optimally to the robot's plan, and the robot anticipates that.

    This is a Stackelberg game, see `ms_highway.planning.joint`.
    """

    name: ClassVar[str] = "tom"
    responds: ClassVar[bool] = True


def plan_alone(game: Game, state: State, start: Plan | None = None) -> Solution:
    """Plan the controls of car 0, who believes that others keep their velocity."""
    partners_now = state[1 : 1 + game.number]
    partners = constant_velocity(game, partners_now)
    begin = cold_start(game, state) if start is None else start
    return plan_against(game, state, partners, begin)


PACKAGE_TYPES = (Naive, IntelligentDriver, Turn, TheoryOfMind)
"""The package's models, cheapest first."""


def is_of_package(model: HumanModel) -> bool:
    """Return whether a model is one of the package.

    The controls of these keep to the limits of plans by themselves.
    """
    return type(model) in PACKAGE_TYPES


def scaled_prediction(
    model: HumanModel,
    game: Game,
    state: State,
    start: Plan | None = None,
) -> Controls:
    """Return a model's prediction, scaled.

    That of a registered model is cut to the limits of plans.

    Raises:
        ValueError: if a registered model does not predict [horizon, 2] numbers.
    """
    own_game = within(model, game)
    controls = model.predict(own_game, state, start)
    if is_of_package(model):
        return controls / game.planner.control_scale
    checked = _checked(model, game, controls)
    return _scaled_within_limits(game, state[1], checked)


def own_solver(model: HumanModel, game: Game) -> Solver:
    """Return the solver of a model, see `HumanModel.solver`.

    Raises:
        ValueError: for a solver that differs from the planner's in more than its steps,
            or that takes none.
    """
    solver = model.solver(game)
    usual = game.planner.solver
    kind = type(usual).__name__
    free_fields = ("steps", "joint_steps")
    if isinstance(usual, Ascent):
        free_fields = ("iterations", "step_size")
    first, second = free_fields
    subject = f"human model {model.name!r} plans"

    # It is the planner's kind of solver.
    if type(solver) is not type(usual):
        remedy = f"return game.planner.solver, a {kind}, with other {first} or {second}"
        raise ValueError(f"{subject} by {solver!r}; {remedy}")

    # It differs in its steps alone.
    for each in fields(usual):
        name = each.name
        own = getattr(solver, name)
        is_usual = own is getattr(usual, name)
        if name not in free_fields and not is_usual:
            what = f"a solver whose {name} is {own!r}, not the planner's"
            remedy = f"change only {first} and {second} of game.planner.solver"
            raise ValueError(f"{subject} by {what}; {remedy}")

    # It takes some.
    for responds in (False, True):
        most = solver.most_steps(responds)
        if not isinstance(most, int) or most < 1:
            remedy = "give whole numbers of at least 1"
            raise ValueError(f"{subject} in {most!r} steps; {remedy}")
    return solver


def own_start(model: HumanModel, game: Game, state: State, last: Plan) -> Plan:
    """Return the start of a model that responds, see `HumanModel.start`.

    Raises:
        ValueError: if it is no plan of the game.
    """
    if type(model).start is HumanModel.start:
        return last
    start = model.start(game, state, last)
    of_robot = (game.planner.horizon, 2)
    of_human = (1, *of_robot)
    found = repr(start)
    with suppress(TypeError, ValueError):
        robot, humans = map(jnp.asarray, start)
        found = f"arrays {robot.shape} and {humans.shape}"
        if robot.shape == of_robot and humans.shape == of_human:
            return Plan(robot, humans)
    remedy = (
        f"return a Plan of scaled controls: the robot's {of_robot}, and the human's"
        f" {of_human}"
    )
    raise ValueError(f"human model {model.name!r} starts from {found}; {remedy}")


def within(model: HumanModel, game: Game) -> Game:
    """Return the game with the solver of a model."""
    solver = own_solver(model, game)
    planner = replace(game.planner, solver=solver)
    return replace(game, planner=planner)


def _scaled_within_limits(game: Game, human: Car, controls: Controls) -> Controls:
    """Scale predicted controls of a human, and cut finite ones to plans' limits."""
    scaled = controls / game.planner.control_scale
    is_finite = jnp.isfinite(scaled)
    within_limits = bounded(game, human, scaled)
    return jnp.where(is_finite, within_limits, scaled)


def _checked(model: HumanModel, game: Game, controls: object) -> jax.Array:
    """Return the prediction of a registered model as an array [horizon, 2].

    Raises:
        ValueError: if it is anything else.
    """
    wanted = (game.planner.horizon, 2)
    found = repr(controls)
    with suppress(TypeError, ValueError):
        array = jnp.asarray(controls)
        is_real = jnp.isdtype(array.dtype, ("integral", "real floating"))
        if array.shape == wanted and is_real:
            return array
        found = f"an array of shape {array.shape} and type {array.dtype}"
    remedy = (
        f"predict numbers {wanted}: curvature [1/m] and acceleration [m/s^2] in every"
        " step of the horizon"
    )
    raise ValueError(f"human model {model.name!r} predicts {found}; {remedy}")


def warn_of_limits(ladder: Iterable[HumanModel], game: Game, state: State) -> None:
    """Warn of registered models whose prediction is cut by limits, or not finite.

    The prediction is that of the first human in a start.
    """
    for model in ladder:
        if is_of_package(model) or model.responds:
            continue
        protected = read_only(within(model, game))
        own_game, cars = pair(protected, jnp.asarray(state), 0)
        with naming_writes(f"the human model {model.name!r}"):
            controls = model.predict(own_game, cars)
            predicted = np.asarray(_checked(model, own_game, controls))
        within_limits = _scaled_within_limits(own_game, cars[1], predicted)
        kept = np.asarray(within_limits * game.planner.control_scale)
        _warn_of_cut(model, predicted, kept)


def _warn_of_cut(
    model: HumanModel,
    predicted: Float[np.ndarray, "steps 2"],
    kept: Float[np.ndarray, "steps 2"],
) -> None:
    """Warn of the first predicted control that limits cut, or that is not finite.

    Args:
        model: registered, that predicts.
        predicted: its controls in SI units.
        kept: what the limits leave of them.
    """
    is_finite = np.isfinite(predicted)
    tolerance = 1e-3 * np.abs(predicted)
    is_cut = np.abs(predicted - kept) > tolerance
    places = np.argwhere(~is_finite | is_cut)
    if not len(places):
        return

    step, column = places[0]
    value = predicted[step, column]
    what = f"an acceleration of {value:.3g} m/s^2"
    if column == 0:
        what = f"a curvature of {value:.3g} 1/m"
    effect = "so that no plan follows"
    if is_finite[step, column]:
        effect = f"which the limits of plans cut to {kept[step, column]:.3g}"
    remedy = "predictions are in SI units, see ms_highway.HumanModel.predict"
    message = f"human model {model.name!r} predicts {what}, {effect}; {remedy}"
    warn(message, stacklevel=3)
