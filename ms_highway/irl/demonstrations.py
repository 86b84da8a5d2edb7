"""Record demonstrations of driving as Minari data sets, and read them."""

import shutil
import warnings
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from importlib.metadata import version
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import gymnasium as gym
import jax
import numpy as np

from ms_highway.envs import DEMONSTRATION_ID, DemonstrationEnv
from ms_highway.envs.demonstration import DENSITIES, KEYBOARD_ACTION, demonstration_game
from ms_highway.envs.keyboard import check_display
from ms_highway.game.scenario import TIME_STEP
from ms_highway.irl import DEMONSTRATORS, TEMPERATURE
from ms_highway.irl.demonstrator import DRIVER_WEIGHTS, maxent, seen_from
from ms_highway.irl.recording import Recording, fingerprint
from ms_highway.runtime.extras import needing
from ms_highway.runtime.files import check_writable, naming

if TYPE_CHECKING:
    from minari import MinariDataset
    from minari.data_collector import EpisodeBuffer

DATASET_FORMAT = 1
"""Version of recorded data sets; `load_demonstrations` reads no other."""

PROVENANCE = "ms_highway"
"""Key of the settings with which a data set was recorded, in its metadata."""

BROKEN = (
    OSError,
    ValueError,
    LookupError,
    TypeError,
    AssertionError,
    AttributeError,  # of JSON that is no mapping
    RuntimeError,  # of damaged HDF5
)
"""Errors of Minari and HDF5 for files that are damaged."""

Settings = dict[str, object]  # with which a data set was recorded


def record(
    driver: str,
    episodes: int,
    dataset: str,
    densities: Sequence[str] = tuple(DENSITIES),
    seed: int = 0,
    temperature: float = TEMPERATURE,
) -> Iterator[int]:
    """Record the episodes that a data set lacks.

    Each is on disk before the next begins.

    Episode k has the seed ``seed + k``, and the densities take turns. Yields the number
    of recorded episodes, at the start and after every episode.

    Args:
        driver: one of `DEMONSTRATORS`.
        episodes: number of episodes of the complete data set.
        dataset: its Minari id, such as ``ms-highway/maxent-v0``.
        densities: of the traffic, see `ms_highway.envs.demonstration.DENSITIES`.
        seed: of the first episode.
        temperature: of the driver ``maxent``, in units of the reward.

    Raises:
        ValueError: for an unknown driver, unknown or no densities, impossible numbers,
            or a data set that was recorded with other settings.
        ImportError: without the packages of the extra ``demonstrations``.
        OSError: if the driver is ``keyboard`` and there is no display.
        KeyboardInterrupt: if the person closes the window; the current episode is
            discarded.
    """
    _check_request(driver, episodes, densities, seed, temperature)
    settings = _settings(driver, densities, seed, temperature)
    data = _data_directory(dataset)
    check_writable(data.parent, directory=True)
    done = _recorded_episodes(data, settings) if data.exists() else 0
    options = _keyboard_options() if driver == "keyboard" else {}
    yield done
    if done >= episodes:
        return
    with closing(gym.make(DEMONSTRATION_ID, **options)) as env:
        for number in range(done, episodes):
            density = densities[number % len(densities)]
            episode = _drive(env, driver, seed + number, density, temperature)
            _store(episode, env, data, dataset, settings)
            yield number + 1


def _check_request(
    driver: str,
    episodes: int,
    densities: Sequence[str],
    seed: int,
    temperature: float,
) -> None:
    """Check what `record` is asked for.

    Raises:
        ValueError: naming what is impossible.
    """
    if driver not in DEMONSTRATORS:
        raise ValueError(
            f"the driver is {driver!r}; give one of {', '.join(DEMONSTRATORS)}"
        )
    if episodes < 1 or seed < 0 or not 0 < temperature < np.inf:
        raise ValueError(
            f"{episodes} episodes from the seed {seed}, with the temperature"
            f" {temperature}; give one episode at least, no negative seed, and a"
            " positive finite temperature"
        )
    if not densities or not {*densities} <= {*DENSITIES}:
        raise ValueError(
            f"the densities are {list(densities)}; give at least one of"
            f" {', '.join(DENSITIES)}"
        )


def _settings(
    driver: str,
    densities: Sequence[str],
    seed: int,
    temperature: float,
) -> Settings:
    """Return the settings that all episodes of a data set share."""
    settings: Settings = {
        "driver": driver,
        "densities": list(densities),
        "first_seed": seed,
    }
    if driver == "maxent":
        settings["temperature"] = float(temperature)
        settings["weights"] = {
            name: float(weight) for name, weight in DRIVER_WEIGHTS.items()
        }
        settings["horizon"] = demonstration_game().planner.horizon
    return settings


def _recorded_episodes(data: Path, settings: Settings) -> int:
    """Return the number of episodes of an existing data set.

    Raises:
        ValueError: if it was recorded with other settings.
    """
    with _opened(data) as (stored, made):
        differences = {
            key: made.get(key)
            for key, value in settings.items()
            if made.get(key) != value
        }
        if differences:
            raise ValueError(f"it was recorded with other settings, {differences}")
        return int(stored.total_episodes)


def _keyboard_options() -> dict[str, Any]:
    """Return the options of an environment in which a person drives.

    Raises:
        OSError: if there is no display.
    """
    check_display()
    config = {
        "action": KEYBOARD_ACTION,
        "manual_control": True,
        "real_time_rendering": True,
    }
    return {"render_mode": "human", "config": config}


def _drive(
    env: gym.Env,
    driver: str,
    seed: int,
    density: str,
    temperature: float,
) -> "EpisodeBuffer":
    """Let a driver drive an episode."""
    from minari.data_collector import EpisodeBuffer

    options = {"config": {"density": density}}
    observation, _ = env.reset(seed=seed, options=options)
    inner = cast(DemonstrationEnv, env.unwrapped)
    taken = []
    observations = [observation]
    rewards = []
    terminations = []
    truncations = []
    for action in actions(driver, inner, seed, temperature):
        observation, reward, terminated, truncated, _ = env.step(action)
        taken.append(action)
        observations.append(observation)
        rewards.append(reward)
        terminations.append(terminated)
        truncations.append(truncated)
        if terminated or truncated:
            break
    return EpisodeBuffer(
        None, seed, options, observations, taken, rewards, terminations, truncations
    )


def actions(
    driver: str,
    env: DemonstrationEnv,
    seed: int,
    temperature: float = TEMPERATURE,
) -> Iterator[np.ndarray]:
    """Yield a driver's actions in an episode that has just begun.

    Args:
        driver: one of `DEMONSTRATORS`.
        env: the environment; the caller steps it with every action before it takes the
            next one.
        seed: of the driver's random numbers.
        temperature: of the driver ``maxent``.
    """
    if driver == "keyboard":
        while not env.done:  # until the person closes the window
            yield env.action_type.last_action.astype(np.float32)
        raise KeyboardInterrupt
    game = demonstration_game(DRIVER_WEIGHTS)
    horizon = game.planner.horizon
    scale = np.asarray(game.planner.control_scale, dtype=float)
    key = jax.random.key(seed)
    for number in count():
        first = env.steps + 1
        routes = env.routes[:, first : first + horizon]
        car, others = seen_from(env.car_states[0], routes)
        segment_key = jax.random.fold_in(key, number)
        controls = maxent(game, car, others, segment_key, temperature)
        for control in np.asarray(controls, dtype=float) * scale:
            yield env.action_for(control)


def load_demonstrations(dataset: str) -> list[Recording]:
    """Read the episodes of a recorded data set.

    Car 0 is the driver, and every episode is a group.

    Raises:
        ValueError: if there is no such data set, or it is damaged or of another
            version; the message names the problem and the remedy.
        ImportError: without the packages of the extra ``demonstrations``.
    """
    data = _data_directory(dataset)
    if not data.is_dir():
        raise ValueError(
            f"there is no data set {dataset} in {data.parent}; record it with"
            " `ms-highway irl record`"
        )
    with _opened(data) as (stored, made):
        if (made.get("format"), made.get("time_step")) != (DATASET_FORMAT, TIME_STEP):
            raise ValueError("it was not recorded by this version of the package")
        return [
            _episode(f"episode {number}", each.observations)
            for number, each in enumerate(stored)
        ]


def _episode(name: str, observations: np.ndarray) -> Recording:
    """Return the observations of an episode as a recording.

    They are [times, cars, presence and state].
    """
    tracks = np.asarray(observations, dtype=float)
    broken = np.argwhere(~np.isfinite(tracks))
    if len(broken):  # or else cars would seem to be out of sight
        step, car, _ = broken[0]
        raise ValueError(f"{name} is not finite at step {step}, car {car}")
    game = demonstration_game()
    present = tracks[..., :1] == 1
    return Recording(
        name=name,
        group=name,
        states=np.where(present, tracks[..., 1:], np.nan),
        drivers=np.array([0]),
        sizes=np.array([game.scene.car_size] * tracks.shape[1]),
        lanes=np.asarray(game.scene.lanes),
        lane_width=float(game.scene.lane_width),
        speed_limit=float(game.robot.speed_limit),
        measured=False,
        fingerprint=fingerprint(tracks),
    )


def _data_directory(dataset: str) -> Path:
    """Return the directory of a data set's files.

    Raises:
        ValueError: if the name cannot be the name of a data set.
        ImportError: without the packages of the extra ``demonstrations``.
    """
    with needing("demonstrations"):
        import h5py  # noqa: F401
        import minari  # noqa: F401
        from minari.dataset.minari_dataset import parse_dataset_id
        from minari.namespace import validate_namespace
        from minari.storage import get_dataset_path

    try:
        namespace, *_ = parse_dataset_id(dataset)
        if namespace:
            validate_namespace(namespace)  # which needs two characters
    except ValueError as error:
        raise ValueError(
            f"{dataset!r} names no data set ({error}); name it like"
            " ms-highway/maxent-v0"
        ) from error
    return get_dataset_path(dataset) / "data"


@contextmanager
def _opened(data: Path) -> Iterator[tuple["MinariDataset", Settings]]:
    """Yield an existing data set and the settings with which it was recorded.

    Raises:
        ValueError: in place of any of `BROKEN` in the block, naming the data set.
    """
    import minari

    try:
        stored = minari.MinariDataset(data)
        yield stored, stored.storage.metadata.get(PROVENANCE) or {}
    except BROKEN as error:
        raise ValueError(
            f"data set {data.parent} cannot be used ({error}); choose another, or"
            " delete it and record it again with `ms-highway irl record`"
        ) from error


def _store(
    episode: "EpisodeBuffer",
    env: gym.Env,
    data: Path,
    dataset: str,
    settings: Settings,
) -> None:
    """Add an episode to a data set."""
    with naming(data), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # as no author is named
        if data.exists():
            _append(episode, data)
        else:
            _create(episode, env, dataset, settings)


def _append(episode: "EpisodeBuffer", data: Path) -> None:
    """Add an episode to an existing data set.

    An HDF5 file is unreadable if its process is stopped while it writes. The episode is
    therefore added to a copy, which then replaces the original.
    """
    import minari

    copy = data.with_name(".part")
    shutil.rmtree(copy, ignore_errors=True)
    shutil.copytree(data, copy)
    minari.MinariDataset(copy).update_dataset_from_buffer([episode])

    # main_data.hdf5 before metadata.json, which counts its episodes.
    for file in sorted(copy.iterdir()):
        file.replace(data / file.name)
    copy.rmdir()


def _create(
    episode: "EpisodeBuffer",
    env: gym.Env,
    dataset: str,
    settings: Settings,
) -> None:
    """Make a data set with its first episode."""
    import minari

    package = version("ms-highway")
    stored = minari.create_dataset_from_buffers(
        dataset,
        [episode],
        env=env,
        algorithm_name=settings["driver"],
        description="Driving on a highway, recorded by `ms-highway irl record`.",
        requirements=[f"ms-highway=={package}"],
    )
    made = {
        "format": DATASET_FORMAT,
        "version": package,
        "time_step": TIME_STEP,
        **settings,
    }
    stored.storage.update_metadata({PROVENANCE: made})
