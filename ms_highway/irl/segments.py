"""Cut recordings into segments, each with a driver's controls and its neighbours, and
compute their features.

Maximum entropy learns from segments of half a second, see
`ms_highway.irl.maximum_entropy`.
"""

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import jax
import numpy as np
from jax import numpy as jnp
from jaxtyping import Float

from ms_highway.game.dynamics import Motion, keep_velocity, observe, rollout, step
from ms_highway.game.features import depth_off_road, motion_features
from ms_highway.game.game import Game, move
from ms_highway.game.reward import FEATURES, features_for
from ms_highway.game.scenario import PAPER_DYNAMICS, PHYSICAL_LIMIT, driving_game
from ms_highway.game.scene import Scene, far_behind, places
from ms_highway.irl.recording import (
    CarStates,
    Controls,
    Flags,
    Numbers,
    Recording,
    Rows,
    States,
    numbered,
    track_of,
)
from ms_highway.runtime.arrays import Array

KINK = 0.05  # sine of the heading, below which noise may turn the car to either side
SATURATED = 0.8  # share of the limits of plans, from which controls count as saturated


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Segments(Rows):
    """n segments of K steps: arrays of NumPy or JAX in SI units with a leading axis
    [n]; one segment has no such axis.

    Attributes:
        scenes: the road and the driver's own size.
        speed_limit: of the road [m/s].
        start: state of the driver before the first step.
        controls: of the driver, unscaled.
        others: states after each step of the six cars that were its neighbours at the
            start, see `ms_highway.game.scene`.
        driver: number of the driver among those of all recordings; segments of a driver
            are adjacent.
        group: number of the recording's group, by which segments are split into folds.
    """

    scenes: Scene
    speed_limit: Float[Array, "*n"]
    start: States
    controls: Controls
    others: Float[Any, "*n 6 K 4"]
    driver: Numbers
    group: Numbers


def cut_segments(recordings: Sequence[Recording], steps: int) -> Segments:
    """Cut the drivers' tracks into consecutive segments without overlap; return those
    that are `regular`.

    Args:
        recordings: the recordings to cut.
        steps: K, the length of a segment.

    Raises:
        ValueError: if no segment is regular.
    """
    rows = []
    for recording, group, first_track, lanes in numbered(recordings):
        states = _extrapolated(recording.states)
        for number, driver in enumerate(recording.drivers, first_track):
            size = recording.sizes[driver]
            scene = Scene(
                lanes, recording.lane_width, car_size=size, target_lane=lanes[0]
            )
            track = track_of(recording, driver)
            entry = recording.seen[:, driver].argmax()
            for first in range(0, len(track.controls) - steps + 1, steps):
                start = track.states[first]
                now = entry + first
                present = recording.seen[now] & (
                    np.arange(len(recording.sizes)) != driver
                )
                cars, taken = places(start, states[now], present, recording.lane_width)
                paths = np.moveaxis(states[now + 1 : now + steps + 1, cars], 0, 1)
                others = np.where(taken[:, None, None], paths, far_behind(start))
                controls = track.controls[first : first + steps]
                rows.append(
                    Segments(
                        scene,
                        np.asarray(recording.speed_limit),
                        start,
                        controls,
                        others,
                        number,
                        group,
                    )
                )
    segments = jax.tree.map(lambda *parts: np.stack(parts), *rows) if rows else None
    if segments is None or not (chosen := regular(segments)).any():
        raise ValueError(
            f"nothing can be learned from the {len(recordings)} recordings: no driver"
            f" was seen for {steps + 1} samples without a gap, or all are at the limits"
            " of control or at the edge of the road"
        )
    return segments.of(chosen)


def _extrapolated(states: CarStates) -> CarStates:
    """Return the states, in which each car goes on at constant velocity after it was
    last seen.
    """
    states = states.copy()
    for before, after in itertools.pairwise(states):
        kept = step(PAPER_DYNAMICS, before, keep_velocity(PAPER_DYNAMICS, before))
        after[:] = np.where(np.isnan(after).any(axis=-1, keepdims=True), kept, after)
    return states


def regular(segments: Segments) -> Flags:
    """Return whether each segment's gradient at the driver's controls identifies the
    reward.

    It does not where controls are near their limit: the limit and not the reward
    decides them. Nor does it where a car is off the road and points along it:
    ``off_road`` has a kink there, as another corner becomes the outermost, and a car
    that slides along the edge stays at the kink whatever the weight is.
    """
    paths = rollout(PAPER_DYNAMICS, segments.start, segments.controls)
    off_road = (
        jax.vmap(partial(depth_off_road, smooth=False))(segments.scenes, paths) > 0
    )
    at_kink = (off_road & (jnp.abs(paths.sine) < KINK)).any(axis=1)
    saturated = (np.abs(segments.controls) > SATURATED * np.array(PHYSICAL_LIMIT)).any(
        axis=(1, 2)
    )
    return ~np.asarray(at_kink) & ~saturated


def driver_game(
    segments: Segments, weights: Mapping[str, float], names: Sequence[str] = ()
) -> Game:
    """Return a game whose robot is a recorded driver with these weights by name;
    `with_segment` sets its scene.

    It computes `FEATURES`, and those user-defined features that have a weight or are
    among the names.
    """
    scene = jax.tree.map(lambda numbers: numbers[0], segments.scenes)
    computed = features_for(weights, dict.fromkeys(names, 1.0), least=FEATURES)
    game = driving_game(
        scene, float(segments.speed_limit[0]), weights, computed, grip=None
    )
    return replace(
        game, planner=replace(game.planner, horizon=segments.controls.shape[1])
    )


def with_segment(game: Game, segment: Segments) -> Game:
    """Return the game with the scene and the speed limit of one segment."""
    return replace(
        game,
        scene=segment.scenes,
        robot=replace(game.robot, speed_limit=segment.speed_limit),
    )


def summed_features(
    game: Game, segment: Segments, controls: Controls
) -> Float[jax.Array, "features"]:
    """Return the features of the game and of comfort, summed over a segment's steps
    under scaled controls.

    The features of comfort are ``-sum d^2 / 2``, with d the deviation from the controls
    that keep the velocity.
    """
    here = with_segment(game, segment)
    start = jnp.asarray(segment.start)
    path = Motion(*move(game, start, controls))
    features = jnp.stack(
        motion_features(here.scene, here.robot, path, observe(segment.others))
    ).sum(axis=1)
    deviation = (
        controls - keep_velocity(game.dynamics, start) / game.planner.control_scale
    )
    return jnp.concatenate([features, -jnp.sum(deviation**2, axis=0) / 2])
