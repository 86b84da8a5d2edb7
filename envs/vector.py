"""Step thousands of environments at once in JAX, as Gymnasium's vector environments."""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from math import ceil
from typing import Any

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
    """Many environments of one scenario, simulated in JAX on all cores; each equals an
    `InteractionEnv` of its seed up to rounding, which chaotic scenes amplify
    (``notebooks/REFERENCE.md`` says by how much).

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
        if (
            isinstance(num_envs, bool)
            or not isinstance(num_envs, (int, np.integer))
            or num_envs < 1
        ):
            raise ValueError(
                f"num_envs is {num_envs!r}; give a whole number of environments from"
                " 1 on"
            )
        known = {
            name: each
            for each in AutoresetMode
            for name in (each, each.name, each.value)
        }
        mode = (
            known.get(autoreset_mode)
            if isinstance(autoreset_mode, (str, AutoresetMode))
            else None
        )
        if mode is None:
            names = ", ".join(f"AutoresetMode.{each.name}" for each in AutoresetMode)
            raise ValueError(
                f"autoreset_mode is {autoreset_mode!r}; give one of {names}"
            )
        self._functions = functions = FunctionalEnv(environment, config)
        self.num_envs = int(num_envs)
        self.autoreset_mode = mode
        self.metadata = {"autoreset_mode": self.autoreset_mode, "render_modes": []}
        self.single_observation_space = functions.observation_space
        self.single_action_space = functions.action_space
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.episode_steps = functions.steps
        self._randoms = [seeding.np_random(None)[0] for _ in range(num_envs)]
        self._state: Any = None  # before the first reset, then an `EnvState`
        self._ended = np.ones(num_envs, bool)
        self._collided = np.zeros(num_envs, bool)
        self._groups = min(cores(), ceil(num_envs / functions.loop.together))
        self._threads = ThreadPoolExecutor(self._groups)

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: Config | None = None,
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Start episodes: of all environments, or of those in
        ``options["reset_mask"]``.

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
        mask = np.asarray(options.get("reset_mask", np.ones(self.num_envs, bool)))
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
        several = (
            seed.ndim > 0
            if isinstance(seed, np.ndarray)
            else isinstance(seed, Sequence)
        )
        if (
            isinstance(seed, (Sequence, np.ndarray))
            and several
            and not isinstance(seed, str)
        ):
            seeds = [checked_seed(each) for each in seed]
        else:
            first = checked_seed(seed)
            seeds = [
                None if first is None else first + place
                for place in range(self.num_envs)
            ]
        if len(seeds) != self.num_envs:
            raise ValueError(
                f"there are {len(seeds)} seeds for {self.num_envs} environments; give"
                " one for each"
            )
        for place, own in enumerate(seeds):
            if own is not None and mask[place]:
                self._randoms[place] = seeding.np_random(own)[0]
        observations = self._renew(mask)
        return observations, _masked(self._info_at_reset(), mask)

    def step(
        self, actions: Any
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Step all environments; reset those whose episode has ended as the autoreset
        mode says.

        Raises:
            ValueError: for actions outside the action space, before the first reset,
                and after the end of an episode in the mode without automatic resets.
        """
        refuse_after_fork()  # the threads of the process before are missing here, too
        if self._ended.any() and (
            self._state is None or self.autoreset_mode is AutoresetMode.DISABLED
        ):
            places = np.flatnonzero(self._ended).tolist()
            raise ValueError(
                f"environments must be reset before they can step: {places}"
            )
        actions = np.asarray(actions)
        space = self.action_space
        possible = (
            actions.shape == space.shape
            and actions.dtype.kind in "biuf"
            and np.isfinite(actions).all()
        )
        if (
            possible and not self._functions.agent_drives
        ):  # an agent's controls beyond the ends are clipped
            numbers = actions.astype(space.dtype)
            possible = space.contains(numbers) and (numbers == actions).all()
        if not possible:
            raise ValueError(
                f"the actions {actions!r} are impossible; give some of {space}"
            )
        stepped = ~self._ended
        records = self._advance(actions)
        self._collided |= records.collision
        seen, rewards, terminated, truncated = self._functions.outcome(
            records, self._state.step
        )
        rewards = np.where(stepped, rewards, 0.0).astype(np.float64)
        terminated = terminated & stepped
        truncated = truncated & stepped
        values = self._info(records)
        self._ended = terminated | truncated
        info = _masked(values, stepped)
        renewed = ~stepped
        if self.autoreset_mode is AutoresetMode.SAME_STEP and self._ended.any():
            renewed = self._ended.copy()
            final = np.full(self.num_envs, None, dtype=object)
            for place in np.flatnonzero(renewed):
                final[place] = seen[place]
            info = _masked(values, ~renewed)
            info |= _masked(
                {"final_obs": final, "final_info": _masked(values, renewed)}, renewed
            )
        if renewed.any():
            seen = self._renew(renewed)
        return seen, rewards, terminated, truncated, info

    def close_extras(self, **kwargs: Any) -> None:
        """End the threads."""
        self._threads.shutdown()

    def _renew(self, mask: np.ndarray) -> np.ndarray:
        """Draw new episodes of some environments; return the observations of all."""
        functions = self._functions
        episodes = stack_episodes(
            [functions.draw(self._randoms[place]) for place in np.flatnonzero(mask)]
        )
        number = len(episodes)
        starts = episodes.starts
        filled = np.resize(
            starts, (self.num_envs, *starts.shape[1:])
        )  # so that one program serves any number
        now = jax.tree.map(
            lambda part: np.array(part)[:number], _begin(functions.loop, filled)
        )
        new = EnvState(now, episodes, np.zeros(number, int))
        if self._state is None:
            self._state = new
        for old, rows in zip(
            jax.tree.leaves(self._state), jax.tree.leaves(new), strict=True
        ):
            old[mask] = rows
        self._ended[mask] = self._collided[mask] = False
        return functions.observe(self._state.now.state, self._state.step)

    def _advance(self, actions: np.ndarray) -> Records:
        """Step all environments, chunk by chunk, on all cores.

        Chunks are sorted by model, as a chunk computes each model that one of its
        humans uses. The last chunks are filled up with copies of the first
        environments.
        """
        functions = self._functions
        loop = self._functions.loop
        state = self._state
        given = functions.given(state, actions)
        everything = replace(state.episodes, schedules=None), state.now, given
        order = np.argsort(given.scheduled.max(axis=1), kind="stable")
        rounds = ceil(self.num_envs / (self._groups * loop.together))
        groups = np.resize(order, (rounds, self._groups, loop.together)).swapaxes(0, 1)

        def advance(places: np.ndarray) -> tuple[EpisodeCarry, Records]:
            own, now, given = jax.tree.map(
                lambda part: np.asarray(part)[places], everything
            )
            return jax.tree.map(np.asarray, _step_chunks(loop, own, now, given))

        results = list(self._threads.map(advance, groups))
        _, back = np.unique(
            groups, return_index=True
        )  # the first place of every environment
        now, records = jax.tree.map(
            lambda *parts: np.concatenate(np.concatenate(parts))[back], *results
        )
        records = checked_records(loop, records)
        self._state = state._replace(now=now, step=state.step + 1)
        return records

    def _info(self, records: Records) -> dict[str, Any]:
        """Return the values of ``info`` after a step."""
        functions = self._functions
        loop = self._functions.loop
        info: dict[str, Any] = {"collision": records.collision.copy()}
        if not functions.agent_drives:
            names = np.array([model.name for model in loop.models])
            info |= {
                "status": np.array(STATUSES)[records.status],
                "model": names[records.rungs.max(axis=1)],
            }
            info["counted_seconds"] = functions.costs.total(records.planned)
        if functions.environment.scenario.streams:
            info["success"] = (
                loop.game.scene.is_reached(records.states[:, 0, 1]) & ~self._collided
            )
        return info

    def _info_at_reset(self) -> dict[str, Any]:
        """Return the values of ``info`` of environments that have done no step: with
        the keys and types of `_info`.
        """
        number = self.num_envs
        humans = self._functions.loop.game.number
        none = np.zeros((number, humans), np.int32)
        nothing = Records(
            none,
            none,
            none[:, 0],
            collision=self._collided,
            states=np.asarray(self._state.now.state),
        )
        values = self._info(nothing)
        for name in ("status", "model", "counted_seconds"):
            if name in values:
                values[name] = np.zeros_like(values[name])
        return values


def _masked(values: dict[str, Any], mask: np.ndarray) -> dict[str, Any]:
    """Return values of ``info`` with the mask of the environments that have them."""
    return values | {f"_{name}": mask for name in values}


_begin = jit_quickly(begin_episodes)


@jit_quickly
def _step_chunks(
    loop: Loop, own: Episodes, now: EpisodeCarry, given: StepInputs
) -> tuple[EpisodeCarry, Records]:
    """Step environments [chunks, together], chunk by chunk."""
    return jax.lax.map(lambda items: step_episodes(loop, *items), (own, now, given))


def __getattr__(name: str) -> Any:
    """Return what makes a vector environment of an id, such as ``merger-v1``, for
    Gymnasium's entry points.
    """
    try:
        return partial(InteractionVectorEnv, ENVIRONMENTS[scenario_name(name)])
    except ValueError:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}") from None
