"""Demonstrations of driving, recorded in Minari's data sets and read from them."""

import re
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib.metadata import version
from itertools import count
from pathlib import Path
from typing import Any, Literal, TypeAlias

import gymnasium as gym
import jax
import numpy as np
from jaxtyping import Float

from ms_highway.control.fixed import FixedModel
from ms_highway.envs import DEMONSTRATION_ID, DemonstrationEnv
from ms_highway.envs.demonstration import KEYBOARD_ACTION, demonstration_game
from ms_highway.envs.graphics import check_display
from ms_highway.envs.routes import DENSITIES
from ms_highway.game.scenario import COMMON_WEIGHTS, TIME_STEP
from ms_highway.irl.recordings.demonstrators import DRIVER_WEIGHTS, TEMPERATURE, maxent, optimal, window
from ms_highway.irl.recordings.recording import Recording
from ms_highway.planning.human_models import Naive
from ms_highway.runtime.files import held, naming, part_of, temporary, tidy

__all__ = ["DRIVERS", "Driver", "actions", "known_weights", "load", "record"]

Driver: TypeAlias = Literal["keyboard", "optimal", "maxent", "mpc"]

DRIVERS: dict[Driver, str] = {
    "keyboard": "a person, with the arrow keys",
    "optimal": "window by window, the local optimum of the reward among cars whose routes it knows",
    "maxent": "like optimal, but its controls are drawn from p(u) ~ exp(R(u) / temperature)",
    "mpc": "the package's planner, which replans every step and expects the others to keep their velocity",
}
"""The drivers that can be recorded, and what they do."""

FORMAT = 1  # version of what is written; `load` reads no other
PROVENANCE = "ms_highway"  # key of the data set's metadata
DATASET_ID = re.compile(r"([-\w]+/)*[-\w]+-v\d+")
ROOM = 2_000_000  # bytes, for the files of an episode
DATA_FILE, METADATA_FILE = "main_data.hdf5", "metadata.json"
INSTALL = "pip install 'ms-highway[demonstrations]'"
AGAIN = "delete it and record it again with `ms-highway irl record`"


def record(
    driver: Driver,
    episodes: int,
    dataset: str,
    densities: Sequence[str] = tuple(DENSITIES),
    seed: int = 0,
    temperature: float = TEMPERATURE,
) -> Iterator[int]:
    """Record the episodes that a data set lacks; each is on disk, whole, before the next begins.

    Episode k is seeded with ``seed + k`` and has the densities in turn. Yields how many episodes there are: first what
    an earlier recording has left, then after every episode.

    Args:
        driver: who drives, see `DRIVERS`.
        episodes: how many the data set shall have.
        dataset: its Minari id, such as ``ms-highway/maxent-v0``.
        densities: of the traffic, see `ms_highway.envs.routes.DENSITIES`.
        seed: of the first episode.
        temperature: of the driver ``maxent``; others have none.

    Raises:
        ValueError: for impossible arguments, or if the data set holds recordings of other settings.
        ImportError: without the packages of the extra ``demonstrations``.
        OSError: if a person shall drive and there is no display.
        KeyboardInterrupt: if the person closes the window; the episode at hand is not kept.
    """
    minari, data = _minari(), _data_directory(dataset)
    provenance = _provenance(driver, densities, seed, temperature)
    if episodes < 1:
        raise ValueError(f"{episodes} episodes are to be recorded; there must be at least one")
    if driver == "keyboard":
        check_display()
    with held(data.parent), temporary(part_of(data)) as scratch:
        done = _take_up(dataset, data, provenance)
        tidy(data.parent)
        yield done
        if done >= episodes:
            return
        scratch.mkdir()
        env = _environment(driver)
        collector = _collector(minari, env, scratch)
        try:
            for episode in range(done, episodes):
                _check_room(data)
                density = densities[episode % len(densities)]
                _drive(collector, driver, seed + episode, density, temperature)
                with naming(data), _replacing(dataset, data, env, provenance) as storage:
                    copy = minari.MinariDataset(storage)
                    collector.add_to_dataset(copy)
                    marks = {"seed": seed + episode, "density": density}  # Minari loses the seed on the way
                    storage.update_episode_metadata([marks], [episode])
                yield episode + 1
        finally:
            collector.close()


def actions(
    driver: Driver, env: DemonstrationEnv, seed: int, temperature: float = TEMPERATURE
) -> Iterator[Float[np.ndarray, "2"]]:
    """The actions of a driver in an episode that has just begun; each is chosen when it is asked for.

    Args:
        driver: who drives, see `DRIVERS`.
        env: where; it is to be stepped with every action before the next is asked for.
        seed: of the driver's random numbers.
        temperature: of the driver ``maxent``.
    """
    if driver == "keyboard":
        while not env.done:  # closing the window ends it
            yield env.action_type.last_action.astype(np.float32)
        raise KeyboardInterrupt
    if driver == "mpc":
        controller = FixedModel(env.game, Naive())
        while True:
            yield env.action_for(controller.step(env.car_states).control)
    game = demonstration_game(DRIVER_WEIGHTS)
    horizon, scale = game.planner.horizon, np.asarray(game.planner.control_scale, dtype=float)
    for place in count():
        soon = slice(env.steps + 1, env.steps + 1 + horizon)
        car, others = window(env.car_states[0], env.routes[:, soon])
        if driver == "optimal":
            controls = optimal(game, car, others).controls
        else:
            controls = maxent(game, car, others, jax.random.fold_in(jax.random.key(seed), place), temperature)
        for control in np.asarray(controls, dtype=float) * scale:
            yield env.action_for(control)


def load(dataset: str) -> list[Recording]:
    """The episodes of a data set that `record` has made, car 0 being the driver, each a group of its own.

    Raises:
        ValueError: if there is no such data set, or it does not hold whole, finite episodes of this version, naming
            what is wrong and the remedy.
        ImportError: without the packages of the extra ``demonstrations``.
    """
    stored, _ = _open(dataset)
    if not len(stored):
        raise ValueError(f"data set {dataset} is empty; record episodes with `ms-highway irl record`")
    episodes = stored.iterate_episodes()  # opens the file once
    return [_recording(f"data set {dataset}, episode {number}", episodes, stored) for number in range(len(stored))]


def known_weights(dataset: str) -> dict[str, float] | None:
    """What the driver of a data set drove for, by name; None of a person. Raises what `load` raises."""
    return _open(dataset)[1]["weights"]


def _open(dataset: str) -> tuple[Any, dict[str, Any]]:
    """A data set of this version, as Minari has it, and how it was made."""
    minari, data = _minari(), _data_directory(dataset)
    if not data.is_dir():
        raise ValueError(f"there is no data set {dataset} in {data.parent}; record it with `ms-highway irl record`")
    try:
        stored = minari.MinariDataset(data)
        provenance = stored.storage.metadata.get(PROVENANCE)
    except (OSError, ValueError, KeyError, AssertionError) as error:
        raise ValueError(f"data set {dataset} cannot be read ({error!r}); {AGAIN}") from error
    if not isinstance(provenance, dict):
        raise ValueError(f"data set {dataset} was not recorded by this package; choose another or record one")
    for key, name, expected in (("format", "version", FORMAT), ("time_step", "a time step of", TIME_STEP)):
        if provenance.get(key) != expected:
            raise ValueError(f"data set {dataset} has {name} {provenance.get(key)}, not {expected}; {AGAIN}")
    return stored, provenance


def _minari() -> Any:
    try:
        import h5py  # noqa: F401
        import minari
    except ImportError as error:
        raise ImportError(
            "demonstrations need the extra 'demonstrations': pip install 'ms-highway[demonstrations]'"
        ) from error
    return minari


def _data_directory(dataset: str) -> Path:
    """Where Minari keeps a data set's files."""
    from minari.namespace import validate_namespace
    from minari.storage import get_dataset_path

    namespace = dataset.rpartition("/")[0]
    try:
        if not DATASET_ID.fullmatch(dataset):
            raise ValueError("it is not NAMESPACE/NAME-vNUMBER")
        if namespace:
            validate_namespace(namespace)  # which needs two characters
    except ValueError as error:
        remedy = "name it like ms-highway/maxent-v0"
        raise ValueError(f"{dataset!r} is no name for a data set ({error}); {remedy}") from error
    return get_dataset_path(dataset) / "data"


def _provenance(driver: Driver, densities: Sequence[str], seed: int, temperature: float) -> dict[str, Any]:
    """What a data set says about how it was made, in words of JSON.

    Raises:
        ValueError: for impossible settings.
    """
    if driver not in DRIVERS:
        raise ValueError(f"unknown driver {driver!r}; the drivers are {', '.join(DRIVERS)}")
    unknown = [density for density in densities if density not in DENSITIES]
    if unknown or not densities:
        raise ValueError(f"densities {list(densities)} of traffic are impossible; choose from {', '.join(DENSITIES)}")
    if seed < 0:
        raise ValueError(f"the seed is {seed}; it must not be negative")
    if driver == "maxent" and not 0 < temperature < np.inf:
        raise ValueError(f"the temperature is {temperature}; it must be positive")
    weights = {"keyboard": None, "mpc": COMMON_WEIGHTS}.get(driver, DRIVER_WEIGHTS)
    return {
        "format": FORMAT,
        "version": version("ms-highway"),
        "driver": driver,
        "temperature": float(temperature) if driver == "maxent" else None,
        "weights": None if weights is None else {name: float(weight) for name, weight in weights.items()},
        "horizon": None if driver == "keyboard" else demonstration_game().planner.horizon,
        "time_step": TIME_STEP,
        "densities": list(densities),
        "first_seed": seed,
    }


def _collector(minari: Any, env: gym.Env, scratch: Path) -> Any:
    """Minari's collector of an environment's steps, which keeps them in a directory of ours until they are stored."""

    class Collector(minari.DataCollector):
        datasets_path = property(lambda self: str(scratch), lambda self, _: None)

    return Collector(env)


def _check_room(data: Path) -> None:
    """Refuse to drive where the disk has no room for another copy of the data set: HDF5 does not survive a full disk.

    Raises:
        OSError: naming the place.
    """
    needed = ROOM + sum(file.stat().st_size for file in data.glob("*"))
    free = shutil.disk_usage(data.parent).free
    if free < needed:
        raise OSError(f"{data} needs {needed / 1e6:.0f} MB for another episode; its disk has {free / 1e6:.1f} MB left")


def _environment(driver: Driver) -> gym.Env:
    if driver == "keyboard":
        config = {"action": KEYBOARD_ACTION, "manual_control": True, "real_time_rendering": True}
        return gym.make(DEMONSTRATION_ID, render_mode="human", config=config)
    return gym.make(DEMONSTRATION_ID)


def _drive(collector: gym.Env, driver: Driver, seed: int, density: str, temperature: float) -> None:
    """Drive one episode."""
    collector.reset(seed=seed, options={"config": {"density": density}})
    env = collector.unwrapped
    assert isinstance(env, DemonstrationEnv)
    for action in actions(driver, env, seed, temperature):
        _, _, terminated, truncated, _ = collector.step(action)
        if terminated or truncated:
            return


def _take_up(dataset: str, data: Path, provenance: dict[str, Any]) -> int:
    """The number of episodes that are there already; what a stopped recording left in disorder is put in order.

    Raises:
        ValueError: if they are not of this provenance.
    """
    if not data.exists():
        return 0
    import h5py
    from minari.dataset.minari_storage import MinariStorage

    try:
        known = MinariStorage.read_raw_metadata(data)
        with h5py.File(data / DATA_FILE, "r") as file:
            steps = [int(file[name].attrs["total_steps"]) for name in file]
    except (OSError, ValueError, KeyError) as error:
        raise ValueError(f"data set {dataset} cannot be read ({error!r}); {AGAIN}") from error
    theirs = known.get(PROVENANCE)
    if theirs != provenance:
        differences = (
            {key: theirs.get(key) for key in provenance if theirs.get(key) != provenance[key]} if theirs else {}
        )
        raise ValueError(
            f"data set {dataset} holds recordings of other settings, {differences or 'made elsewhere'}; "
            "choose another name or the same settings"
        )
    if known["total_episodes"] != len(steps):  # stopped after the episodes and before the metadata were replaced
        with _replacing(dataset, data) as storage:
            storage.update_metadata({"total_episodes": len(steps), "total_steps": sum(steps)})
    return len(steps)


@contextmanager
def _replacing(
    dataset: str, data: Path, env: gym.Env | None = None, provenance: dict[str, Any] | None = None
) -> Iterator[Any]:
    """A copy of a data set's storage that takes its place when the block ends well.

    Whoever is killed while HDF5 writes leaves a file that nobody can read, so nothing is ever written in place. The
    episodes are replaced first and the metadata, which only count them, then.

    Args:
        dataset: its id.
        data: the directory of its files; if there is none, the copy is of an empty data set.
        env: where a new data set is recorded.
        provenance: what a new data set says about how it was made.
    """
    from minari.dataset.minari_storage import MinariStorage

    with temporary(part_of(data)) as copy:
        if data.exists():
            shutil.copytree(data, copy)
            yield MinariStorage.read(copy)
            for name in (DATA_FILE, METADATA_FILE):
                (copy / name).replace(data / name)
        else:
            assert env is not None
            yield _new_storage(dataset, copy, env, provenance)
            copy.rename(data)


def _new_storage(dataset: str, directory: Path, env: gym.Env, provenance: dict[str, Any] | None) -> Any:
    """An empty storage of Minari's, with the metadata that make it a data set."""
    import minari
    from minari.dataset.minari_storage import MinariStorage
    from minari.namespace import create_namespace, list_local_namespaces

    namespace = dataset.rpartition("/")[0]
    if namespace and namespace not in list_local_namespaces():
        create_namespace(namespace)
    directory.parent.mkdir(parents=True, exist_ok=True)
    storage = MinariStorage.new(directory, env.observation_space, env.action_space, env.spec)
    storage.update_metadata(
        {
            "dataset_id": dataset,
            "minari_version": minari.__version__,
            "algorithm_name": provenance["driver"] if provenance else "",
            "description": "Driving on a highway, recorded by `ms-highway irl record`.",
            "requirements": [f"ms-highway=={version('ms-highway')}"],
            PROVENANCE: provenance,
        }
    )
    return storage


def _recording(name: str, episodes: Iterator[Any], stored: Any) -> Recording:
    """The next episode of a data set, checked."""
    try:
        tracks = np.asarray(next(episodes).observations, dtype=float)
    except (OSError, ValueError, KeyError, AssertionError) as error:
        raise ValueError(f"{name} cannot be read ({error!r}); {AGAIN}") from error
    expected = stored.observation_space.shape
    if tracks.ndim != 3 or len(tracks) < 2 or tracks.shape[1:] != expected:
        raise ValueError(f"{name} has observations of shape {tracks.shape}, not {('times > 1', *expected)}; {AGAIN}")
    if not np.isfinite(tracks).all():
        step, car = np.argwhere(~np.isfinite(tracks))[0][:2]
        raise ValueError(f"{name} is not finite at step {step}, car {car}: {tracks[step, car]}; {AGAIN}")
    present, states = tracks[..., 0] == 1, tracks[..., 1:]
    if not present[:, 0].all():
        raise ValueError(f"{name} lacks its driver at step {present[:, 0].argmin()}; {AGAIN}")
    game = demonstration_game()
    return Recording(
        name=name,
        group=name,
        time_step=TIME_STEP,
        states=np.where(present[..., None], states, np.nan),
        drivers=np.array([0]),
        sizes=np.tile(np.asarray(game.scene.car_size, dtype=float), (tracks.shape[1], 1)),
        lanes=np.asarray(game.scene.lanes, dtype=float),
        lane_width=float(game.scene.lane_width),
        speed_limit=float(game.robot.speed_limit),
        measured=False,
    )
