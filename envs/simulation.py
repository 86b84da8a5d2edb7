"""Simulate an environment in JAX: build the common loop, draw episodes, and step one environment by pure functions."""

from collections.abc import Collection, Sequence
from dataclasses import replace
from functools import partial
from math import isnan
from typing import Any, NamedTuple

import jax
import numpy as np
from highway_env.envs.common.action import ContinuousAction
from jax import numpy as jnp

from ms_highway.choice.rule import Order
from ms_highway.envs import ENVIRONMENTS, environment_id
from ms_highway.envs.base import InteractionEnv
from ms_highway.envs.configuration import Config
from ms_highway.envs.controllers import ControllerSettings, OrderSettings, RandomSettings
from ms_highway.envs.spaces import Autopilot, HumanModelAction, StateObservation, executed_controls
from ms_highway.game.starts import Random, TracedRandom
from ms_highway.loop.batch import Given, Now, Own, begin_episode, step_episodes
from ms_highway.loop.devices import usual_chunk
from ms_highway.loop.human_drivers import traceable
from ms_highway.loop.records import DECIDES, Episodes, Loop, Records
from ms_highway.planning.compiled_plans import Costs
from ms_highway.planning.human_models import Naive, cheapest_first, human_model, warn_of_limits
from ms_highway.runtime.arrays import Index, Rungs, State

STEP = (
    *("_reset", "_drive", "_drive_robot", "step", "_simulate", "_reward", "_rewards", "_is_terminated"),
    *("_is_truncated", "episode_steps", "car_states", "success", "measure", "counted_seconds"),
)
"""Names of the methods and properties of an environment that a simulation replaces by its own code."""


def shared_loop(environment: InteractionEnv, controllers: Collection[ControllerSettings]) -> Loop:
    """Return the loop that all episodes of an environment share; a fixed order stands in for the rule.

    Args:
        environment: what is simulated.
        controllers: of the robot, whose models are known to the loop.

    Raises:
        ValueError: for costs that are to be measured, and for environments that do something of their own in a step,
            or tell the robot the true rewards.
    """
    kind, settings = type(environment), environment.settings
    if own := [name for name in STEP if getattr(kind, name) is not getattr(InteractionEnv, name)]:
        reason = f"{kind.__name__} has its own {', '.join(own)}, which a simulation does not call"
        remedy = "change its scenario, its game (in `configure`) or `draw_episode`, or use `compare`"
        raise ValueError(f"{reason}; {remedy}")
    if not all(each.predicts for each in controllers):
        raise ValueError("a function or an agent that drives the robot is not simulated; use `compare`")
    if settings.beliefs == "true":
        reason = f"{environment.scenario.name} is configured with beliefs 'true', which a simulation does not do"
        raise ValueError(f"{reason}; use `compare`")
    if settings.costs == "measured":
        remedy = "say 'shipped', or give seconds by model"
        raise ValueError(f"costs are 'measured', and a simulation cannot measure plans; {remedy}")
    used = {name for each in controllers for name in each.names()}
    used |= {Naive.name for each in controllers if each.belief and not each.chooses}
    used -= {model.name for model in settings.models}
    drivers = tuple(traceable(name, environment.game) for name in settings.drivers)
    order, others = Order(np.zeros((1, 1), np.int32), settings.models), tuple(map(human_model, cheapest_first(used)))
    return Loop(environment.game, order, others, settings.way_out, drivers=drivers, chunk=usual_chunk())


def draw_start(
    environment: InteractionEnv, loop: Loop, settings: ControllerSettings, random: Random
) -> tuple[Any, ...]:
    """Draw an episode as the environment draws it at a reset; return an episode's part of `Episodes`, in its order.

    Args:
        environment: what is simulated.
        loop: of `shared_loop`.
        settings: of the robot's controller.
        random: what is drawn from.
    """
    start, weights = environment.draw_episode(random)
    drivers, shape = environment.draw_drivers(random), (environment.episode_steps, environment.settings.humans)
    rungs = np.full(shape, DECIDES, np.int32)
    if isinstance(settings, OrderSettings):
        numbers = {model.name: number for number, model in enumerate(loop.models)}
        table = np.vectorize(numbers.get)(settings.table(*shape, random))  # type: ignore[arg-type]
        rungs[:] = table[np.minimum(np.arange(shape[0]), len(table) - 1)]
    price = np.float32(0.0 if isnan(settings.price) else settings.price)
    return start.astype(np.float32), price, rungs, loop.game.robot.weights, weights, drivers


def stack_episodes(drawn: Sequence[tuple[Any, ...]]) -> Episodes:
    """Put drawn episodes together."""
    return Episodes(*map(np.array, zip(*drawn, strict=True)))


class Simulated:
    """An environment that JAX simulates, with the loop and the costs that its episodes share.

    Args:
        scenario: its name, such as ``merger-v1``, or the class of an environment.
        config: of the environment.

    Raises:
        ValueError: for an unknown scenario, a configuration that is not simulated, other actions than ``Autopilot``,
            ``HumanModelAction`` and a ``ContinuousAction`` of both axes, or other observations than ``CarStates`` and
            ``SceneStates``.
    """

    def __init__(self, scenario: str | type[InteractionEnv], config: Config | None = None) -> None:
        if isinstance(scenario, str):
            environment_id(scenario)
            scenario = ENVIRONMENTS[scenario]
        self.environment = scenario(config)
        settings, kind = self.environment.settings, self.environment.action_type
        self.agent_drives = isinstance(kind, ContinuousAction)
        self.agent_chooses = isinstance(kind, HumanModelAction)
        if not ((type(kind) is ContinuousAction and kind.size == 2) or isinstance(kind, Autopilot)):
            known = "Autopilot, HumanModelAction, or a ContinuousAction of both axes"
            raise ValueError(f"config['action'] is {self.environment.config['action']}; what is simulated is {known}")
        if not isinstance(self.environment.observation_type, StateObservation):
            place = f"config['observation'] is {self.environment.config['observation']}"
            raise ValueError(f"{place}; what is simulated is CarStates or SceneStates")
        self.controller, self.steps = settings.controller, self.environment.episode_steps
        loop = shared_loop(self.environment, [self.controller])
        if self.controller.chooses and not (self.agent_drives or self.agent_chooses):
            start = settings.start(settings.seconds, self.steps, np.random.default_rng())
            loop = replace(loop, rule=self.controller.rule(start))
        self.loop: Loop = replace(loop, belief=self.controller.belief and not self.agent_drives)
        seconds = [settings.seconds.get(model.name, np.nan) for model in loop.models]
        self.costs = Costs.of(seconds, settings.humans)
        if not self.agent_drives:
            states, _ = self.environment.draw_episode(np.random.default_rng(0))
            warn_of_limits(self.loop.models, self.loop.game, states)
        self.price = float(self.environment.config["action"].get("lambda", 0.0))

    def given(self, schedules: Any, places: Any, now: State, actions: Any) -> Given:
        """Return the models of the humans, or the robot's controls, in a step of each of n episodes.

        Args:
            schedules: of the episodes, see `ms_highway.loop.records.Episodes`.
            places: number of the step in each episode.
            now: states of all cars.
            actions: of the agent.
        """
        scheduled = schedules[np.arange(len(schedules)), places.clip(max=self.steps - 1)]
        if self.agent_drives:
            kind, world = self.environment.action_type, self.loop.game.world
            controls = executed_controls(kind, world, actions, now[:, 0])
            return Given(scheduled, controls=controls.astype(np.float32))
        if self.agent_chooses:
            scheduled = actions.reshape(scheduled.shape).astype(np.int32)
        return Given(scheduled)

    def reward(self, records: Records) -> Any:
        """Return the reward of a step: the robot's, less lambda T where the agent chooses the models."""
        return records.reward - self.price * self.costs.total(records.planned) if self.price else records.reward

    def observe(self, states: State, places: Any) -> Any:
        """Return the observations of states [n, cars, 4]; ``places`` counts the steps of each episode so far."""
        return self.environment.observation_type.of(states, 1 - places / self.steps)

    def success(self, states: State) -> Any:
        """Return whether the robot is in the target lane."""
        return self.loop.game.scene.is_reached(states[..., 0, 1])


class EnvState(NamedTuple):
    """The state of a `FunctionalEnv`.

    Attributes:
        now: what the episode carries from step to step.
        own: the episode's own numbers.
        schedule: number of the model of each human in each step, where a controller's order says so.
        step: number of steps done.
    """

    now: Now
    own: Own
    schedule: Rungs
    step: Index


class FunctionalEnv:
    """One environment as pure functions of JAX, which can be jitted, vmapped and scanned.

    To step a thousand of them, `ms_highway.envs.vector.InteractionVectorEnv` is faster: it computes a human model for
    those environments only that use it.

    Attributes:
        observation_space, action_space: as those of the environment of Gymnasium.

    Args:
        scenario: its name, such as ``merger-v1``, or the class of an environment.
        config: of the environment, see `ms_highway.InteractionEnv`.
    """

    def __init__(self, scenario: str | type[InteractionEnv], config: Config | None = None) -> None:
        self._simulated = simulated = Simulated(scenario, config)
        if isinstance(simulated.controller, RandomSettings):
            raise ValueError("JAX does not trace the controller 'random'; choose another, or the vector environment")
        self._loop = replace(simulated.loop, chunk=1)
        self.observation_space = simulated.environment.observation_space
        self.action_space = simulated.environment.action_space

    def reset(self, key: jax.Array) -> tuple[EnvState, jax.Array]:
        """Start an episode that is drawn by a key of `jax.random`; return its state and the observation."""
        simulated = self._simulated
        parts = draw_start(simulated.environment, self._loop, simulated.controller, TracedRandom(key))
        start, price, schedule, robot, weights, drivers = (jnp.asarray(part)[None] for part in parts)
        own = Own(price, robot, weights, drivers)
        now = jax.vmap(partial(begin_episode, self._loop))(start)
        return EnvState(now, own, schedule, jnp.int32(0)), simulated.observe(start, jnp.zeros(1))[0]

    def step(
        self, state: EnvState, action: Any
    ) -> tuple[EnvState, jax.Array, jax.Array, jax.Array, jax.Array, dict[str, jax.Array]]:
        """Return state, observation, reward, terminated, truncated and info after an action."""
        simulated = self._simulated
        given = simulated.given(state.schedule, state.step[None], state.now.state, jnp.asarray(action)[None])
        now, records = step_episodes(self._loop, state.own, state.now, given)
        done, collision = state.step + 1, records.collision[0]
        info = {"collision": collision, "states": records.states[0]}
        observation = simulated.observe(now.state, jnp.asarray(done)[None])[0]
        terminated = collision & bool(simulated.environment.config["terminate_on_collision"])
        rewards = simulated.reward(records)[0]
        return state._replace(now=now, step=done), observation, rewards, terminated, done >= simulated.steps, info
