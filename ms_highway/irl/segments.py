"""Cut recordings into segments of a driver's controls, and compute their features.

Maximum entropy learns from segments of half a second, see
`ms_highway.irl.maximum_entropy`.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise

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
    Controls,
    Flags,
    NumberedRecording,
    Numbers,
    Recording,
    Rows,
    States,
    numbered,
)
from ms_highway.irl.tracks import track_of
from ms_highway.runtime.arrays import Array


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Segments(Rows):
    """n segments of K steps, in SI units.

    The arrays are NumPy's or JAX's, with a leading axis [n]; one segment has no such
    axis.

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
    others: Float[Array, "*n 6 K 4"]
    driver: Numbers
    group: Numbers


def cut_segments(recordings: Sequence[Recording], steps: int) -> Segments:
    """Cut the drivers' tracks into consecutive segments; return the `regular` ones.

    Args:
        recordings: the recordings to cut.
        steps: K, the length of a segment.

    Raises:
        ValueError: if no segment is regular.
    """
    rows = [segment for each in numbered(recordings) for segment in _cut(each, steps)]
    if rows:
        segments = jax.tree.map(lambda *parts: np.stack(parts), *rows)
        chosen = regular(segments)
        if chosen.any():
            return segments.of(chosen)
    raise ValueError(
        f"nothing can be learned from the {len(recordings)} recordings: no driver"
        f" was seen for {steps + 1} samples without a gap, or all are at the limits"
        " of control or at the edge of the road"
    )


def _cut(numbered_recording: NumberedRecording, steps: int) -> Iterator[Segments]:
    """Yield the segments of one recording, each without the axis of segments."""
    recording, group, first_track, lanes = numbered_recording
    states = _extrapolated(recording.states)
    cars = np.arange(len(recording.sizes))
    for number, driver in enumerate(recording.drivers, first_track):
        scene = Scene(
            lanes,
            recording.lane_width,
            car_size=recording.sizes[driver],
            target_lane=lanes[0],
        )
        track = track_of(recording, driver)
        entry = recording.seen[:, driver].argmax()
        for first in range(0, len(track.controls) - steps + 1, steps):
            start = track.states[first]
            now = entry + first

            # The neighbours at the start, and their paths; free places are far behind.
            is_other = recording.seen[now] & (cars != driver)
            width = recording.lane_width
            neighbours, taken = places(start, states[now], is_other, width)
            after = states[now + 1 : now + steps + 1, neighbours]
            paths = np.moveaxis(after, 0, 1)  # [neighbours, steps, 4]
            others = np.where(taken[:, None, None], paths, far_behind(start))

            yield Segments(
                scenes=scene,
                speed_limit=np.asarray(recording.speed_limit),
                start=start,
                controls=track.controls[first : first + steps],
                others=others,
                driver=np.asarray(number),
                group=np.asarray(group),
            )


def _extrapolated(
    states: Float[np.ndarray, "times cars 4"],
) -> Float[np.ndarray, "times cars 4"]:
    """Return the states of cars that go on at constant velocity once out of sight."""
    states = states.copy()
    for before, after in pairwise(states):
        keeping = step(PAPER_DYNAMICS, before, keep_velocity(PAPER_DYNAMICS, before))
        is_unseen = np.isnan(after).any(axis=-1, keepdims=True)
        after[:] = np.where(is_unseen, keeping, after)
    return states


def regular(segments: Segments) -> Flags:
    """Return whether each segment identifies the reward by its gradient.

    It does not where controls are near their limit: the limit and not the reward
    decides them. Nor does it where a car is off the road and points along it:
    ``off_road`` has a kink there, as another corner becomes the outermost, and a car
    that slides along the edge stays at the kink whatever the weight is.
    """
    kink_sine = 0.05  # of the heading, below which noise may turn to either side
    saturation = 0.8  # share of the limits of plans from which controls are near them

    paths = rollout(PAPER_DYNAMICS, segments.start, segments.controls)
    depth_of_each = jax.vmap(partial(depth_off_road, smooth=False))
    depths = depth_of_each(segments.scenes, paths)  # [n, steps]
    points_along = jnp.abs(paths.sine) < kink_sine
    at_kink = ((depths > 0) & points_along).any(axis=1)

    limits = saturation * np.array(PHYSICAL_LIMIT)
    is_large = np.abs(segments.controls) > limits
    saturated = is_large.any(axis=(1, 2))
    return ~np.asarray(at_kink) & ~saturated


def driver_game(
    segments: Segments,
    weights: Mapping[str, float],
    names: Sequence[str] = (),
) -> Game:
    """Return a game whose robot is a recorded driver with these weights.

    `with_segment` sets its scene. It computes `FEATURES`, and those user-defined
    features that have a weight or are among the names.
    """
    scene = jax.tree.map(lambda numbers: numbers[0], segments.scenes)
    computed = features_for(weights, dict.fromkeys(names, 1.0), least=FEATURES)
    speed_limit = float(segments.speed_limit[0])
    game = driving_game(scene, speed_limit, weights, computed, grip=None)
    horizon = segments.controls.shape[1]
    return replace(game, planner=replace(game.planner, horizon=horizon))


def with_segment(game: Game, segment: Segments) -> Game:
    """Return the game with the scene and the speed limit of one segment."""
    return replace(
        game,
        scene=segment.scenes,
        robot=replace(game.robot, speed_limit=segment.speed_limit),
    )


def summed_features(
    game: Game,
    segment: Segments,
    controls: Controls,
) -> Float[jax.Array, "features"]:
    """Return the features of the game and of comfort, summed over a segment.

    They are those under scaled controls. The features of comfort are ``-sum d^2 / 2``,
    with d the deviation from the controls that keep the velocity.
    """
    here = with_segment(game, segment)
    start = jnp.asarray(segment.start)
    path = Motion(*move(game, start, controls))
    others = observe(segment.others)
    features = jnp.stack(motion_features(here.scene, here.robot, path, others))

    keeping = keep_velocity(game.dynamics, start) / game.planner.control_scale
    squares = (controls - keeping) ** 2
    comfort = -jnp.sum(squares, axis=0) / 2
    return jnp.concatenate([features.sum(axis=1), comfort])
