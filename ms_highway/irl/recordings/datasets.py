"""Read and write the Minari data sets that hold demonstrations of driving."""

import shutil
import warnings
from importlib.metadata import version
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from ms_highway.envs.demonstration import demonstration_game
from ms_highway.game.scenario import TIME_STEP
from ms_highway.irl.recordings.recording import Recording
from ms_highway.runtime.extras import needing
from ms_highway.runtime.files import check_writable, naming

FORMAT = 1
"""Version of recorded data sets; `load_demonstrations` reads no other."""

PROVENANCE = "ms_highway"  # key in the data set's metadata
BROKEN = OSError, ValueError, LookupError, TypeError, AssertionError  # of Minari and HDF5
REMEDY = "delete it and record it again with `ms-highway irl record`"


def load_demonstrations(dataset: str) -> list[Recording]:
    """Read the episodes of a recorded data set; car 0 is the driver, and each episode a group.

    Raises:
        ValueError: if there is no such data set, or it is damaged or of another version; the message names the problem
            and the remedy.
        ImportError: without the packages of the extra ``demonstrations``.
    """
    data = _data_directory(dataset)
    if not data.is_dir():
        raise ValueError(f"there is no data set {dataset} in {data.parent}; record it with `ms-highway irl record`")
    try:
        stored = _minari().MinariDataset(data)
        provenance = stored.storage.metadata.get(PROVENANCE) or {}
        known = (provenance.get("format"), provenance.get("time_step")) == (FORMAT, TIME_STEP)
        episodes = [np.asarray(each.observations, dtype=float) for each in (stored.iterate_episodes() if known else ())]
        recordings = [_recording(f"episode {number}", tracks) for number, tracks in enumerate(episodes)]
    except BROKEN as error:
        raise ValueError(f"data set {dataset} cannot be read ({error}); {REMEDY}") from error
    if not recordings:
        reason = "is empty" if known else "was not recorded by this version of the package"
        raise ValueError(f"data set {dataset} {reason}; choose another, or record one with `ms-highway irl record`")
    return recordings


def _recording(name: str, tracks: np.ndarray) -> Recording:
    """Return an episode's observations [times, cars, presence and state] as a recording.

    Raises:
        ValueError: if they are not finite: cars would seem to be out of sight.
    """
    if not np.isfinite(tracks).all():
        step, car, _ = np.argwhere(~np.isfinite(tracks))[0]
        raise ValueError(f"{name} is not finite at step {step}, car {car}")
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


def _data_directory(dataset: str) -> Path:
    """Return the directory of a data set's files.

    Raises:
        ValueError: if the name is not that of a data set.
        ImportError: without the packages of the extra ``demonstrations``.
    """
    _minari()  # whose error names the extra
    from minari.dataset.minari_dataset import parse_dataset_id
    from minari.namespace import validate_namespace
    from minari.storage import get_dataset_path

    try:
        namespace, *_ = parse_dataset_id(dataset)
        if namespace:
            validate_namespace(namespace)  # which needs two characters
    except ValueError as error:
        raise ValueError(f"{dataset!r} names no data set ({error}); name it like ms-highway/maxent-v0") from error
    return get_dataset_path(dataset) / "data"


def count_episodes(dataset: str, provenance: dict[str, Any]) -> int:
    """Return the number of episodes that a data set already has.

    Raises:
        ValueError: if the data set cannot be read or has another provenance.
        OSError: if no episode can be added to it.
    """
    data = _data_directory(dataset)
    check_writable(data.parent, directory=True)
    if not data.exists():
        return 0
    try:
        stored = _minari().MinariDataset(data)
        known = stored.storage.metadata.get(PROVENANCE) or {}
    except BROKEN as error:
        raise ValueError(f"data set {dataset} cannot be read ({error!r}); {REMEDY}") from error
    differences = {key: known.get(key) for key, value in provenance.items() if known.get(key) != value}
    if differences:
        raise ValueError(
            f"data set {dataset} holds recordings of other settings, {differences}; choose another name or the same "
            "settings"
        )
    return int(stored.total_episodes)


def add_episode(episode: Any, dataset: str, env: gym.Env, provenance: dict[str, Any]) -> None:
    """Add an episode to a data set.

    HDF5 files are unreadable if a process is stopped while it writes them; so episodes are added to a copy, which then
    takes the place of the original.

    Args:
        episode: Minari's ``EpisodeBuffer``.
        dataset: the data set's id.
        env: the environment that is recorded.
        provenance: metadata of a new data set.
    """
    minari, data = _minari(), _data_directory(dataset)
    with naming(data), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # about authors who are not named
        if data.exists():
            copy = data.with_name(".part")
            shutil.rmtree(copy, ignore_errors=True)
            shutil.copytree(data, copy)
            minari.MinariDataset(copy).update_dataset_from_buffer([episode])
            for file in sorted(copy.iterdir()):  # main_data.hdf5 before metadata.json, which counts its episodes
                file.replace(data / file.name)
            copy.rmdir()
            return
        stored = minari.create_dataset_from_buffers(
            dataset,
            [episode],
            env=env,
            algorithm_name=provenance["driver"],
            description="Driving on a highway, recorded by `ms-highway irl record`.",
            requirements=[f"ms-highway=={version('ms-highway')}"],
        )
        stored.storage.update_metadata({PROVENANCE: provenance})
