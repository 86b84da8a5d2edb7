"""Read the configuration of an `ms_highway.envs.base.InteractionEnv`."""

from collections.abc import Iterable, Mapping
from typing import Annotated, Any, Literal, TypeAlias, get_args
from warnings import warn

import numpy as np
from msgspec import Meta, Struct
from msgspec.structs import force_setattr

from ms_highway.choice.rule import Start
from ms_highway.choice.shipped import PUBLISHED_COSTS, SHIPPED_COSTS, shipped_kind
from ms_highway.data.learned_reward import shipped
from ms_highway.envs.configuration import refuse_unknown
from ms_highway.envs.controllers import ControllerSettings
from ms_highway.envs.keyboard import Keyboard
from ms_highway.envs.registry import controller_settings
from ms_highway.game.game import Game
from ms_highway.game.reward import weight_names
from ms_highway.game.scenario import (
    COMMON_WEIGHTS,
    Scenario,
    Semantics,
    build_game,
)
from ms_highway.loop.controller import HUMAN_DRIVERS
from ms_highway.numerics.convex_newton import NEWTON_STEPS
from ms_highway.numerics.solvers import (
    GRADIENT_STEPS,
    PlanningSettings,
    SolverName,
    gradient_steps,
    longest_step,
)
from ms_highway.planning.costs import Costs
from ms_highway.planning.human_models import HumanModel
from ms_highway.planning.ladders import MODELS, human_model, is_model, ladder
from ms_highway.runtime.limits import NotNegative, Number, Positive

HUMAN_REWARDS = {"paper": "learned", "physical": "learned", "released": "published"}
"""The default of the humans' reward, by semantics."""

NamedReward: TypeAlias = Literal["learned", "published", "us101"]
"""Names of the humans' rewards, see `human_weights`."""

NAMED_REWARDS: tuple[str, ...] = get_args(NamedReward)

YIELDING_DRIVERS = {
    "usual": (),
    "never": ("never",),
    "always": ("always",),
    "mixed": ("never", "always"),
}
"""The human drivers for each way to yield."""


def _whole_number(most: int) -> Meta:
    """Return the limits of a whole number."""
    remedy = f"it must be a whole number from 1 to {most}"
    return Meta(ge=1, le=most, description=remedy)


class Settings(Struct, frozen=True):
    """The keys of `ms_highway.InteractionEnv` that highway-env does not have.

    The text behind each key is its row in ``notebooks/REFERENCE.md``. A default that is
    not named there is the scenario's.
    """

    controller: Any
    """What chooses a model for every human in every step.

    ``{"type": "learned", "lambda": 1.0}`` (default) chooses by a learned value of
    computation, from naive, turn and tom; its ``"values"`` are ``"shipped"`` or a file
    of ``ms-highway values learn``. ``{"type": "switching", "lambda": 0.1, "cooldown":
    3, "trust_radius": 1.5}`` chooses by the paper's Algorithm 1
    (`ms_highway.choice.quadratic.Quadratic`). ``{"type": "budget", "milliseconds":
    20}`` chooses what gains most within this time. ``{"type": "nearest", "count": 2}``
    predicts the nearest humans by the top of the ladder. ``{"type": "fixed", "model":
    "tom"}`` always takes the same model. ``{"type": "schedule", "models": ["tom",
    "tom", "naive"]}`` takes a model per step and keeps the last one. ``{"type":
    "random", "shares": {"naive": 0.7, "tom": 0.3}}`` draws them when the episode
    starts.

    A short name stands for each, such as ``"tom"`` or ``"learned:1"``, see
    `ms_highway.envs.registry.controller_config`. With ``"belief": True``, any of them
    infers from each human's behaviour which model predicts that human
    (`ms_highway.choice.belief`), and counts on no response that the human does not
    show.
    """

    ladder: Annotated[
        Literal["best"] | tuple[str, ...],
        Meta(
            description=("give a list of human models, cheapest first, or say 'best'")
        ),
    ]
    """Names of human models, cheapest first, or ``"best"``
    (`ms_highway.planning.ladders`).
    """

    costs: Annotated[
        Literal["published", "shipped", "measured"] | dict[str, NotNegative],
        Meta(
            description=(
                "say 'published', 'shipped', 'measured', or give seconds by model, such"
                " as {'naive': 0.09, 'turn': 0.17, 'tom': 0.37}"
            )
        ),
    ]
    """T(M), the seconds that count for a plan under model M: ``"published"``, the
    paper's (default with one human); ``"shipped"``, measured on one core (default with
    several humans, and in physical scenarios); ``"measured"``, on this machine in the
    first step; or seconds by model, of which ``tom@8`` takes its share.

    Among several humans, T(M) is of a plan that predicts one human by M and the others
    by the first rung, and T is additive. With ``"shipped"``, budgets choose by measured
    times, so that episodes of one seed may differ.
    """

    semantics: Semantics
    """``"paper"``, the paper's dynamics; ``"physical"``, the same within what tyres
    hold, where a collision is an overlap of bodies (`ms_highway.game.contact`) instead
    of the paper's indicator; or ``"released"``, the paper's released code; see
    `ms_highway.game.scenario.build_game`.
    """

    human_reward: Annotated[
        NamedReward | dict[str, Number] | None,
        Meta(
            description=(
                "say 'learned', 'published', 'us101', or give finite weights by name,"
                " such as {'speed': 2, 'lane_alignment': 75}; weights that were learned"
                " are in ms_highway.data.learned_reward.load(path).weights"
            )
        ),
    ]
    """What humans drive for, in the world and in the robot's models of them:
    ``"learned"`` from demonstrations; ``"published"``; ``"us101"``, learned from
    drivers on that highway; weights by name, of
    `ms_highway.game.reward.weight_names`; or None for the reward of the semantics:
    published in released semantics, or else learned.

    Aims of the scenario, such as a human's target lane, stay unless weights name them.
    A learned reward has no weight of ``collision``, and that of the highway none of
    leaving the road.
    """

    humans: Annotated[int, Meta(description="it must be a whole number")]
    """Number of humans, from 2 to 20 in scenarios with streams."""

    yielding: Literal["usual", "never", "always", "mixed"]
    """What humans do beside the robot: ``"usual"``, plan for their reward; ``"never"``,
    keep their velocity and never yield; ``"always"``, make room for the robot
    (`ms_highway.loop.yielding`); or ``"mixed"``, one of the last two, drawn for each
    human when the episode starts.
    """

    human_driver: str | None
    """What drives the humans instead of plans for their reward: a name of
    `ms_highway.add_driver`, or ``"keyboard"``: the arrow keys drive the first human, in
    a window (``render_mode="human"``).
    """

    way_out: bool
    """Whether the robot keeps a way out from humans who do not yield, see
    `ms_highway.planning.way_out`.
    """

    control_limit: Annotated[
        Literal["unlimited"] | tuple[Positive, Positive] | None,
        Meta(
            description=(
                "give None for the usual limits, 'unlimited', or two positive bounds,"
                " (omega, acceleration)"
            )
        ),
    ]
    """Bounds on curvature [1/m] and acceleration [m/s^2] of plans; ``"unlimited"``; or
    None for the scenario's bounds, in released semantics for no bounds.
    """

    grip: Annotated[
        Positive | None,
        Meta(
            description=(
                "give what tyres hold in m/s^2, such as 8 on a dry road, or None for no"
                " limit"
            )
        ),
    ]
    """Total acceleration that tyres hold, across and along [m/s^2], such as
    `ms_highway.game.scenario.GRIP`.

    It limits plans and executed controls, without reversing. None sets no limit, as in
    the paper, but stands for ``GRIP`` in physical semantics. It does not apply where
    the agent drives.
    """

    solver: SolverName
    """How plans are improved: ``"gradient"``, the paper's steps; or
    ``"convex_newton"``, for horizons of seconds, on a smooth reward with room to stop
    (`ms_highway.game.payoff.stopping_cost`) and, in physical semantics, with room
    between bodies.
    """

    horizon: Annotated[int, _whole_number(100)]
    """Number of planned controls, of robot and humans."""

    time_step: Annotated[
        float, Meta(ge=0.01, le=1.0, description="it must be from 0.01 to 1 s")
    ]
    """Duration of a step of plans and of the environment [s]."""

    iterations: Annotated[
        Annotated[int, Meta(ge=1, le=GRADIENT_STEPS.max_number)] | None,
        Meta(
            description=(
                f"it must be a whole number from 1 to {GRADIENT_STEPS.max_number}, or"
                " None"
            )
        ),
    ]
    """Number of gradient steps of a plan; None for what suits the horizon."""

    step_size: Annotated[
        Positive | None, Meta(description="it must be a positive number, or None")
    ]
    """Length of a gradient step per unit of gradient; None for what suits the horizon;
    a longer one gives a warning. See `ms_highway.numerics.solvers.PlanningSettings`.
    """

    duration: Positive
    """Length of an episode [s]."""

    terminate_on_collision: bool
    """Whether a collision ends the episode."""

    def __post_init__(self) -> None:
        # Copies already have what the configuration is read into.
        if not isinstance(self.controller, ControllerSettings):
            force_setattr(self, "controller", controller_settings(self.controller))
        self._check_planning()
        self._check_humans()
        self._check_costs()

    def _check_planning(self) -> None:
        """Refuse plans that take seconds, and episodes without a step.

        Raises:
            ValueError: for such plans or episodes.
        """
        horizon = self.horizon
        time_step = self.time_step
        chosen = gradient_steps(self.planning)[0]
        if chosen > GRADIENT_STEPS.max_number:
            why = (
                f"{horizon} steps of {time_step:g} s need {chosen} gradient steps,"
                " which take seconds"
            )
            raise ValueError(
                f"config['horizon'] is {horizon}: {why}; plan less far ahead, or give"
                " 'iterations'"
            )
        if self.duration < time_step:
            why = f"an episode has at least one time step of {time_step:g} s"
            raise ValueError(f"config['duration'] is {self.duration!r}; {why}")

    def _check_humans(self) -> None:
        """Refuse unknown drivers of humans, and unknown weights.

        Also refuse yielding where another driver decides it.

        Raises:
            ValueError: for such drivers, weights or yielding.
        """
        name = self.human_driver
        added = [each for each in HUMAN_DRIVERS if each not in YIELDING_DRIVERS]
        known = [*added, Keyboard.name]
        if name is not None and name not in known:
            remedy = (
                f"add it with ms_highway.add_driver, or name one of {', '.join(known)}"
            )
            raise ValueError(f"config['human_driver'] is {name!r}; {remedy}")
        if name is not None and self.yielding != "usual":
            why = f"humans who are driven by {name!r} cannot be told how to yield"
            raise ValueError(f"config['yielding'] is {self.yielding!r}; {why}")
        if isinstance(self.human_reward, dict):
            refuse_unknown("config['human_reward']", self.human_reward, weight_names())

    def _check_costs(self) -> None:
        """Refuse costs of unknown models, and models of the ladder without costs.

        Raises:
            ValueError: naming the models.
        """
        if isinstance(self.costs, dict):
            named = {name for name in self.costs if is_model(name)}
            refuse_unknown("config['costs']", self.costs, {*MODELS, *named})
        unknown = {model.name for model in self.models} - {*self.counted.names}
        if unknown and self.costs != "measured":
            why = (
                f"without seconds for {', '.join(sorted(unknown))}; say 'measured' or"
                " give them"
            )
            raise ValueError(f"config['costs'] is {self.costs!r}, {why}")

    def check(self, scenario: Scenario) -> None:
        """Check the number of humans against the scenario.

        Also warn of gradient steps that overshoot.

        Raises:
            ValueError: for an impossible number of humans.
        """
        fewest, most = scenario.humans_with_streams if scenario.streams else (1, 1)
        if not fewest <= self.humans <= most:
            remedy = (
                f"{scenario.name} has one human; leave it out, or take a scenario of"
                " many, such as dense-merge-v1"
            )
            if scenario.streams:
                remedy = (
                    f"it must be a whole number from {fewest} to {most} in"
                    f" {scenario.name}"
                )
            raise ValueError(f"config['humans'] is {self.humans}; {remedy}")
        longest = longest_step(self.horizon, self.time_step)
        if self.step_size is not None and self.step_size > longest:
            plans = f"plans of {self.horizon} steps of {self.time_step:g} s"
            why = (
                f"{plans} overshoot with steps longer than {longest:.2g}; leave it out"
                " to have one chosen"
            )
            warn(f"config['step_size'] is {self.step_size:g}: {why}", stacklevel=2)

    @property
    def reward(self) -> str | dict[str, float]:
        """The humans' reward: one of `NAMED_REWARDS`, or weights by name."""
        if self.human_reward is None:
            return HUMAN_REWARDS[self.semantics]
        return self.human_reward

    @property
    def planning(self) -> PlanningSettings:
        """Horizon, time step and gradient steps of the plans of robot and humans."""
        return PlanningSettings(
            self.horizon, self.time_step, self.iterations, self.step_size
        )

    @property
    def drivers(self) -> tuple[str, ...]:
        """Names of the human drivers in use, keys of `HUMAN_DRIVERS`.

        There are none if all humans plan for their reward.
        """
        if self.human_driver is None:
            return YIELDING_DRIVERS[self.yielding]
        return (self.human_driver,)

    @property
    def models(self) -> tuple[HumanModel, ...]:
        """The ladder; see `ms_highway.planning.ladders.ladder`."""
        return ladder(self.ladder)

    @property
    def counted(self) -> Costs:
        """T(M) of the models of ladder and order, as far as it is known.

        See `costs_of`.
        """
        order = map(human_model, self.controller.names())
        return self.costs_of((*self.models, *order))

    def costs_of(self, models: Iterable[HumanModel]) -> Costs:
        """Return T(M) of models, the ladder's first.

        Models whose seconds are given are added. Models are left out where T is
        unknown: all of them if it is to be measured.
        """
        base: Mapping[str, float] = {}
        if isinstance(self.costs, dict):
            base = self.costs
        elif self.costs == "published":
            base = PUBLISHED_COSTS
        elif self.costs == "shipped":
            base = SHIPPED_COSTS[shipped_kind(self.semantics, self.humans)]

        # A model with fewer steps takes its share of the seconds.
        known: dict[str, float] = {}
        for model in models:
            steps = NEWTON_STEPS.steps
            if model.responds:
                steps = NEWTON_STEPS.joint_steps
            if self.solver != "convex_newton":
                steps = gradient_steps(self.planning)[0]
            seconds = model.seconds(base, steps)
            if seconds is not None:
                known[model.name] = seconds
        return Costs.of({**known, **base}, self.humans)

    def start(
        self,
        steps: int,
        random: np.random.Generator,
        costs: Costs | None = None,
    ) -> Start:
        """Return what a rule is built from.

        Args:
            steps: number of steps of the episode.
            random: source of the draws.
            costs: by which the rule chooses; by default, `counted`.
        """
        costs = self.counted if costs is None else costs
        ladder = self.models
        known = costs.select(model.name for model in ladder)
        return Start(ladder, known, self.semantics, self.humans, steps, random)

    @property
    def measures(self) -> bool:
        """Whether rules choose by measured planning times.

        A seed may then give different episodes.
        """
        keeps_budget = self.controller.budget is not None
        return self.costs == "measured" or (self.costs == "shipped" and keeps_budget)

    def game(self, scenario: Scenario) -> Game:
        """Build the game of a scenario.

        Every human has the reward that the drawn ones vary around.
        """
        limit = self.control_limit
        if limit is None and self.semantics != "released":
            limit = scenario.control_limit
        return build_game(
            scenario,
            self.semantics,
            None if limit == "unlimited" else limit,
            self.grip,
            solver=self.solver,
            human_driving=human_weights(self.reward),
            planning=self.planning,
            humans=self.humans,
        )


def human_weights(reward: str | dict[str, float]) -> Mapping[str, float]:
    """Return the weights of a humans' reward, by name.

    ``learned`` has weights that were learned from simulated demonstrations,
    ``published`` the paper's. ``us101`` has those that `ms-highway irl fit` learned
    from drivers on the US-101, without weights of collisions and of leaving the road.
    """
    if not isinstance(reward, str):
        return reward
    if reward == "published":
        return COMMON_WEIGHTS
    return shipped("demonstrations" if reward == "learned" else reward).weights
