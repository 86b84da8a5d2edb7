"""Plan under each human model of the ladder: naive, IDM, turn and theory of mind.

A `HumanModel` predicts one human, in the game of the robot with that human alone (`ms_highway.game.game.pair`);
`ms_highway.planning.several` plans among several. Predictions are in SI units; plans, and what they start from, are
scaled, see `ms_highway.game.game`.

A model has an effort: the number of its steps, and the plan that they start from. Names are ``tom@8``, theory of mind
in 8 ascent steps, ``tom+warm``, from the rest of the last plan, and ``tom@8+warm``.
"""

import re
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from math import inf
from typing import Any, ClassVar
from warnings import warn

import jax
import numpy as np
from jax import numpy as jnp

from ms_highway.game.dynamics import keep_velocity, step
from ms_highway.game.game import Game, bounded, pair, swap_players
from ms_highway.game.planning_settings import MOST_ITERATIONS, SHARE, longest_traced_step
from ms_highway.geometry.bodies import nearest_ahead
from ms_highway.planning.car_following import FAR, idm_acceleration
from ms_highway.planning.joint import Interaction, joint_ascent
from ms_highway.planning.plans import Plan, cold_start, plan_against
from ms_highway.runtime.arrays import Car, Control, Controls, State

HEADWAY, STANDSTILL = 0.1, 1.0  # s and m between bumpers: 3 m at 20 m/s, as in the streams of Dense Merge

NAME = re.compile(r"(?P<model>[^@+]+)(@(?P<steps>[1-9][0-9]{0,8}))?(?P<warm>\+warm)?")
LENGTH = 0.1  # of a counted step; at the paper's horizon, some plans overshoot and collide from 0.15 on

BEST = "best"
"""Name of `BEST_LADDER` in configurations and commands."""

BEST_LADDER = ("naive@4+warm", "tom@6+warm", "tom@12+warm")
"""Ladder of the rungs that earn most for their time.

Reward per step of each rung alone in Merger and Give Way, measured with 30 starts, the learned human and paper
semantics: 4.67 and -0.04 at 5 % of tom's T, 6.40 and 5.27 at 30 %, 6.52 and 5.77 at 60 %; tom earns 6.25 and 5.02,
turn 1.51 and 0.09 at 46 %, naive 1.50 and 0.03 at 24 %. In Stay Back, where outcomes are chaotic, the upper two are not
worth their time: 0.98, 0.14 and -2.99, where naive earns 0.60, turn 1.50, tom 1.65, and naive@10 most, 1.90.
"""


@dataclass(frozen=True)
class HumanModel:
    """A rung of the ladder, which predicts one human; hashable, as a plan is compiled once per model.

    Steps that are counted are gradient steps, whatever the planner's solver and step size, and as long as is safe: 0.1,
    or `ms_highway.game.planning_settings.SHARE` of the longest where that is shorter, as it is from K = 6 on at 0.1 s.
    What a plan earns depends on the length of all its steps together: 6 of them earn what the paper's 20 of 0.03 earn,
    and more of them earn more. Under the solver ``convex_newton``, its own steps are counted. Among several humans, see
    `ms_highway.planning.several.most_steps`.

    Attributes:
        name: in configurations and reports, with the effort; of a class, without.
        responds: whether the human responds to the robot's plan; among several humans, as under theory of mind.
        steps: number of steps of each ascent; None for what the planner does.
        warm: whether plans start from the rest of the last plan, by whichever model, rather than from a cold start.
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
        longest = longest_traced_step(game.planner.horizon, game.dynamics.time_step)
        length = jnp.minimum(LENGTH, SHARE * longest)
        planner = replace(game.planner, iterations=self.steps, step_size=length, solver="gradient")
        return replace(game, planner=planner)

    def seconds(self, costs: Mapping[str, float], usual: int) -> float | None:
        """Return T(M) [s]; None where it does not follow from the costs.

        It is what the costs say for the model's name, or else for its name without ``+warm``, as a start costs nothing;
        or else it is proportional to the number of steps.

        Args:
            costs: T(M) by name [s].
            usual: number of steps of the model without an effort.
        """
        cold, base = costs.get(self.name.removesuffix("+warm")), costs.get(type(self).name)
        if self.name in costs or cold is not None:
            return costs.get(self.name, cold)
        return None if base is None or self.steps is None else base * self.steps / usual

    def predict(self, game: Game, state: State, start: Plan | None = None) -> Controls:
        """Predict the human's controls over the horizon, in SI units and traced by JAX.

        Under a control (omega, a), the speed v changes by ``v' = a - friction v`` and the heading by ``v omega``; so
        `ms_highway.game.dynamics.keep_velocity` plus (0, -4) brakes by 4 m/s^2. What the limits of plans cut off is
        cut off in the plan, too, and warned of if it is at the start of an episode.

        Args:
            game: of the robot and this human; ``game.planner.horizon`` steps of ``game.dynamics.time_step`` seconds.
            state: x, y [m], heading [rad] and speed [m/s] of the robot, the human and all other cars, [cars, 4].
            start: scaled plan that the robot's starts from; None for a cold start.

        Returns:
            Curvature omega [1/m] and acceleration a before friction [m/s^2] in each step, [horizon, 2].
        """
        raise NotImplementedError

    def plan(self, game: Game, state: State, start: Plan | None = None) -> Plan:
        """Plan against this model of the human, improving ``start``, by default `ms_highway.planning.plans.cold_start`.

        Whoever executes the plan limits it, see `ms_highway.planning.several.plan_for`.
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
    """The human follows the car ahead in its lane by the Intelligent Driver Model, at most at the speed limit.

    It follows the robot, too, where that is ahead of it; all others keep their velocity.
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
    gap = jnp.where(leads, offset[leader, 0] - jnp.asarray(scene.car_size)[0], FAR)
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

    Under the planner's solvers ``gradient`` and ``newton``, plans take gradient steps: a joint ascent has no single
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


MODELS: dict[str, HumanModel] = {model.name: model for model in (Naive(), IntelligentDriver(), Turn(), TheoryOfMind())}
"""Known models by name, cheapest first."""

PACKAGE_MODELS = tuple(MODELS)
"""Names of the package's models, cheapest first: the only enumeration, for pairs, several humans and roads."""

_PACKAGE_TYPES = tuple(map(type, MODELS.values()))

PAPER_MODELS = ("naive", "turn", "tom")
"""Names of the paper's models, cheapest first."""

RESERVED = (*PACKAGE_MODELS, BEST)


def is_of_package(model: HumanModel) -> bool:
    """Return whether a model is the package's own, whose controls keep to the limits of plans by themselves."""
    return type(model) in _PACKAGE_TYPES


def scaled_prediction(model: HumanModel, game: Game, state: State, start: Plan | None = None) -> Controls:
    """Return a model's prediction, scaled, as plans take it: a registered model's within the limits of plans.

    Raises:
        ValueError: if a registered model does not predict [horizon, 2] numbers.
    """
    return _scaled_within_limits(model, game, state[1], model.predict(game, state, start))


def _scaled_within_limits(model: HumanModel, game: Game, human: Car, controls: Controls) -> Controls:
    """Scale predicted controls of a human; limit those of a registered model, see `scaled_prediction`."""
    if is_of_package(model):
        return controls / game.planner.control_scale
    scaled = _checked(model, game, controls) / game.planner.control_scale
    return jnp.where(jnp.isfinite(scaled), bounded(game, human, scaled), scaled)


def _checked(model: HumanModel, game: Game, controls: Any) -> jax.Array:
    """Return what a registered model predicts, [horizon, 2] numbers, as an array.

    Raises:
        ValueError: naming model, value and remedy, for anything else.
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
    """Warn of registered models whose prediction of the first human, at a start, is cut by limits or not finite."""
    for model in ladder:
        if is_of_package(model) or model.responds:
            continue
        own, cars = pair(model.within(game), jnp.asarray(state), 0)
        predicted = np.asarray(_checked(model, own, model.predict(own, cars)))
        kept = np.asarray(_scaled_within_limits(model, own, cars[1], predicted) * game.planner.control_scale)
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


def register(model: HumanModel, before: str | None = None) -> None:
    """Register a human model by its name, for configurations and commands of this process.

    Args:
        model: hashable; replaces a model of the same name.
        before: name of the next more expensive model on ladders; by default, the new model is the most expensive.

    Raises:
        ValueError: if the name is one of the package's models or no word, or ``before`` names no other model; if the
            model is no `HumanModel`, or not hashable.
    """
    if not isinstance(model, HumanModel) or getattr(type(model), "name", None) != model.name:
        remedy = "make it a frozen dataclass derived from ms_highway.HumanModel, whose class has a name"
        raise ValueError(f"{model!r} is no model; {remedy}")
    predicts = type(model).predict is not HumanModel.predict
    if not predicts if isinstance(model, PredictedHuman) else type(model).plan is HumanModel.plan:
        remedy = "derive it from ms_highway.PredictedHuman and define `predict`, or define `plan`"
        raise ValueError(f"human model {model.name!r} neither predicts nor plans; {remedy}")
    try:
        hash(model)
    except TypeError as error:
        raise ValueError(f"{model!r} cannot be compiled for: {error}; make it a frozen dataclass") from None
    if not isinstance(model.name, str) or not model.name.isidentifier() or model.name in RESERVED:
        raise ValueError(f"a model cannot be called {model.name!r}; choose one word other than {', '.join(RESERVED)}")
    others = {name: other for name, other in MODELS.items() if name != model.name}
    if before is not None and before not in others:
        raise ValueError(f"unknown human model {before!r} to come before; the models are {', '.join(others)}")
    place = len(others) if before is None else list(others).index(before)
    known = list(others.items())
    MODELS.clear()  # and not replaced: others hold it
    MODELS.update([*known[:place], (model.name, model), *known[place:]])


def human_model(name: str) -> HumanModel:
    """Return the model of a name, with its effort if the name has one, such as ``tom@8+warm``.

    Raises:
        ValueError: if it is no model's name.
    """
    parts = NAME.fullmatch(name) if isinstance(name, str) else None
    steps = int(parts["steps"] or 0) if parts else 0
    if parts is None or parts["model"] not in MODELS or steps > MOST_ITERATIONS:
        raise ValueError(f"unknown human model {name!r}; the models are {model_names()}")
    model = MODELS[parts["model"]]
    return replace(model, steps=steps or None, warm=bool(parts["warm"]))


def is_model(name: object) -> bool:
    """Return whether a value is the name of a human model, with or without an effort."""
    try:
        return bool(human_model(name))  # type: ignore[arg-type]
    except ValueError:
        return False


def model_names() -> str:
    """Return the names of all models, for messages."""
    return f"{', '.join(MODELS)}, also in 1 to {MOST_ITERATIONS} steps (tom@8) or from the last plan (tom@8+warm)"


def known_models(used: Iterable[str] = ()) -> list[str]:
    """Return the names of all known models and of the models in use, whose names may have an effort, cheapest first."""
    return sorted({*MODELS, *filter(is_model, used)}, key=lambda name: _rank(human_model(name)))


def cheapest_first(used: Iterable[str]) -> list[str]:
    """Return the names of the models in use, each once; those that are not registered count as the most expensive."""
    used = {name for name in used if name}
    known = [name for name in known_models(used) if name in used]
    return known + sorted(used - {*known})


def _rank(model: HumanModel) -> tuple[int, float, bool]:
    """Return the place of a model among all: of its base, then of its number of steps, the planner's own last."""
    return list(MODELS).index(type(model).name), model.steps or inf, model.warm


def rung_names(names: Sequence[str]) -> list[str]:
    """Return the names of a ladder's rungs, which ``best`` stands for as well."""
    return list(BEST_LADDER if names == BEST or list(names) == [BEST] else names)


def ladder(names: Sequence[str]) -> tuple[HumanModel, ...]:
    """Return the models of these names, or of `BEST_LADDER` by its name, ``best``.

    The order is that of the models, whatever their efforts, and of the numbers of steps of the same model, the
    planner's own last: costs, which differ between machines, do not matter.

    Raises:
        ValueError: unless all are known, and each is named once, cheapest first; if there is none.
    """
    rungs = tuple(human_model(name) for name in rung_names(names))
    ranks = [_rank(rung) for rung in rungs]
    if not ranks or ranks != sorted(set(ranks)):
        order = f"out of {list(MODELS)}, and of the same model fewer steps first"
        raise ValueError(f"impossible ladder {list(names)}: name each model once, cheapest first, {order}")
    return rungs
