"""Step thousands of environments at once in JAX, as a vector environment of Gymnasium."""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any

import jax
import numpy as np
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from jax import numpy as jnp

from ms_highway.envs import ENVIRONMENTS, environment_id
from ms_highway.envs.base import InteractionEnv
from ms_highway.envs.configuration import Config, refuse_unknown
from ms_highway.envs.simulation import Simulated, draw_start, stack_episodes
from ms_highway.loop.batch import Given, Now, Own, begin_episode, choose_episodes, step_episodes
from ms_highway.loop.fallback import STATUSES
from ms_highway.loop.records import Episodes, Loop, Records
from ms_highway.runtime.arrays import State
from ms_highway.runtime.compilation import jit_quickly
from ms_highway.runtime.jax_settings import cores


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
        self._episodes: Episodes | None = None  # before the first reset
        self._carried: list[Any] = [None] * len(self._groups)
        self._ended = np.zeros(num_envs, bool)
        self._steps, self._collided = np.zeros(num_envs, int), np.zeros(num_envs, bool)

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
        if self._episodes is None and not mask.all():
            raise ValueError("options['reset_mask'] leaves environments out that were never reset; reset all of them")
        seeds = [seed + place for place in range(self.num_envs)] if isinstance(seed, (int, np.integer)) else seed
        if seeds is not None and len(seeds) != self.num_envs:
            raise ValueError(f"there are {len(seeds)} seeds for {self.num_envs} environments; give one for each")
        for place, own in enumerate(() if seeds is None else seeds):
            if own is not None and mask[place]:
                self._randoms[place] = seeding.np_random(int(own))[0]
        self._renew(mask)
        return self._observe(), {}

    def step(self, actions: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Step all environments; those whose episode has ended are reset as the autoreset mode says.

        Raises:
            ValueError: for actions that are not in the action space, before the first reset and, where nothing is reset
                automatically, after the end of an episode.
        """
        never = self._episodes is None
        if never or (self.autoreset_mode is AutoresetMode.DISABLED and self._ended.any()):
            places = "all of them" if never else np.flatnonzero(self._ended).tolist()
            raise ValueError(f"environments are to be reset before they can step: {places}")
        actions, space = np.asarray(actions), self.action_space
        typed = actions.astype(space.dtype)
        if self._simulated.agent_drives:  # beyond the ends of the space, actions are clipped
            possible = typed.shape == space.shape and np.isfinite(typed).all()
        else:
            possible = space.contains(typed) and (typed == actions).all()
        if not possible:
            raise ValueError(f"the actions {actions!r} are impossible; give some of {space}")
        resets = self._ended if self.autoreset_mode is AutoresetMode.NEXT_STEP else np.zeros_like(self._ended)
        records = self._advance(actions)
        self._steps += 1
        collision = np.array(records.collision)
        self._collided |= collision
        terminated = collision & self._simulated.environment.config["terminate_on_collision"] & ~resets
        truncated = (self._steps >= self._simulated.steps) & ~resets
        rewards = np.where(resets, 0.0, self._simulated.reward(records)).astype(np.float64)
        info = self._info(records, ~resets)
        self._ended = terminated | truncated
        if resets.any():
            self._renew(resets)
        if self.autoreset_mode is AutoresetMode.SAME_STEP and self._ended.any():
            final = np.full(self.num_envs, None, dtype=object)
            seen = self._observe()
            for place in np.flatnonzero(self._ended):
                final[place] = seen[place]
            values = {name: part for name, part in info.items() if not name.startswith("_")}
            info = values | {f"_{name}": ~self._ended for name in values}  # as the others have begun anew
            info |= {"final_obs": final, "final_info": values | {f"_{name}": self._ended for name in values}}
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
        if self._episodes is None:
            self._episodes, self._states = new, np.array(new.starts)
        else:
            for old, part in zip(jax.tree.leaves(self._episodes), jax.tree.leaves(new), strict=True):
                old[mask] = part
            self._states[mask] = new.starts
        self._steps[mask], self._ended[mask], self._collided[mask] = 0, False, False
        for number, group in enumerate(self._groups):
            if mask[group].any():
                own = Own.of(self._padded(self._episodes, group))
                now, renewed = self._padded((self._states, mask), group)
                begun = _begin(loop, now)
                if self._carried[number] is not None:
                    begun = _renewed(renewed, begun, self._carried[number][1])
                self._carried[number] = own, begun

    def _padded(self, tree: Any, group: slice) -> Any:
        """Return a group's part of arrays [environments, ...], filled up with its last environment."""
        places = np.minimum(np.arange(group.start, group.stop), self.num_envs - 1)
        return jax.tree.map(lambda part: np.asarray(part)[places], tree)

    def _advance(self, actions: np.ndarray) -> Records:
        """Step all groups, each in a thread of its own."""
        assert self._episodes is not None
        given = self._simulated.given(self._episodes.schedules, self._steps, self._states, actions)

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

    def _info(self, records: Records, stepped: np.ndarray) -> dict[str, Any]:
        """Return the ``info`` of a step, with a mask of the environments that stepped for each key."""
        simulated = self._simulated
        info: dict[str, Any] = {"collision": np.array(records.collision)}
        if not simulated.agent_drives:
            names = np.array([model.name for model in simulated.loop.models])
            info |= {"status": np.array(STATUSES)[records.status], "model": names[records.rungs.max(axis=1)]}
            info["counted_seconds"] = simulated.costs.total(records.planned)
        if simulated.environment.scenario.streams:
            info["success"] = simulated.success(records.states) & ~self._collided
        return info | {f"_{name}": stepped for name in info}


_renewed = jit_quickly(choose_episodes)


@jit_quickly
def _begin(loop: Loop, starts: State) -> Now:
    return jax.vmap(partial(begin_episode, loop))(starts)


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
