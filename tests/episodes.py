"""Episodes of the environments: how tests make and drive them."""

from collections.abc import Callable
from typing import Any, NamedTuple

import gymnasium as gym
import jax
import numpy as np
import pytest

from ms_highway.envs import environment_id
from ms_highway.envs.registry import controller_config

TWO = {"humans": 2, "horizon": 5, "costs": "published"}
"""Configuration of a small scene with several humans."""

PIXELS = {
    "type": "GrayscaleObservation",
    "observation_shape": (64, 64),
    "stack_size": 1,
    "weights": [0.3, 0.6, 0.1],
}


def drives_long(test: Callable[..., None]) -> Any:
    """Mark a test as slow, and compile with optimisations in it."""
    return pytest.mark.slow(pytest.mark.usefixtures("optimized")(test))


class Episode(NamedTuple):
    """The environment after an episode, and what happened in it.

    Attributes:
        env: the environment without its wrappers.
        states: before the first and after every step.
        rewards: of every step.
        infos: of every step.
    """

    env: Any
    states: np.ndarray
    rewards: np.ndarray
    infos: list[dict[str, Any]]


def make(
    scenario: str,
    controller: str = "naive",
    render_mode: str | None = None,
    **config: Any,
) -> gym.Env:
    config = {
        "controller": controller_config(controller),
        **(TWO if scenario == "dense_merge" else {}),
        **config,
    }
    return gym.make(environment_id(scenario), render_mode=render_mode, config=config)


def drive(
    env: gym.Env, seed: int = 0, starts: Any = None, steps: int | None = None
) -> Episode:
    env.reset(seed=seed, options=None if starts is None else {"initial_states": starts})
    states = [env.unwrapped.car_states]
    rewards = []
    infos = []
    done = False
    while not done and len(infos) != steps:
        _, reward, terminated, truncated, info = env.step(0)
        done = terminated or truncated
        states.append(env.unwrapped.car_states)
        rewards.append(reward)
        infos.append(info)
    return Episode(env.unwrapped, np.array(states), np.array(rewards), infos)


def form(info: dict[str, Any]) -> dict[str, tuple]:
    """Return the type and the shape of everything in an ``info``, by its path.

    Recorders want them to be constant.
    """
    parts = jax.tree.leaves_with_path(
        info, is_leaf=lambda value: not isinstance(value, dict)
    )
    forms = {}
    for path, value in parts:
        kind = getattr(value, "dtype", type(value))
        forms[jax.tree_util.keystr(path)] = kind, np.shape(value)
    return forms
