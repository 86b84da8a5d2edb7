"""Record demonstrations of driving as Minari data sets."""

from collections.abc import Iterator, Sequence
from contextlib import closing
from importlib.metadata import version
from itertools import count
from typing import Any

import gymnasium as gym
import jax
import numpy as np

from ms_highway.envs import DEMONSTRATION_ID, DemonstrationEnv
from ms_highway.envs.demonstration import DENSITIES, KEYBOARD_ACTION, demonstration_game
from ms_highway.envs.viewer import check_display
from ms_highway.game.scenario import TIME_STEP
from ms_highway.irl.recordings import DRIVERS, TEMPERATURE, Driver
from ms_highway.irl.recordings.datasets import FORMAT, add_episode, count_episodes
from ms_highway.irl.recordings.demonstrators import DRIVER_WEIGHTS, maxent, window


def record(
    driver: Driver,
    episodes: int,
    dataset: str,
    densities: Sequence[str] = tuple(DENSITIES),
    seed: int = 0,
    temperature: float = TEMPERATURE,
) -> Iterator[int]:
    """Record the episodes that a data set lacks; each is on disk before the next begins.

    Episode k has the seed ``seed + k`` and the densities in turn. Yields the number of recorded episodes, at the
    start and after every episode.

    Args:
        driver: one of `DRIVERS`.
        episodes: number of episodes of the complete data set.
        dataset: its Minari id, such as ``ms-highway/maxent-v0``.
        densities: of the traffic, see `ms_highway.envs.demonstration.DENSITIES`.
        seed: of the first episode.
        temperature: of the driver ``maxent``, in reward; a person has none.

    Raises:
        ValueError: for arguments out of range, or if the data set was recorded with other settings.
        ImportError: without the packages of the extra ``demonstrations``.
        OSError: if the driver is ``keyboard`` and there is no display.
        KeyboardInterrupt: if the person closes the window; the current episode is discarded.
    """
    provenance = _provenance(driver, densities, seed, temperature)
    if episodes < 1:
        raise ValueError(f"{episodes} episodes are to be recorded; there must be at least one")
    done = count_episodes(dataset, provenance)
    person: dict[str, Any] = {}
    if driver == "keyboard":
        check_display()
        config = {"action": KEYBOARD_ACTION, "manual_control": True, "real_time_rendering": True}
        person = {"render_mode": "human", "config": config}
    yield done
    if done >= episodes:
        return
    with closing(gym.make(DEMONSTRATION_ID, **person)) as env:
        for number in range(done, episodes):
            density = densities[number % len(densities)]
            episode = _drive(env, driver, seed + number, {"config": {"density": density}}, temperature)
            add_episode(episode, dataset, env, provenance)
            yield number + 1


def actions(driver: Driver, env: DemonstrationEnv, seed: int, temperature: float = TEMPERATURE) -> Iterator[np.ndarray]:
    """Yield a driver's actions in an episode that has just begun.

    Args:
        driver: one of `DRIVERS`.
        env: the environment, to be stepped with every action before the next is taken.
        seed: of the driver's random numbers.
        temperature: of the driver ``maxent``.
    """
    if driver == "keyboard":
        while not env.done:  # closing the window ends it
            yield env.action_type.last_action.astype(np.float32)
        raise KeyboardInterrupt
    game = demonstration_game(DRIVER_WEIGHTS)
    horizon, scale = game.planner.horizon, np.asarray(game.planner.control_scale, dtype=float)
    for place in count():
        car, others = window(env.car_states[0], env.routes[:, env.steps + 1 : env.steps + 1 + horizon])
        controls = maxent(game, car, others, jax.random.fold_in(jax.random.key(seed), place), temperature)
        for control in np.asarray(controls, dtype=float) * scale:
            yield env.action_for(control)


def _provenance(driver: Driver, densities: Sequence[str], seed: int, temperature: float) -> dict[str, Any]:
    """Return the metadata of a data set, in types of JSON.

    Raises:
        ValueError: for settings out of range.
    """
    if driver not in DRIVERS:
        raise ValueError(f"unknown driver {driver!r}; the drivers are {', '.join(DRIVERS)}")
    if not densities or set(densities) - set(DENSITIES):
        raise ValueError(f"densities {list(densities)} of traffic are impossible; choose from {', '.join(DENSITIES)}")
    if seed < 0:
        raise ValueError(f"the seed is {seed}; it must not be negative")
    if not 0 < temperature < np.inf:
        raise ValueError(f"the temperature is {temperature}; it must be positive")
    drawn = {
        "temperature": float(temperature),
        "weights": {name: float(weight) for name, weight in DRIVER_WEIGHTS.items()},
        "horizon": demonstration_game().planner.horizon,
    }
    return {
        "format": FORMAT,
        "version": version("ms-highway"),
        "driver": driver,
        "time_step": TIME_STEP,
        "densities": list(densities),
        "first_seed": seed,
        **(drawn if driver == "maxent" else {}),
    }


def _drive(env: gym.Env, driver: Driver, seed: int, options: dict[str, Any], temperature: float) -> Any:
    """Return an episode, as Minari's ``EpisodeBuffer``."""
    from minari.data_collector import EpisodeBuffer

    world, first = env.unwrapped, env.reset(seed=seed, options=options)[0]
    assert isinstance(world, DemonstrationEnv)
    steps = []
    for action in actions(driver, world, seed, temperature):
        steps.append((action, *env.step(action)))
        if any(steps[-1][3:5]):
            break
    taken, observations, *outcomes, _ = map(list, zip(*steps, strict=True))
    return EpisodeBuffer(None, seed, options, [first, *observations], taken, *outcomes)
