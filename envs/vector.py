"""Step thousands of environments at once in JAX, as Gymnasium's vector environments."""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from math import ceil
from typing import cast

import jax
import numpy as np
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from ms_highway.envs import ENVIRONMENTS, scenario_name
from ms_highway.envs.base import InteractionEnv
from ms_highway.envs.configuration import Config, checked_seed, refuse_unknown
from ms_highway.envs.simulation import EnvState, FunctionalEnv, stack_episodes
from ms_highway.loop.batch import (
    EpisodeCarry,
    StepInputs,
    begin_episodes,
    checked_records,
    step_episodes,
)
from ms_highway.loop.records import Episodes, Loop, Records
from ms_highway.loop.step import STATUSES
from ms_highway.runtime.compilation import jit_quickly
from ms_highway.runtime.jax_settings import cores
from ms_highway.runtime.process import refuse_after_fork


class InteractionVectorEnv(VectorEnv):
    """Many environments of one scenario, simulated in JAX on all cores.

    Each equals an `InteractionEnv` of its seed up to rounding, which chaotic scenes
    amplify (``notebooks/REFERENCE.md`` says by how much).
    ``gym.make_vec("ms-highway/merger-v1", num_envs=1024, config={"action": {"type":
    "ContinuousAction"}})`` makes one. Episodes end and begin as Gymnasium's autoreset
    modes say. ``info`` has ``collision``. It also has ``status``, ``model`` (the most
    expensive of the humans' models) and ``counted_seconds`` unless the agent drives,
    and ``success`` in scenarios with streams. Every key has a mask, such as
    ``_collision``. Nothing is rendered: make a single environment for films.

    Attributes:
        episode_steps: number of steps of an episode that nothing ends early.

    Args:
        environment: class of the single environment.
        num_envs: number of environments.
        config: of each of them, see `ms_highway.InteractionEnv`.
        autoreset_mode: when environments whose episode has ended are reset.
        render_mode: None.

    Raises:
        ValueError: as `FunctionalEnv` does, and for a render mode, an unknown autoreset
            mode or an impossible number.
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
            raise ValueError(
                f"render_mode is {render_mode!r}; nothing is rendered here, make a"
                " single environment"
            )
        is_whole = isinstance(num_envs, (int, np.integer))
        is_whole = is_whole and not isinstance(num_envs, bool)
        if not is_whole or num_envs < 1:
            raise ValueError(
                f"num_envs is {num_envs!r}; give a whole number of environments from"
                " 1 on"
            )
        self.autoreset_mode = autoreset_mode_of(autoreset_mode)
        functions = FunctionalEnv(environment, config)
        self._functions = functions
        self.num_envs = int(num_envs)
        self.metadata = {"autoreset_mode": self.autoreset_mode, "render_modes": []}
        self.single_observation_space = functions.observation_space
        self.single_action_space = functions.action_space
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.episode_steps = functions.steps
        self._randoms = [seeding.np_random(None)[0] for _ in range(num_envs)]
        # None before the first reset.
        self._state: EnvState | None = None
        self._ended = np.ones(num_envs, bool)
        self._collided = np.zeros(num_envs, bool)
        self._groups = min(cores(), ceil(num_envs / functions.loop.together))
        self._threads = ThreadPoolExecutor(self._groups)

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: Config | None = None,
    ) -> tuple[np.ndarray, Config]:
        """Start episodes of all environments, or of those in a mask.

        Args:
            seed: of each environment; a number is the first one's seed, and the others
                count on from it.
            options: ``"reset_mask"``: which environments to reset, an array of bools.

        Raises:
            ValueError: for impossible seeds or another number of them, unknown options,
                or a mask that is empty, has another shape, or leaves out environments
                that were never reset.
        """
        refuse_after_fork()
        options = options or {}
        refuse_unknown("the reset options", options, ["reset_mask"])
        mask = self._reset_mask(options)
        for index, own_seed in enumerate(self._seeds(seed)):
            if own_seed is not None and mask[index]:
                self._randoms[index], _ = seeding.np_random(own_seed)
        observations = self._renew(mask)
        return observations, _masked(self._info_at_reset(), mask)

    def _reset_mask(self, options: Config) -> np.ndarray:
        """Return which environments to reset, by default all.

        Raises:
            ValueError: for a mask that is empty, has another shape, or leaves out
                environments that were never reset.
        """
        everything = np.ones(self.num_envs, bool)
        mask = np.asarray(options.get("reset_mask", everything))
        if mask.shape != (self.num_envs,) or mask.dtype != bool or not mask.any():
            what = f"options['reset_mask'] is {mask.tolist()}"
            raise ValueError(
                f"{what}; give {self.num_envs} bools, one of them True at least"
            )
        if self._state is None and not mask.all():
            raise ValueError(
                "options['reset_mask'] leaves environments out that were never reset;"
                " reset all of them"
            )
        return mask

    def _seeds(self, seed: object) -> list[int | None]:
        """Return the seed of each environment; None for one that is drawn.

        Raises:
            ValueError: for impossible seeds, or another number of them.
        """
        is_array = isinstance(seed, np.ndarray) and seed.ndim > 0
        is_sequence = isinstance(seed, Sequence) and not isinstance(seed, str)
        if is_array or is_sequence:
            seeds = [checked_seed(each) for each in cast(Sequence[object], seed)]
        else:
            first = checked_seed(seed)
            seeds = [None] * self.num_envs
            if first is not None:
                seeds = list(range(first, first + self.num_envs))
        if len(seeds) != self.num_envs:
            raise ValueError(
                f"there are {len(seeds)} seeds for {self.num_envs} environments; give"
                " one for each"
            )
        return seeds

    def step(
        self,
        actions: object,
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, Config]:
        """Step all environments.

        Those whose episode has ended are reset as the autoreset mode says.

        Raises:
            ValueError: for actions outside the action space, before the first reset,
                and after the end of an episode in the mode without automatic resets.
        """
        # In a fork, also the threads are missing.
        refuse_after_fork()
        state = self._state
        no_autoreset = self.autoreset_mode is AutoresetMode.DISABLED
        if state is None or (no_autoreset and self._ended.any()):
            ended = np.flatnonzero(self._ended).tolist()
            raise ValueError(
                f"environments must be reset before they can step: {ended}"
            )
        checked_actions = self._checked_actions(np.asarray(actions))

        # All environments are computed; those whose episode has ended do not count.
        stepped = ~self._ended
        state, records = self._advance(state, checked_actions)
        self._state = state
        self._collided = self._collided | records.collision
        outcome = self._functions.outcome(records, state.step)
        observations, rewards, terminated, truncated = map(np.asarray, outcome)
        rewards = np.where(stepped, rewards, 0.0).astype(np.float64)
        terminated = terminated & stepped
        truncated = truncated & stepped
        values = self._info(records)
        self._ended = terminated | truncated

        # Draw new episodes of environments whose episode had ended before, or ends now.
        info = _masked(values, stepped)
        renewed = ~stepped
        if self.autoreset_mode is AutoresetMode.SAME_STEP and self._ended.any():
            renewed = self._ended.copy()
            final = np.full(self.num_envs, None, dtype=object)
            for index in np.flatnonzero(renewed):
                final[index] = observations[index]
            ends = {"final_obs": final, "final_info": _masked(values, renewed)}
            info = _masked(values, ~renewed) | _masked(ends, renewed)
        if renewed.any():
            observations = self._renew(renewed)
        return observations, rewards, terminated, truncated, info

    def _checked_actions(self, actions: np.ndarray) -> np.ndarray:
        """Return actions of all environments.

        Raises:
            ValueError: for actions outside the action space; an agent's controls beyond
                the ends are clipped.
        """
        space = self.action_space
        are_numbers = actions.shape == space.shape and actions.dtype.kind in "biuf"
        possible = are_numbers and bool(np.isfinite(actions).all())
        if possible and not self._functions.agent_drives:
            converted = actions.astype(space.dtype)
            are_equal = bool((converted == actions).all())
            possible = are_equal and space.contains(converted)
        if not possible:
            raise ValueError(
                f"the actions {actions!r} are impossible; give some of {space}"
            )
        return actions

    def close_extras(self, **kwargs: object) -> None:
        """End the threads."""
        self._threads.shutdown()

    def _renew(self, mask: np.ndarray) -> np.ndarray:
        """Draw new episodes of some environments; return the observations of all."""
        functions = self._functions
        chosen = np.flatnonzero(mask)
        drawn = [functions.draw(self._randoms[index]) for index in chosen]
        episodes = stack_episodes(drawn)
        count = len(episodes)

        # Begin them, filled up with copies, so that one program serves any number.
        starts = episodes.starts
        filled = np.resize(starts, (self.num_envs, *starts.shape[1:]))
        begun = _begin(functions.loop, filled)
        now = jax.tree.map(lambda array: np.array(array)[:count], begun)
        new = EnvState(now, episodes, np.zeros(count, int))

        # Replace the rows of these environments.
        if self._state is None:
            self._state = new
        old_arrays = jax.tree.leaves(self._state)
        new_arrays = jax.tree.leaves(new)
        for old, new_rows in zip(old_arrays, new_arrays, strict=True):
            old[mask] = new_rows
        self._ended[mask] = False
        self._collided[mask] = False
        state = self._state
        return np.asarray(functions.observe(state.now.state, state.step))

    def _advance(
        self,
        state: EnvState,
        actions: np.ndarray,
    ) -> tuple[EnvState, Records]:
        """Step all environments, chunk by chunk, on all cores.

        Chunks are sorted by model, as a chunk computes each model that one of its
        humans uses. The last chunks are filled up with copies of the first
        environments.
        """
        loop = self._functions.loop
        inputs = self._functions.step_inputs(state, actions)

        # The indices of the environments, [threads, rounds, chunk].
        most_expensive = inputs.scheduled.max(axis=1)
        order = np.argsort(most_expensive, kind="stable")
        rounds = ceil(self.num_envs / (self._groups * loop.together))
        by_round = np.resize(order, (rounds, self._groups, loop.together))
        groups = by_round.swapaxes(0, 1)

        # The inputs have the scheduled models.
        episodes = replace(state.episodes, schedules=None)  # type: ignore[arg-type]
        everything = (episodes, state.now, inputs)

        def advance(indices: np.ndarray) -> tuple[EpisodeCarry, Records]:
            """Step the environments of a thread."""
            own = jax.tree.map(lambda array: np.asarray(array)[indices], everything)
            return jax.tree.map(np.asarray, _step_chunks(loop, *own))

        results = list(self._threads.map(advance, groups))

        # Back to the order of the environments: the first result of each counts.
        _, first = np.unique(groups, return_index=True)

        def in_order(*arrays: np.ndarray) -> np.ndarray:
            """Return the rows of all environments, from arrays [rounds, chunk, ...]."""
            in_a_row = np.concatenate(np.concatenate(arrays))
            return in_a_row[first]

        now, records = jax.tree.map(in_order, *results)
        records = checked_records(loop, records)
        return state._replace(now=now, step=state.step + 1), records

    def _info(self, records: Records) -> Config:
        """Return the values of ``info`` after a step."""
        functions = self._functions
        loop = functions.loop
        info: Config = {"collision": records.collision.copy()}
        if not functions.agent_drives:
            names = np.array([model.name for model in loop.models])
            info["status"] = np.array(STATUSES)[records.status]
            info["model"] = names[records.rungs.max(axis=1)]
            info["counted_seconds"] = functions.costs.total(records.planned)
        if functions.environment.scenario.streams:
            y = records.states[:, 0, 1]
            is_in_lane = loop.game.scene.is_reached(y)
            info["success"] = is_in_lane & ~self._collided
        return info

    def _info_at_reset(self) -> Config:
        """Return the values of ``info`` of environments that have done no step.

        They have the keys and types of `_info`.
        """
        assert self._state is not None
        states = np.asarray(self._state.now.state)
        humans = self._functions.loop.game.number
        zeros = np.zeros((self.num_envs, humans), np.int32)
        records = Records(
            zeros,
            zeros,
            zeros[:, 0],
            collision=self._collided,
            states=states,
        )
        values = self._info(records)
        for name in ("status", "model", "counted_seconds"):
            if name in values:
                values[name] = np.zeros_like(values[name])
        return values


def _masked(values: Config, mask: np.ndarray) -> Config:
    """Return values of ``info`` with the mask of the environments that have them."""
    return values | {f"_{name}": mask for name in values}


_begin = jit_quickly(begin_episodes)


@jit_quickly
def _step_chunks(
    loop: Loop,
    episodes: Episodes,
    now: EpisodeCarry,
    inputs: StepInputs,
) -> tuple[EpisodeCarry, Records]:
    """Step environments [chunks, together], chunk by chunk."""
    everything = (episodes, now, inputs)
    return jax.lax.map(lambda items: step_episodes(loop, *items), everything)


def autoreset_mode_of(mode: AutoresetMode | str) -> AutoresetMode:
    """Return an autoreset mode, by its name or its value.

    Raises:
        ValueError: for an unknown one.
    """
    for known in AutoresetMode:
        names = (known, known.name, known.value)
        if isinstance(mode, (str, AutoresetMode)) and mode in names:
            return known
    modes = ", ".join(f"AutoresetMode.{known.name}" for known in AutoresetMode)
    raise ValueError(f"autoreset_mode is {mode!r}; give one of {modes}")


def __getattr__(name: str) -> Callable[..., InteractionVectorEnv]:
    """Return what makes a vector environment of an id, such as ``merger-v1``.

    Gymnasium's entry points find it so.
    """
    try:
        return partial(InteractionVectorEnv, ENVIRONMENTS[scenario_name(name)])
    except ValueError:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}") from None
