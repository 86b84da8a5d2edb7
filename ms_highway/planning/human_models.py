"""Plan under each human model of the ladder: naive, IDM, turn and theory of mind.

A `HumanModel` predicts one human, in the game of the robot with that human alone (`ms_highway.game.game.pair`);
`ms_highway.planning.compiled_plans` plans among several. Predictions are in SI units; plans and their starts are
scaled, see `ms_highway.game.game`.

A model has an effort: its number of steps, and the plan from which they start. ``tom@8`` is theory of mind in 8 ascent
steps, ``tom+warm`` starts from the rest of the last plan, and ``tom@8+warm`` does both.
"""

from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar
from warnings import warn

import jax
import numpy as np
from jax import numpy as jnp

from ms_highway.game.dynamics import keep_velocity, step
from ms_highway.game.game import Game, bounded, pair, swap_players
from ms_highway.geometry.bodies import nearest_ahead
from ms_highway.numerics.solvers import STEP_SHARE, longest_step
from ms_highway.planning.joint import Interaction, joint_ascent
from ms_highway.planning.manoeuvres import FREE_GAP, idm_acceleration
from ms_highway.planning.plans import Plan, cold_start, plan_against
from ms_highway.runtime.arrays import Car, Control, Controls, State, naming_writes, read_only

HEADWAY, STANDSTILL = 0.1, 1.0  # s and m between bumpers: 3 m at 20 m/s, as in the streams of Dense Merge

STEP_SIZE = 0.1  # of a counted step; at the paper's horizon, some plans overshoot and collide from 0.15 on


@dataclass(frozen=True)
class HumanModel:
    """A rung of the ladder, which predicts one human; hashable, as a plan is compiled once per model.

    With a number of steps, a model takes gradient steps, whatever the planner's solver and step size. They are as long
    as is safe: 0.1 or, if that is shorter, `ms_highway.numerics.solvers.STEP_SHARE` of the longest step, as from
    K = 6 on at 0.1 s. The reward of a plan depends on the summed length of its steps: 6 of them earn as much as the
    paper's 20 of 0.03, and more of them earn more. The solver ``convex_newton`` takes so many of its own steps.
    Among several humans, see `ms_highway.planning.compiled_plans.most_steps`.

    Attributes:
        name: in configurations and reports, with the effort; that of the class is without.
        responds: whether the human responds to the robot's plan; among several humans, as under theory of mind.
        steps: number of steps of each ascent; None for the planner's.
        warm: whether plans start from the rest of the last plan, of any model, instead of a cold start.
    """

    name: ClassVar[str]
    responds: ClassVar[bool] = False
    steps: int | None = field(default=None, kw_only=True)
    warm: bool = field(default=False, kw_only=True)

    def __post_init__(self) -> None:
        """Add the effort to the name."""
        effort = (f"@{self.steps}" if self.steps else "") + "+warm" * self.warm
        if effort:
            object.__setattr__(self, "name", type(self).name + effort)

    def within(self, game: Game) -> Game:
        """Return the game for plans in this effort."""
        if self.steps is None:
            return game
        if game.planner.solver == "convex_newton":
            return replace(game, planner=replace(game.planner, newton_steps=self.steps, joint_steps=self.steps))
        longest = longest_step(game.planner.horizon, game.dynamics.time_step)
        length = jnp.minimum(STEP_SIZE, STEP_SHARE * longest)
        planner = replace(game.planner, iterations=self.steps, step_size=length, solver="gradient")
        return replace(game, planner=planner)

    def seconds(self, costs: Mapping[str, float], usual: int) -> float | None:
        """Return T(M) [s]; None where it does not follow from the costs.

        It is the cost of the model's name, or else of the name without ``+warm``, as a start costs nothing, or else it
        is proportional to the number of steps.

        Args:
            costs: T(M) by name [s].
            usual: number of steps of the model without an effort.
        """
        for name in (self.name, self.name.removesuffix("+warm")):
            if name in costs:
                return costs[name]
        base = costs.get(type(self).name)
        return None if base is None or self.steps is None else base * self.steps / usual

    def predict(self, game: Game, state: State, start: Plan | None = None) -> Controls:
        """Predict the human's controls over the horizon, in SI units and traced by JAX.

        Under a control (omega, a), the speed v changes by ``v' = a - friction v`` and the heading by ``v omega``; so
        `ms_highway.game.dynamics.keep_velocity` plus (0, -4) brakes by 4 m/s^2. Plans cut predictions to their limits,
        with a warning if they do so at the start of an episode.

        Args:
            game: of the robot and this human; ``game.planner.horizon`` steps of ``game.dynamics.time_step`` seconds.
            state: x, y [m], heading [rad] and speed [m/s] of the robot, the human and all other cars, [cars, 4].
            start: scaled plan that the robot's starts from; None for a cold start.

        Returns:
            Curvature omega [1/m] and acceleration a before friction [m/s^2] of each step, [horizon, 2].
        """
        raise NotImplementedError

    def plan(self, game: Game, state: State, start: Plan | None = None) -> Plan:
        """Plan against this model of the human, improving ``start``, by default `ms_highway.planning.plans.cold_start`.

        The plan need not keep to the limits, see `ms_highway.planning.compiled_plans.plan_for`.
        """
        raise NotImplementedError


@dataclass(frozen=True)
class PredictedHuman(HumanModel):
    """Base of models that predict the human whatever the robot plans; the robot optimises against the prediction."""

    def plan(self, game: Game, state: State, start: Plan | None = None) -> Plan:
        """Optimise the robot's controls against the prediction."""
        return plan_against(game, state, scaled_prediction(self, game, state, start)[None], start)


@dataclass(frozen=True)
class Naive(PredictedHuman):
    """The human keeps its velocity."""

    name: ClassVar[str] = "naive"

    def predict(self, game: Game, state: State, start: Plan | None = None) -> Controls:
        """Return the controls that keep the human's speed and heading."""
        control = keep_velocity(game.dynamics, state[1])
        return control.__array_namespace__().tile(control, (game.planner.horizon, 1))


@dataclass(frozen=True)
class IntelligentDriver(PredictedHuman):
    """The human follows the car ahead in its lane, such as the robot, by the Intelligent Driver Model.

    Its desired speed is the speed limit. All others keep their velocity.
    """

    name: ClassVar[str] = "idm"

    def predict(self, game: Game, state: State, start: Plan | None = None) -> Controls:
        """Return the controls of a human that keeps its heading and follows."""

        def follow(state: State, _: None) -> tuple[State, Control]:
            control = following_control(game, state)
            kept = keep_velocity(game.dynamics, state)
            return step(game.dynamics, state, kept.at[1].set(control)), control

        return jax.lax.scan(follow, jnp.asarray(state), None, game.planner.horizon)[1]


def following_control(game: Game, state: State) -> Control:
    """Return the control, not scaled, of car 1 if it follows the car ahead by the Intelligent Driver Model."""
    scene, own, others = game.scene, state[1], jnp.concatenate([state[:1], state[2:]])
    offset = others[:, :2] - own[:2]
    leader, leads = nearest_ahead(offset[:, 0], jnp.abs(offset[:, 1]) < jnp.asarray(scene.lane_width) / 2)
    gap = jnp.where(leads, offset[leader, 0] - jnp.asarray(scene.car_size)[0], FREE_GAP)
    limit = jnp.asarray(game.humans.speed_limit)
    change = idm_acceleration(own[3], limit, gap, others[leader, 3], HEADWAY, STANDSTILL)
    return keep_velocity(game.dynamics, own).at[1].add(change)


@dataclass(frozen=True)
class Turn(PredictedHuman):
    """The human optimises its own reward against a robot that keeps its velocity, whatever the robot plans."""

    name: ClassVar[str] = "turn"

    def predict(self, game: Game, state: State, start: Plan | None = None) -> Controls:
        """Return the human's plan against a robot that keeps its velocity."""
        mirrored = start and Plan(start.humans[0], start.robot[None])
        return Naive().plan(*swap_players(game, state), mirrored).robot * game.planner.control_scale


@dataclass(frozen=True)
class TheoryOfMind(HumanModel):
    """The human responds optimally to the robot's plan, and the robot anticipates it, see `ms_highway.planning.joint`.

    Under the planner's solvers ``gradient`` and ``newton``, plans take gradient steps, as a joint ascent has no single
    objective for a line search.
    """

    name: ClassVar[str] = "tom"
    responds: ClassVar[bool] = True

    def predict(self, game: Game, state: State, start: Plan | None = None) -> Controls:
        """Return the human's side of the joint plan."""
        return self.plan(game, state, start).humans[0] * game.planner.control_scale

    def plan(self, game: Game, state: State, start: Plan | None = None) -> Plan:
        """Improve the robot's and the human's controls by a joint ascent."""
        return joint_ascent(Interaction(game, state), cold_start(game, state) if start is None else start)


PACKAGE_TYPES = (Naive, IntelligentDriver, Turn, TheoryOfMind)
"""The package's models, cheapest first."""


def is_of_package(model: HumanModel) -> bool:
    """Return whether a model is the package's own; the controls of these keep to the limits of plans by themselves."""
    return type(model) in PACKAGE_TYPES


def scaled_prediction(model: HumanModel, game: Game, state: State, start: Plan | None = None) -> Controls:
    """Return a model's prediction, scaled; a registered model's is cut to the limits of plans.

    Raises:
        ValueError: if a registered model does not predict [horizon, 2] numbers.
    """
    controls = model.predict(game, state, start)
    if is_of_package(model):
        return controls / game.planner.control_scale
    return _scaled_within_limits(game, state[1], _checked(model, game, controls))


def _scaled_within_limits(game: Game, human: Car, controls: Controls) -> Controls:
    """Scale predicted controls of a human, and cut finite ones to the limits of plans."""
    scaled = controls / game.planner.control_scale
    return jnp.where(jnp.isfinite(scaled), bounded(game, human, scaled), scaled)


def _checked(model: HumanModel, game: Game, controls: Any) -> jax.Array:
    """Return the prediction of a registered model as an array [horizon, 2].

    Raises:
        ValueError: if it is anything else.
    """
    wanted, found = (game.planner.horizon, 2), repr(controls)
    with suppress(TypeError, ValueError):
        array = jnp.asarray(controls)
        if array.shape == wanted and jnp.isdtype(array.dtype, ("integral", "real floating")):
            return array
        found = f"an array of shape {array.shape} and type {array.dtype}"
    remedy = f"predict numbers {wanted}: curvature [1/m] and acceleration [m/s^2] in every step of the horizon"
    raise ValueError(f"human model {model.name!r} predicts {found}; {remedy}")


def warn_of_limits(ladder: Iterable[HumanModel], game: Game, state: State) -> None:
    """Warn of registered models whose prediction of the first human is cut by limits, or not finite, in a start."""
    for model in ladder:
        if is_of_package(model) or model.responds:
            continue
        own, cars = pair(read_only(model.within(game)), jnp.asarray(state), 0)
        with naming_writes(f"the human model {model.name!r}"):
            predicted = np.asarray(_checked(model, own, model.predict(own, cars)))
        kept = np.asarray(_scaled_within_limits(own, cars[1], predicted) * game.planner.control_scale)
        finite = np.isfinite(predicted)
        cut = np.argwhere(~finite | (np.abs(predicted - kept) > 1e-3 * np.abs(predicted)))
        if len(cut):
            place = tuple(cut[0])
            what = ("a curvature of {:.3g} 1/m", "an acceleration of {:.3g} m/s^2")[place[1]].format(predicted[place])
            effect = "so that no plan follows"
            if finite[place]:
                effect = f"which the limits of plans cut to {kept[place]:.3g}"
            remedy = "predictions are in SI units, see ms_highway.HumanModel.predict"
            warn(f"human model {model.name!r} predicts {what}, {effect}; {remedy}", stacklevel=2)
