"""Read and write the Minari data sets that hold demonstrations of driving."""

import re
import shutil
from importlib.metadata import version
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from ms_highway.envs.demonstration import demonstration_game
from ms_highway.game.scenario import TIME_STEP
from ms_highway.irl.recordings.recording import Recording
from ms_highway.runtime.extras import needing
from ms_highway.runtime.files import naming, part_of, temporary

FORMAT = 1
"""Version of what is written; `load_demonstrations` reads no other."""

PROVENANCE = "ms_highway"  # key in the data set's metadata
DATASET_ID = re.compile(r"([-\w]+/)*[-\w]+-v\d+")
ROOM = 2_000_000  # bytes, for the files of an episode
DATA_FILE, METADATA_FILE = "main_data.hdf5", "metadata.json"
BROKEN = OSError, ValueError, KeyError, AssertionError  # of Minari and HDF5
REMEDY = "delete it and record it again with `ms-highway irl record`"


def load_demonstrations(dataset: str) -> list[Recording]:
    """Read the episodes of a recorded data set; car 0 is the driver, and each episode a group.

    Raises:
        ValueError: if there is no such data set, or its episodes are damaged or of another version; the message names
            the problem and the remedy.
        ImportError: without the packages of the extra ``demonstrations``.
    """
    minari, data = _minari(), data_directory(dataset)
    if not data.is_dir():
        raise ValueError(f"there is no data set {dataset} in {data.parent}; record it with `ms-highway irl record`")
    try:
        stored = minari.MinariDataset(data)
        provenance = stored.storage.metadata.get(PROVENANCE)
    except BROKEN as error:
        raise ValueError(f"data set {dataset} cannot be read ({error!r}); {REMEDY}") from error
    if not isinstance(provenance, dict):
        raise ValueError(f"data set {dataset} was not recorded by this package; choose another or record one")
    for key, name, expected in (("format", "version", FORMAT), ("time_step", "a time step of", TIME_STEP)):
        if provenance.get(key) != expected:
            raise ValueError(f"data set {dataset} has {name} {provenance.get(key)}, not {expected}; {REMEDY}")
    if not len(stored):
        raise ValueError(f"data set {dataset} is empty; record episodes with `ms-highway irl record`")
    episodes, expected = stored.iterate_episodes(), stored.observation_space.shape  # opens the file once
    recordings = []
    for number in range(len(stored)):
        name = f"data set {dataset}, episode {number}"
        try:
            recordings.append(_recording(name, np.asarray(next(episodes).observations, dtype=float), expected))
        except BROKEN as error:
            raise ValueError(f"{name} cannot be read ({error}); {REMEDY}") from error
    return recordings


def _recording(name: str, tracks: np.ndarray, expected: tuple[int, ...]) -> Recording:
    """Return an episode's observations [times, cars, presence and state] as a recording."""
    if tracks.shape[1:] != expected:
        raise ValueError(f"its observations have the shape {tracks.shape}, not {('times', *expected)}")
    if not np.isfinite(tracks).all():
        step, car = np.argwhere(~np.isfinite(tracks))[0][:2]
        raise ValueError(f"it is not finite at step {step}, car {car}: {tracks[step, car]}")
    game = demonstration_game()
    return Recording(
        name=name,
        group=name,
        states=np.where(tracks[..., :1] == 1, tracks[..., 1:], np.nan),
        drivers=np.array([0]),
        sizes=np.tile(game.scene.car_size, (tracks.shape[1], 1)),
        lanes=game.scene.lanes,
        lane_width=game.scene.lane_width,
        speed_limit=game.robot.speed_limit,
        measured=False,
    )


def _minari() -> Any:
    with needing("demonstrations"):
        import h5py  # noqa: F401
        import minari
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

    try:
        if not DATASET_ID.fullmatch(dataset):
            raise ValueError("it is not NAMESPACE/NAME-vNUMBER")
        if "/" in dataset:
            validate_namespace(dataset.rpartition("/")[0])  # which needs two characters
    except ValueError as error:
        remedy = "name it like ms-highway/maxent-v0"
        raise ValueError(f"{dataset!r} is no name for a data set ({error}); {remedy}") from error
    return get_dataset_path(dataset) / "data"


def count_recorded(dataset: str, data: Path, provenance: dict[str, Any]) -> int:
    """Return the number of recorded episodes; correct the metadata if an earlier recording was stopped.

    Raises:
        ValueError: if the episodes cannot be read or are of another provenance.
    """
    if not data.exists():
        return 0
    import h5py

    try:
        storage = _minari().MinariDataset(data).storage
        known = storage.metadata
        with h5py.File(data / DATA_FILE) as file:
            steps = [int(episode.attrs["total_steps"]) for episode in file.values()]
    except BROKEN as error:
        raise ValueError(f"data set {dataset} cannot be read ({error!r}); {REMEDY}") from error
    if known.get(PROVENANCE) != provenance:
        theirs = known.get(PROVENANCE) or {}
        differences = {key: theirs.get(key) for key in provenance if theirs.get(key) != provenance[key]}
        raise ValueError(
            f"data set {dataset} holds recordings of other settings, {differences if theirs else 'made elsewhere'}; "
            "choose another name or the same settings"
        )
    if known["total_episodes"] != len(steps):  # stopped after the episodes and before the metadata were replaced
        storage.update_metadata({"total_episodes": len(steps), "total_steps": sum(steps)})
    return len(steps)


def add_episode(episode: Any, dataset: str, data: Path, env: gym.Env, provenance: dict[str, Any]) -> None:
    """Add an episode to a data set, which is whole on disk before and after.

    A process killed while HDF5 writes leaves an unreadable file, so a copy is written and then takes the place of the
    original: the episodes first, then the metadata, which only count them.

    Args:
        episode: Minari's ``EpisodeBuffer``.
        dataset: the data set's id.
        data: the directory of its files.
        env: the environment that is recorded.
        provenance: metadata of a new data set.
    """
    minari = _minari()
    from minari.dataset.minari_storage import MinariStorage
    from minari.namespace import create_namespace, list_local_namespaces

    with naming(data), temporary(part_of(data)) as copy:
        if data.exists():
            shutil.copytree(data, copy)
            minari.MinariDataset(copy).update_dataset_from_buffer([episode])
            for name in (DATA_FILE, METADATA_FILE):
                (copy / name).replace(data / name)
            return
        namespace = dataset.rpartition("/")[0]
        if namespace and namespace not in list_local_namespaces():
            create_namespace(namespace)
        data.parent.mkdir(parents=True, exist_ok=True)
        storage = MinariStorage.new(copy, env.observation_space, env.action_space, env.spec)
        storage.update_metadata(
            {
                "dataset_id": dataset,
                "minari_version": minari.__version__,
                "algorithm_name": provenance["driver"],
                "description": "Driving on a highway, recorded by `ms-highway irl record`.",
                "requirements": [f"ms-highway=={version('ms-highway')}"],
                PROVENANCE: provenance,
            }
        )
        storage.update_episodes([episode])
        copy.rename(data)


def check_room(data: Path) -> None:
    """Check that the disk has room for another copy of the data set: HDF5 does not survive a full disk.

    Raises:
        OSError: if it has not; the message names the directory.
    """
    needed = ROOM + sum(file.stat().st_size for file in data.glob("*"))
    free = shutil.disk_usage(data.parent).free
    if free < needed:
        raise OSError(f"{data} needs {needed / 1e6:.0f} MB for another episode; its disk has {free / 1e6:.1f} MB left")
