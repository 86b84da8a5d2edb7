"""Cut recorded driving into windows: a driver's controls over a plan's horizon, and its neighbours."""

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import jax
import numpy as np
from jax import numpy as jnp
from jaxtyping import Float

from ms_highway.game.dynamics import Motion, keep_velocity, observe
from ms_highway.game.features import motion_features
from ms_highway.game.game import Game, move
from ms_highway.game.neighbours import far_behind, places
from ms_highway.game.reward import FEATURES, features_for
from ms_highway.game.scenario import PAPER_DYNAMICS, PAPER_UNIT, PHYSICAL_LIMIT, TIME_STEP, driving_game
from ms_highway.game.scene import Scene
from ms_highway.irl.arrays import CarStates, Controls, Flags, Numbers, States, Values
from ms_highway.irl.recordings.recording import Recording, number_groups, track_of
from ms_highway.runtime.arrays import Trajectory
from ms_highway.runtime.compilation import in_batches, jit_quickly

KINK = 0.05  # sine of the heading below which noise may turn the car to either side
SATURATED = 0.8  # of the limits of plans
LANES = 6  # at least, so that one compilation serves most roads


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Windows:
    """Windows of K steps: arrays of NumPy or JAX, in SI units, with a leading axis [n]; without it, one window.

    Attributes:
        scenes: the road and the driver's own size, every array with the leading axis.
        speed_limit: of the road [m/s].
        start: the driver before the first step.
        controls: of the driver, unscaled.
        others: its six neighbours (see `ms_highway.game.neighbours`) after each step, wherever they went.
        driver: number of the driver among all recordings; windows of one follow each other.
        group: number of the recording's group, to split by.
    """

    scenes: Scene
    speed_limit: Values
    start: States
    controls: Controls
    others: Float[Any, "*n 6 K 4"]
    driver: Numbers
    group: Numbers

    def __len__(self) -> int:
        return len(self.start)

    def of(self, chosen: Flags) -> "Windows":
        """Return the chosen windows."""
        return jax.tree.map(lambda numbers: numbers[chosen], self)


def padded_lanes(recordings: Sequence[Recording]) -> list[Values]:
    """Return every recording's lanes, padded to one number by repeating the last, which changes no feature."""
    most = max((LANES, *(len(item.lanes) for item in recordings)))
    return [np.pad(np.asarray(item.lanes, float), (0, most - len(item.lanes)), mode="edge") for item in recordings]


def regular_windows(recordings: Sequence[Recording], steps: int) -> Windows:
    """Cut the drivers' tracks into consecutive windows without overlap; return the `regular` ones.

    Args:
        recordings: the recordings to cut.
        steps: K, the length of a window.

    Raises:
        ValueError: if no window is regular.
    """
    groups, rows, numbers = number_groups(recordings), [], itertools.count()
    for recording, lanes in zip(recordings, padded_lanes(recordings), strict=True):
        everyone = _coasting(recording.states)
        for driver in recording.drivers:
            track, marks = track_of(recording, driver, PAPER_DYNAMICS), (next(numbers), groups[recording.group])
            scene = Scene(
                lanes=lanes,
                lane_width=recording.lane_width,
                obstacles=np.empty((0, 2)),
                obstacle_size=np.ones(2),
                car_size=recording.sizes[driver],
                corner=0.5,
                target_lane=lanes[0],
                length_unit=PAPER_UNIT,
            )
            for first in range(0, len(track.controls) - steps + 1, steps):
                start, now = track.states[first], recording.seen[:, driver].argmax() + first
                present = recording.seen[now] & (np.arange(recording.states.shape[1]) != driver)
                cars, taken = places(start, everyone[now], present, recording.lane_width)
                paths = np.moveaxis(everyone[now + 1 : now + steps + 1, cars], 0, 1)
                others = np.where(taken[:, None, None], paths, far_behind(start))
                controls = track.controls[first : first + steps]
                rows.append(Windows(scene, recording.speed_limit, start, controls, others, *marks))
    windows = jax.tree.map(lambda *parts: np.stack(parts), *rows) if rows else None
    if windows is None or not (chosen := regular(windows)).any():
        raise ValueError(
            f"nothing can be learned from the {len(recordings)} recordings: no driver was seen for {steps + 1} samples "
            "on end, or all are at the limits of control or at the edge of the road"
        )
    return windows.of(chosen)


def _coasting(states: CarStates) -> CarStates:
    """Return the states, with motion at constant velocity after a car was last seen."""
    states = states.copy()
    for before, after in itertools.pairwise(states):
        x, y, heading, speed = before.T
        distance = speed * TIME_STEP
        kept = np.stack([x + distance * np.cos(heading), y + distance * np.sin(heading), heading, speed], axis=-1)
        after[:] = np.where(np.isnan(after).any(axis=-1, keepdims=True), kept, after)
    return states


def regular(windows: Windows) -> Flags:
    """Return the windows in which the gradient at the driver's controls identifies the reward.

    Excluded are controls near their limit, where the limit and not the reward decides; and cars that are off the road
    and point along it: there ``off_road`` has a kink, where another corner becomes the outermost, and a car that slides
    along the edge stays at the kink whatever the weight is.
    """
    off_road, slant = in_batches(partial(_edge, driver_game(windows, {})), windows)
    at_kink = (off_road & (slant < KINK)).any(axis=1)
    saturated = (np.abs(windows.controls) > SATURATED * np.array(PHYSICAL_LIMIT)).any(axis=(1, 2))
    return ~at_kink & ~saturated


@jit_quickly
@partial(jax.vmap, in_axes=(None, 0))
def _edge(game: Game, window: Windows) -> tuple[jax.Array, jax.Array]:
    """Return whether the driver is off the road, and the magnitude of its heading's sine, after each step."""
    path = move(game, window.start, window.controls / game.planner.control_scale)
    return path_features(game, window, path)[:, FEATURES.index("off_road")] > 0, jnp.abs(Motion(*path).sine)


def driver_game(windows: Windows, weights: Mapping[str, float], names: Sequence[str] = ()) -> Game:
    """Return a game whose robot is a recorded driver with these weights; `with_window` sets its scene.

    It computes `FEATURES`, and users' own features that have a weight or are among the names.
    """
    scene = jax.tree.map(lambda numbers: numbers[0], windows.scenes)
    computed = features_for(weights, dict.fromkeys(names, 1.0), least=FEATURES)
    game = driving_game(scene, float(windows.speed_limit[0]), weights, computed, grip=None)
    return replace(game, planner=replace(game.planner, horizon=windows.controls.shape[1]))


def with_window(game: Game, window: Windows) -> Game:
    """Return the game with the scene and the speed limit of one window."""
    return replace(game, scene=window.scenes, robot=replace(game.robot, speed_limit=window.speed_limit))


def path_features(game: Game, window: Windows, path: Trajectory) -> Float[jax.Array, "K features"]:
    """Return the features of `driver_game` at each step of a driver's path in one window."""
    here = with_window(game, window)

    def at_step(own: jax.Array, others: jax.Array) -> jax.Array:
        return jnp.stack(motion_features(here.scene, here.robot, Motion(*own), observe(others)))

    return jax.vmap(at_step, in_axes=(1, 1))(path, window.others)


def features_along(game: Game, window: Windows, controls: Controls) -> Float[jax.Array, "features"]:
    """Return the game's features, then those of comfort, summed over a window's steps under scaled controls.

    Comfort's are ``-sum deviation^2 / 2``, of the deviation from the controls that keep the velocity.
    """
    start = jnp.asarray(window.start)
    paid = path_features(game, window, move(game, start, controls)).sum(axis=0)
    deviation = controls - keep_velocity(game.dynamics, start) / game.planner.control_scale
    return jnp.concatenate([paid, -jnp.sum(deviation**2, axis=0) / 2])
