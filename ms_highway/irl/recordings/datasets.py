"""Read and write the Minari data sets that hold demonstrations of driving."""

import re
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from ms_highway.envs.demonstration import demonstration_game
from ms_highway.game.scenario import TIME_STEP
from ms_highway.irl.recordings.recording import Recording
from ms_highway.runtime.files import naming, part_of, temporary

__all__ = [
    "FORMAT",
    "add_episode",
    "check_room",
    "count_recorded",
    "data_directory",
    "known_weights",
    "load",
    "step_collector",
]

FORMAT = 1
"""Version of what is written; `load` reads no other."""

PROVENANCE = "ms_highway"  # key in the data set's metadata
DATASET_ID = re.compile(r"([-\w]+/)*[-\w]+-v\d+")
ROOM = 2_000_000  # bytes, for the files of an episode
DATA_FILE, METADATA_FILE = "main_data.hdf5", "metadata.json"
REMEDY = "delete it and record it again with `ms-highway irl record`"


def load(dataset: str) -> list[Recording]:
    """Read the episodes of a recorded data set; car 0 is the driver, and each episode a group.

    Raises:
        ValueError: if there is no such data set, or its episodes are damaged or of another version; the message names
            the problem and the remedy.
        ImportError: without the packages of the extra ``demonstrations``.
    """
    stored, _ = _open(dataset)
    if not len(stored):
        raise ValueError(f"data set {dataset} is empty; record episodes with `ms-highway irl record`")
    episodes = stored.iterate_episodes()  # opens the file once
    return [_recording(f"data set {dataset}, episode {number}", episodes, stored) for number in range(len(stored))]


def known_weights(dataset: str) -> dict[str, float] | None:
    """Return the weights of a data set's driver by name, None if a person drove. Raises what `load` raises."""
    return _open(dataset)[1]["weights"]


def _open(dataset: str) -> tuple[Any, dict[str, Any]]:
    """Open a data set of this version; return Minari's object and the provenance."""
    minari, data = _minari(), data_directory(dataset)
    if not data.is_dir():
        raise ValueError(f"there is no data set {dataset} in {data.parent}; record it with `ms-highway irl record`")
    try:
        stored = minari.MinariDataset(data)
        provenance = stored.storage.metadata.get(PROVENANCE)
    except (OSError, ValueError, KeyError, AssertionError) as error:
        raise ValueError(f"data set {dataset} cannot be read ({error!r}); {REMEDY}") from error
    if not isinstance(provenance, dict):
        raise ValueError(f"data set {dataset} was not recorded by this package; choose another or record one")
    for key, name, expected in (("format", "version", FORMAT), ("time_step", "a time step of", TIME_STEP)):
        if provenance.get(key) != expected:
            raise ValueError(f"data set {dataset} has {name} {provenance.get(key)}, not {expected}; {REMEDY}")
    return stored, provenance


def _recording(name: str, episodes: Iterator[Any], stored: Any) -> Recording:
    """Return the next episode of a data set, checked."""
    try:
        tracks = np.asarray(next(episodes).observations, dtype=float)
    except (OSError, ValueError, KeyError, AssertionError) as error:
        raise ValueError(f"{name} cannot be read ({error!r}); {REMEDY}") from error
    expected = stored.observation_space.shape
    if tracks.ndim != 3 or len(tracks) < 2 or tracks.shape[1:] != expected:
        raise ValueError(f"{name} has observations of shape {tracks.shape}, not {('times > 1', *expected)}; {REMEDY}")
    if not np.isfinite(tracks).all():
        step, car = np.argwhere(~np.isfinite(tracks))[0][:2]
        raise ValueError(f"{name} is not finite at step {step}, car {car}: {tracks[step, car]}; {REMEDY}")
    present, states = tracks[..., 0] == 1, tracks[..., 1:]
    if not present[:, 0].all():
        raise ValueError(f"{name} lacks its driver at step {present[:, 0].argmin()}; {REMEDY}")
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


def _minari() -> Any:
    try:
        import h5py  # noqa: F401
        import minari
    except ImportError as error:
        raise ImportError(
            "demonstrations need the extra 'demonstrations': pip install 'ms-highway[demonstrations]'"
        ) from error
    return minari


def data_directory(dataset: str) -> Path:
    """Return the directory of a data set's files.

    Raises:
        ValueError: if the name is not that of a data set.
        ImportError: without the packages of the extra ``demonstrations``.
    """
    _minari()  # whose error names the extra
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


def step_collector(env: gym.Env, scratch: Path) -> Any:
    """Return Minari's collector of an environment's steps, which keeps them in a scratch directory until stored."""
    collector: Any = _minari().DataCollector

    class Collector(collector):
        datasets_path = property(lambda self: str(scratch), lambda self, _: None)

    return Collector(env)


def count_recorded(dataset: str, data: Path, provenance: dict[str, Any]) -> int:
    """Return the number of recorded episodes; repair the metadata if an earlier recording was stopped.

    Raises:
        ValueError: if the episodes cannot be read or are of another provenance.
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
        raise ValueError(f"data set {dataset} cannot be read ({error!r}); {REMEDY}") from error
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


def add_episode(
    collector: Any, dataset: str, data: Path, env: gym.Env, provenance: dict[str, Any], episode: int, marks: dict
) -> None:
    """Add the episode that a collector holds to a data set, which is whole on disk before and after.

    Args:
        collector: of `step_collector`.
        dataset: the data set's id.
        data: the directory of its files.
        env: the environment that is recorded.
        provenance: metadata of a new data set.
        episode: number of the episode.
        marks: further metadata of the episode, such as the seed, which Minari loses.
    """
    with naming(data), _replacing(dataset, data, env, provenance) as storage:
        collector.add_to_dataset(_minari().MinariDataset(storage))
        storage.update_episode_metadata([marks], [episode])


def check_room(data: Path) -> None:
    """Check that the disk has room for another copy of the data set: HDF5 does not survive a full disk.

    Raises:
        OSError: if it has not; the message names the directory.
    """
    needed = ROOM + sum(file.stat().st_size for file in data.glob("*"))
    free = shutil.disk_usage(data.parent).free
    if free < needed:
        raise OSError(f"{data} needs {needed / 1e6:.0f} MB for another episode; its disk has {free / 1e6:.1f} MB left")


@contextmanager
def _replacing(
    dataset: str, data: Path, env: gym.Env | None = None, provenance: dict[str, Any] | None = None
) -> Iterator[Any]:
    """Yield a copy of a data set's storage, which replaces the original if the block ends without an error.

    A process killed while HDF5 writes leaves an unreadable file, so nothing is written in place. The episodes are
    replaced first, then the metadata, which only count them.

    Args:
        dataset: its id.
        data: the directory of its files; if there is none, the copy is of an empty data set.
        env: the environment of a new data set.
        provenance: metadata of a new data set.
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
    """Return an empty Minari storage with the metadata of a data set."""
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
