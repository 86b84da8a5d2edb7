"""Thousands of environments at once in JAX: as pure functions, and as a vector environment of Gymnasium."""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import jax
import numpy as np
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from highway_env.envs.common.action import ContinuousAction
from jax import numpy as jnp

from ms_highway.envs import ENVIRONMENTS, environment_id
from ms_highway.envs.base import InteractionEnv
from ms_highway.envs.configuration import Config, refuse_unknown
from ms_highway.envs.controllers import RandomSettings
from ms_highway.envs.simulation import draw_start, shared_loop, stack_episodes
from ms_highway.envs.spaces import Autopilot, HumanModelAction, StateObservation, executed_controls
from ms_highway.game.random import TracedRandom
from ms_highway.game.scenario import REACHED
from ms_highway.loop.batch import Given, Now, Own, begin_episode, step_episodes
from ms_highway.loop.fallback import STATUSES
from ms_highway.loop.records import Episodes, Loop, Records
from ms_highway.planning.compiled_plans import Costs
from ms_highway.runtime.arrays import Index, Rungs, State
from ms_highway.runtime.compilation import jit_quickly
from ms_highway.runtime.jax_settings import cores


class Simulated:
    """An environment that JAX simulates, and what its simulations share.

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
        self.price = float(self.environment.config["action"].get("lambda", 0.0))

    def given(self, episodes: Episodes, places: Any, now: State, actions: Any) -> Given:
        """Return what is given for a step of episodes [n]: models of the humans, or the robot's controls.

        Args:
            episodes: with a schedule of each.
            places: number of the step in each episode.
            now: states of all cars.
            actions: of the agent.
        """
        schedules = episodes.schedules
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
        return records.reward - self.price * self.counted_seconds(records) if self.price else records.reward

    def counted_seconds(self, records: Records) -> Any:
        """Return T of the plans of a step [s]."""
        xp = records.rungs.__array_namespace__()
        return self.costs.base + xp.sum(xp.asarray(self.costs.each)[records.rungs], axis=-1)

    def observe(self, states: State, places: Any) -> Any:
        """Return what is observed in states [n, cars, 4], after so many steps of the episodes."""
        return self.environment.observation_type.of(states, 1 - places / self.steps)

    def success(self, states: State) -> Any:
        """Return whether the robot is in the target lane."""
        return abs(states[..., 0, 1] - float(self.loop.game.scene.target_lane)) < REACHED


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

    To step a thousand of them, `InteractionVectorEnv` is faster: it computes a human model for those environments only
    that use it.

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
        episodes = Episodes(state.now.state, state.own.price, state.schedule, *state.own[1:])
        given = simulated.given(episodes, state.step[None], state.now.state, jnp.asarray(action)[None])
        now, records = step_episodes(self._loop, state.own, state.now, given)
        done, collision = state.step + 1, records.collision[0]
        info = {"collision": collision, "states": records.states[0]}
        observation = simulated.observe(now.state, jnp.asarray(done)[None])[0]
        terminated = collision & bool(simulated.environment.config["terminate_on_collision"])
        rewards = simulated.reward(records)[0]
        return state._replace(now=now, step=done), observation, rewards, terminated, done >= simulated.steps, info


class InteractionVectorEnv(VectorEnv):
    """Many environments of one scenario, simulated in JAX on all cores; each equals an `InteractionEnv` of its seed.

    ``gym.make_vec("ms-highway/merger-v1", num_envs=1024, config={"action": {"type": "ContinuousAction"}})`` makes one.
    Episodes end and begin as Gymnasium's autoreset modes say. ``info`` has ``collision``; unless the agent drives,
    ``status``, ``model``, the most expensive of the humans' models, and ``counted_seconds``; and in scenarios with
    streams, ``success``; each with its mask, such as ``_collision``. Nothing is drawn: make a single environment for
    films.

    Attributes:
        episode_steps: length of an episode that nothing ends early.

    Args:
        environment: class of the single environment.
        num_envs: number of environments.
        config: of each of them, see `ms_highway.InteractionEnv`.
        autoreset_mode: when environments whose episode has ended are reset.
        render_mode: None.

    Raises:
        ValueError: as `Simulated` does, and for a mode of rendering.
    """

    def __init__(
        self,
        environment: type[InteractionEnv],
        num_envs: int = 1,
        config: Config | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        render_mode: str | None = None,
    ) -> None:
        if render_mode is not None:
            raise ValueError(f"render_mode is {render_mode!r}; nothing is drawn here, make a single environment")
        self._simulated = simulated = Simulated(environment, config)
        self.num_envs, self.autoreset_mode = num_envs, AutoresetMode(autoreset_mode)
        self.metadata = {"autoreset_mode": self.autoreset_mode, "render_modes": []}
        self.single_observation_space = simulated.environment.observation_space
        self.single_action_space = simulated.environment.action_space
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        chunk, groups = simulated.loop.together, min(cores(), num_envs)
        size = -(-num_envs // (groups * chunk)) * chunk
        self._groups = [slice(first, first + size) for first in range(0, num_envs, size)]
        self._threads = ThreadPoolExecutor(len(self._groups))
        self._randoms = [seeding.np_random(None)[0] for _ in range(num_envs)]
        self.episode_steps = simulated.steps
        self._ended, self._began = np.zeros(num_envs, bool), False
        self._steps = np.zeros(num_envs, int)

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: Config | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Start episodes: of all environments, or of those in ``options["reset_mask"]``.

        Args:
            seed: of each environment; a number is that of the first, and the next ones have the next numbers.
            options: ``"reset_mask"``: which environments to reset, an array of bools.

        Raises:
            ValueError: for another number of seeds, unknown options, or a mask of another shape or of nothing.
        """
        options = options or {}
        refuse_unknown("the reset options", options, ["reset_mask"])
        mask = np.asarray(options.get("reset_mask", np.ones(self.num_envs, bool)))
        if mask.shape != (self.num_envs,) or mask.dtype != bool or not mask.any():
            what = f"options['reset_mask'] is {mask.tolist()}"
            raise ValueError(f"{what}; give {self.num_envs} bools, one of them True at least")
        if not (mask.all() or self._began):
            raise ValueError("options['reset_mask'] leaves environments out that were never reset; reset all of them")
        seeds = [seed + place for place in range(self.num_envs)] if isinstance(seed, (int, np.integer)) else seed
        if seeds is not None and len(seeds) != self.num_envs:
            raise ValueError(f"there are {len(seeds)} seeds for {self.num_envs} environments; give one for each")
        for place, own in enumerate(seeds or ()):
            if own is not None and mask[place]:
                self._randoms[place] = seeding.np_random(own)[0]
        self._renew(mask)
        return self._observe(), {}

    def step(self, actions: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Step all environments; those whose episode has ended are reset as the autoreset mode says.

        Raises:
            ValueError: for actions that are not in the action space, before the first reset and, where nothing is reset
                automatically, after the end of an episode.
        """
        if not self._began or (self.autoreset_mode is AutoresetMode.DISABLED and self._ended.any()):
            places = np.flatnonzero(self._ended).tolist() if self._began else "all of them"
            raise ValueError(f"environments are to be reset before they can step: {places}")
        actions = np.asarray(actions)
        if not self.action_space.contains(actions.astype(self.action_space.dtype)):
            raise ValueError(f"the actions {actions!r} are impossible; give some of {self.action_space}")
        resets = self._ended if self.autoreset_mode is AutoresetMode.NEXT_STEP else np.zeros_like(self._ended)
        records = self._advance(actions)
        self._steps += 1
        collision = np.array(records.collision)
        terminated = collision & self._simulated.environment.config["terminate_on_collision"] & ~resets
        truncated = (self._steps >= self._simulated.steps) & ~resets
        rewards = np.where(resets, 0.0, self._simulated.reward(records)).astype(np.float64)
        info = self._info(records, ~resets)
        self._ended = terminated | truncated
        if resets.any():
            self._renew(resets)
        if self.autoreset_mode is AutoresetMode.SAME_STEP and self._ended.any():
            final = np.full(self.num_envs, None, dtype=object)
            for place in np.flatnonzero(self._ended):
                final[place] = self._observe()[place]
            told = {name: part for name, part in info.items() if not name.startswith("_")}
            info |= {"final_obs": final, "final_info": told | {f"_{name}": self._ended for name in told}}
            info |= {"_final_obs": self._ended, "_final_info": self._ended}
            ended, self._ended = self._ended, np.zeros_like(self._ended)
            self._renew(ended)
        return self._observe(), rewards, terminated, truncated, info

    def close_extras(self, **kwargs: Any) -> None:
        """End the threads."""
        self._threads.shutdown()

    def _renew(self, mask: np.ndarray) -> None:
        """Draw new episodes of some environments."""
        simulated = self._simulated
        environment, loop, controller = simulated.environment, simulated.loop, simulated.controller
        drawn = [draw_start(environment, loop, controller, self._randoms[place]) for place in np.flatnonzero(mask)]
        new = stack_episodes(drawn)
        if not self._began:
            self._episodes, self._states = new, np.array(new.starts)
            self._carried: list[Any] = [None] * len(self._groups)
        else:
            for old, part in zip(jax.tree.leaves(self._episodes), jax.tree.leaves(new), strict=True):
                old[mask] = part
            self._states[mask] = new.starts
        self._steps[mask], self._ended[mask] = 0, False
        for number, group in enumerate(self._groups):
            if mask[group].any():
                own = _own(self._padded(self._episodes, group))
                now, renewed = self._padded((self._states, mask), group)
                begun = _begin(loop, now)
                last = self._carried[number]
                self._carried[number] = (own, begun if last is None else _chosen(renewed, begun, last[1]))
        self._began = True

    def _padded(self, tree: Any, group: slice) -> Any:
        """Return a group's part of arrays [environments, ...], filled up with its last environment."""
        places = np.minimum(np.arange(group.start, group.stop), self.num_envs - 1)
        return jax.tree.map(lambda part: np.asarray(part)[places], tree)

    def _advance(self, actions: np.ndarray) -> Records:
        """Step all groups, each in a thread of its own."""
        given = self._simulated.given(self._episodes, self._steps, self._states, actions)

        def advance(number: int) -> Records:
            own, now = self._carried[number]
            now, records = _advance(self._simulated.loop, own, now, self._padded(given, self._groups[number]))
            self._carried[number] = own, now
            return jax.tree.map(np.asarray, records)

        parts = list(self._threads.map(advance, range(len(self._groups))))
        records = jax.tree.map(lambda *part: np.concatenate(part)[: self.num_envs], *parts)
        self._states = np.array(records.states)
        return records

    def _observe(self) -> np.ndarray:
        return self._simulated.observe(self._states, self._steps)

    def _info(self, records: Records, told: np.ndarray) -> dict[str, Any]:
        """Return what is told of a step, with masks of the environments that did one."""
        simulated = self._simulated
        info: dict[str, Any] = {"collision": np.array(records.collision)}
        if not simulated.agent_drives:
            names = np.array([model.name for model in simulated.loop.models])
            info |= {"status": np.array(STATUSES)[records.status], "model": names[records.rungs.max(axis=1)]}
            info["counted_seconds"] = simulated.counted_seconds(records)
        if simulated.environment.scenario.streams:
            info["success"] = simulated.success(records.states)
        return info | {f"_{name}": told for name in info}


def _own(episodes: Episodes) -> Own:
    return Own(episodes.prices, episodes.robot_weights, episodes.human_weights, episodes.drivers)


@jit_quickly
def _begin(loop: Loop, starts: State) -> Now:
    return jax.vmap(partial(begin_episode, loop))(starts)


@jit_quickly
def _chosen(chosen: Any, new: Now, old: Now) -> Now:
    """Take the new leaves for the chosen environments and the old ones for the rest."""
    return jax.tree.map(lambda new, old: jnp.where(chosen.reshape(-1, *[1] * (new.ndim - 1)), new, old), new, old)


@jit_quickly
def _advance(loop: Loop, own: Own, now: Now, given: Given) -> tuple[Now, Records]:
    """Step environments chunk by chunk, those with the same model together, as a chunk computes each model in use."""
    order = jnp.argsort(given.scheduled.max(axis=1), stable=True)
    chunks = jax.tree.map(lambda part: part[order].reshape(-1, loop.together, *part.shape[1:]), (own, now, given))
    results = jax.lax.map(lambda items: step_episodes(loop, *items), chunks)
    back = jnp.argsort(order)
    return jax.tree.map(lambda part: part.reshape(-1, *part.shape[2:])[back], results)


def __getattr__(name: str) -> Any:
    """Return what makes a vector environment of an id, such as ``merger-v1``, for Gymnasium's entry points."""
    for scenario, environment in ENVIRONMENTS.items():
        if environment_id(scenario).endswith(f"/{name}"):
            return partial(InteractionVectorEnv, environment)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
