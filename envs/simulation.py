"""Simulate environments in JAX: draw episodes, and step by pure functions."""

from collections.abc import Collection, Sequence
from dataclasses import replace
from typing import NamedTuple, TypeAlias

import jax
import numpy as np
from highway_env.envs.common.action import ContinuousAction
from jax import numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Float, Int

from ms_highway.choice.rule import compilable, in_ladder, in_order
from ms_highway.envs import ENVIRONMENTS, scenario_name
from ms_highway.envs.base import InteractionEnv
from ms_highway.envs.configuration import Config
from ms_highway.envs.controllers import ControllerSettings, ModelOrder
from ms_highway.envs.spaces import (
    Autopilot,
    CarStates,
    HumanModelAction,
    SceneStates,
    executed_controls,
    is_possible,
)
from ms_highway.game.features import check_user_features
from ms_highway.game.starts import Random, TracedRandom
from ms_highway.loop.batch import (
    EpisodeCarry,
    StepInputs,
    begin_episodes,
    checked_records,
    step_episodes,
)
from ms_highway.loop.controller import traceable
from ms_highway.loop.records import DECIDES, Episodes, Loop, Records
from ms_highway.planning.human_models import Naive, warn_of_limits
from ms_highway.planning.ladders import cheapest_first, human_model
from ms_highway.runtime.arrays import Array
from ms_highway.runtime.compilation import usual_chunk
from ms_highway.runtime.jax_settings import single_precision
from ms_highway.runtime.process import refuse_after_fork


def refuse_own_steps(kind: type[InteractionEnv]) -> None:
    """Refuse a class that overrides what a simulation does not call.

    See `ms_highway.envs.configured.not_simulated`.

    Raises:
        ValueError: naming what the class overrides.
    """
    own: list[str] = []
    for name in dir(InteractionEnv):
        usual = getattr(InteractionEnv, name)
        method = usual.fget if isinstance(usual, property) else usual
        marked = getattr(method, "not_simulated", False)
        if marked and getattr(kind, name) is not usual:
            own.append(name)
    if own:
        names = ", ".join(own)
        raise ValueError(
            f"{kind.__name__} has its own {names}, which a simulation does not call;"
            " change its scenario, its game (in `configure`) or `draw_episode`, or use"
            " `compare`"
        )


def shared_loop(
    environment: InteractionEnv,
    controllers: Collection[ControllerSettings],
) -> Loop:
    """Return the loop that all episodes of an environment share.

    A fixed order takes the place of the rule.

    Args:
        environment: what is simulated.
        controllers: of the robot; the loop holds the models that they name.

    Raises:
        ValueError: for environments that override a part of a step, for controllers
            that do not predict, and for costs that must be measured.
    """
    settings = environment.settings
    refuse_own_steps(type(environment))
    if not all(each.predicts for each in controllers):
        raise ValueError(
            "a function or an agent that drives the robot is not simulated; use"
            " `compare`"
        )
    if settings.costs == "measured":
        remedy = "say 'shipped', or give seconds by model"
        raise ValueError(
            f"costs are 'measured', and a simulation cannot measure plans; {remedy}"
        )

    # Models beside the ladder: those of orders, and the one that a belief compares the
    # others with.
    names = {name for each in controllers for name in each.names()}
    if any(each.belief and not each.chooses for each in controllers):
        names.add(Naive.name)
    names -= {model.name for model in settings.models}
    others = tuple(map(human_model, cheapest_first(names)))

    drivers = tuple(traceable(name, environment.game) for name in settings.drivers)
    order = in_order(np.zeros((1, 1), np.int32), settings.models)
    return Loop(
        environment.game,
        order,
        others,
        settings.way_out,
        drivers=drivers,
        chunk=usual_chunk(),
    )


def draw_start(
    environment: InteractionEnv,
    loop: Loop,
    settings: ControllerSettings,
    random: Random,
) -> Episodes:
    """Draw an episode as the environment does at a reset.

    Its arrays have no axis of episodes.

    Args:
        environment: what is simulated.
        loop: of `shared_loop`.
        settings: of the robot's controller.
        random: source of the draws.
    """
    start, weights = environment.draw_episode(random)
    drivers = environment.draw_drivers(random)
    steps = environment.episode_steps

    # The number of every human's model in every step, [steps, humans]. An order keeps
    # its last models.
    schedule = np.full((steps, environment.settings.humans), DECIDES, np.int32)
    if isinstance(settings.chooser, ModelOrder):
        names = [model.name for model in loop.models]
        known = environment.settings.start(steps, random)  # type: ignore[arg-type]
        numbers = np.vectorize(names.index)(settings.chooser.table(known))
        schedule[:] = numbers[np.minimum(np.arange(steps), len(numbers) - 1)]

    price = np.nan_to_num(np.float32(settings.price))  # an order has none
    return Episodes(
        start.astype(np.float32),
        np.asarray(price),
        schedule,
        loop.game.robot.weights,
        weights,
        drivers,
    )


def stack_episodes(drawn: Sequence[Episodes]) -> Episodes:
    """Stack drawn episodes along a first axis."""
    return jax.tree.map(lambda *parts: np.array(parts), *drawn)


class EnvState(NamedTuple):
    """The state of environments, along a first axis of every array.

    The length of that axis is 1 in a `FunctionalEnv`.

    Attributes:
        now: what every episode carries from step to step.
        episodes: the numbers that were drawn for each.
        step: number of steps done in each.
    """

    now: EpisodeCarry
    episodes: Episodes
    step: Int[Array, "episodes"]


FunctionalStep: TypeAlias = tuple[
    EnvState, jax.Array, jax.Array, jax.Array, jax.Array, dict[str, jax.Array]
]
"""State, observation, reward, terminated, truncated and info."""


class FunctionalEnv:
    """One environment as pure functions, to be jitted, vmapped and scanned.

    To step a thousand environments, `ms_highway.envs.vector.InteractionVectorEnv` is
    faster: it computes a human model only for the environments that use it.

    Numbers are in single precision, also where JAX computes in double precision. There
    are derivatives in forward mode (`jax.jvp`, `jax.jacfwd`). JAX refuses reverse mode,
    `jax.grad`, where plans are loops that end when they have converged: with other
    solvers than ``"gradient"``, such as those of version 1.

    Attributes:
        environment: the environment of Gymnasium that is simulated; it draws the
            episodes.
        observation_space, action_space: its spaces.
        loop, costs: what its episodes share.
        steps: number of steps of an episode that nothing ends early.
        agent_drives: whether the actions are the robot's controls.

    Args:
        scenario: its name or id, such as ``merger-v1``, or the class of an environment.
        config: of the environment, see `ms_highway.InteractionEnv`.

    Raises:
        ValueError: for an unknown scenario, a configuration that is not simulated,
            other actions than ``Autopilot``, ``HumanModelAction`` and a
            ``ContinuousAction`` of both axes, or other observations than ``CarStates``
            and ``SceneStates``.
    """

    def __init__(
        self,
        scenario: str | type[InteractionEnv],
        config: Config | None = None,
    ) -> None:
        refuse_after_fork()
        if isinstance(scenario, str):
            scenario = ENVIRONMENTS[scenario_name(scenario)]
        self.environment = env = scenario(config)
        self.observation_space = env.observation_space
        self.action_space = env.action_space
        self.steps = env.episode_steps
        kind = env.action_type
        self.agent_drives = type(kind) is ContinuousAction and kind.size == 2
        self._check_spaces()

        # What the episodes share.
        settings = env.settings
        controller = settings.controller
        self.loop = shared_loop(env, [controller])
        self.costs = settings.counted.select(model.name for model in self.loop.models)
        self._price = float(env.config["action"].get("lambda", 0.0))

        # Check functions of users at a start that is drawn for this purpose.
        random = np.random.default_rng(0)
        game = self.loop.game
        start, _ = env.draw_episode(random)
        check_user_features(game.scene, game.robot, game.number, start)
        if not self.agent_drives:
            self.loop = replace(self.loop, belief=controller.belief)
            warn_of_limits(self.loop.models, game, start)
        if controller.chooses and type(kind) is Autopilot:
            rule = compilable(controller.rule(settings.start(self.steps, random)))
            self.loop = replace(self.loop, rule=rule)

    def _check_spaces(self) -> None:
        """Refuse actions and observations that are not simulated.

        Raises:
            ValueError: for such actions or observations.
        """
        env = self.environment
        if not (self.agent_drives or isinstance(env.action_type, Autopilot)):
            known = "Autopilot, HumanModelAction, or a ContinuousAction of both axes"
            raise ValueError(
                f"config['action'] is {env.config['action']}; what is simulated is"
                f" {known}"
            )
        if type(env.observation_type) not in (CarStates, SceneStates):
            place = f"config['observation'] is {env.config['observation']}"
            raise ValueError(f"{place}; what is simulated is CarStates or SceneStates")

    def draw(self, random: Random) -> Episodes:
        """Draw an episode, see `draw_start`."""
        controller = self.environment.settings.controller
        return draw_start(self.environment, self.loop, controller, random)

    def reset(self, key: jax.Array) -> tuple[EnvState, jax.Array]:
        """Start an episode that is drawn by a key; return state and observation.

        The key is one of `jax.random`.

        Raises:
            ValueError: for what is no key.
            AttributeError: if the environment draws by a method that
                `ms_highway.game.starts.TracedRandom` lacks.
        """
        refuse_after_fork()
        if not isinstance(key, (jax.Array, np.ndarray)):
            raise ValueError(
                f"the key of reset is {key!r}; give one of JAX, such as"
                " jax.random.key(0)"
            )
        with single_precision():
            # One episode, along a first axis of length 1.
            drawn = self.draw(TracedRandom(key))
            episodes = jax.tree.map(lambda part: jnp.asarray(part)[None], drawn)
            now = begin_episodes(self.loop, episodes.starts)
            state = EnvState(now, episodes, jnp.zeros(1, jnp.int32))

            # Arrays of JAX from the start, as after a step.
            state = jax.tree.map(jnp.asarray, state)
            return state, self.observe(episodes.starts, state.step)[0]

    def step(self, state: EnvState, action: ArrayLike) -> FunctionalStep:
        """Take an action, and return the new state with what the agent sees.

        That is state, observation, reward, terminated, truncated and info. No episode
        is reset automatically. Where JAX traces a step, the numbers of the action are
        not checked: a model beyond the ladder then counts as the nearest rung. There,
        the reward is NaN if a rule of the user's chose what is no rung.

        Raises:
            ValueError: for an action of another shape or type than the action space's,
                and for one that the space does not contain or that is not finite;
                controls beyond the ends are clipped. Where JAX does not trace the step,
                also as `ms_highway.loop.batch.checked_records` does.
        """
        refuse_after_fork()
        checked = self._checked_action(jnp.asarray(action))
        with single_precision():
            return self._step(state, checked)

    def _checked_action(self, action: jax.Array) -> jax.Array:
        """Return an action with the type of numbers that are simulated.

        Raises:
            ValueError: for an impossible action, see `step`.
        """
        space = self.action_space
        if action.shape != space.shape:
            raise ValueError(
                f"the action has shape {action.shape}; give one of {space}, of shape"
                f" {space.shape}"
            )
        if not self.agent_drives and action.dtype.kind not in "biu":
            raise ValueError(
                f"the action has numbers of type {action.dtype}; give one of {space},"
                " of whole numbers"
            )
        if not isinstance(action, jax.core.Tracer):
            numbers = np.asarray(action).astype(space.dtype)
            if not is_possible(space, numbers):
                raise ValueError(f"action {action} is impossible; give one of {space}")
        return action.astype(np.float32 if self.agent_drives else np.int32)

    def _step(self, state: EnvState, action: jax.Array) -> FunctionalStep:
        """Step in single precision, see `step`."""
        if not self.agent_drives:
            action = jnp.clip(action, 0, len(self.loop.rule.ladder) - 1)
        inputs = self.step_inputs(state, action[None])
        loop = replace(self.loop, chunk=1)
        now, records = step_episodes(loop, state.episodes, state.now, inputs)

        # A wrong choice of a user's rule is an error, or NaN where JAX traces.
        if not isinstance(records.reward, jax.core.Tracer):
            records = checked_records(self.loop, records)
        elif records.chosen is not None:
            wrong = ~in_ladder(self.loop.rule, records.chosen).all(axis=-1)
            records = records._replace(reward=jnp.where(wrong, jnp.nan, records.reward))

        state = state._replace(now=now, step=state.step + 1)
        info = {"collision": records.collision[0], "states": records.states[0]}
        outcome = self.outcome(records, state.step)
        observation, reward, terminated, truncated = (part[0] for part in outcome)
        return state, observation, reward, terminated, truncated, info

    def step_inputs(self, state: EnvState, actions: Array) -> StepInputs:
        """Return the models of the humans, or the robot's controls, for a step.

        Args:
            state: of the environments, with a first axis of length n.
            actions: of the agent, n of its action space.
        """
        schedules = state.episodes.schedules
        step = state.step.clip(max=self.steps - 1)
        scheduled = schedules[np.arange(len(schedules)), step]
        kind = self.environment.action_type
        if self.agent_drives:
            robots = state.now.state[:, 0]
            controls = executed_controls(kind, self.loop.game.world, actions, robots)
            return StepInputs(scheduled, controls=controls.astype(np.float32))
        if isinstance(kind, HumanModelAction):
            scheduled = actions.reshape(scheduled.shape).astype(np.int32)
        return StepInputs(scheduled)

    def outcome(
        self,
        records: Records,
        steps: Int[Array, "envs"],
    ) -> tuple[Array, Array, Array, Array]:
        """Return observations, rewards, terminated and truncated of environments.

        They have done these steps.
        """
        reward = records.reward
        if self._price:
            reward = reward - self._price * self.costs.total(records.planned)
        ends = bool(self.environment.config["terminate_on_collision"])
        terminated = records.collision & ends
        observations = self.observe(records.states, steps)
        return observations, reward, terminated, steps >= self.steps

    def observe(
        self,
        states: Float[Array, "envs cars 4"],
        steps: Int[Array, "envs"],
    ) -> Float[Array, "envs cars columns"]:
        """Return the observations of environments that have done these steps."""
        return self.environment.observation_type.of(states, 1 - steps / self.steps)
