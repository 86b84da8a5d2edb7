"""Predict recorded drivers by a learned reward, by constant velocity and by highway-env's IDM, on the same cases.

A predicted driver starts in the recorded state and drives in closed loop for up to 5 s, at 10 Hz: it observes the
other cars before every step, as in an environment.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Literal, TypeAlias

import jax
import numpy as np
from highway_env.road.lane import StraightLane
from highway_env.road.road import Road, RoadNetwork
from highway_env.vehicle.behavior import IDMVehicle
from highway_env.vehicle.kinematics import Vehicle
from jax import numpy as jnp
from jaxtyping import Bool, Float, Int
from scipy import stats

from ms_highway.game.dynamics import recover_control, step
from ms_highway.game.game import Game
from ms_highway.game.neighbours import neighbours, places
from ms_highway.game.reward import FEATURES, features_for
from ms_highway.game.scenario import PAPER_DYNAMICS, driving_game
from ms_highway.game.scene import Scene
from ms_highway.irl.recordings.recording import Recording, number_groups
from ms_highway.irl.windows import Windows, coasting, driver_game, most_lanes, scene_of
from ms_highway.planning.human_models import Naive
from ms_highway.runtime.batches import in_batches
from ms_highway.runtime.compilation import jit_quickly

__all__ = [
    "HORIZONS",
    "MISS",
    "STEPS",
    "Cases",
    "Others",
    "constant_velocity",
    "cut_cases",
    "drive",
    "errors",
    "gaussian_log_likelihoods",
    "idm",
    "idm_controls",
    "predictions",
]

Others: TypeAlias = Literal["recorded", "coasting"]
"""Motion of the other cars: as recorded, or at constant velocity from the start of the case."""

HORIZONS = (1, 2, 3, 5)  # s
STEPS = 50  # 0.1 s, of the longest
APART = 10  # steps between the starts of two cases of a driver
CARS = 64  # others, at least, so that one compilation serves most recordings
MISS = 2.0  # m
LEAST_DEVIATION = 1e-6  # of scaled controls


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Cases:
    """n stretches of recorded driving to predict: arrays of NumPy or JAX, in SI units and lane coordinates.

    Attributes:
        scenes: the road and the driver's own size, every array with a leading axis [n].
        speed_limit: of the road [m/s].
        recorded: the driver at the start and after each of 50 steps, NaN after it was seen last.
        others: all other cars, at the same times but the last.
        present: which of them are seen.
        track: number of the driver's track.
        group: number of the recording's group, to split by.
    """

    scenes: Scene
    speed_limit: Float[Any, "n"]
    recorded: Float[Any, "n 51 4"]
    others: Float[Any, "n 50 cars 4"]
    present: Bool[Any, "n 50 cars"]
    track: Int[Any, "n"]
    group: Int[Any, "n"]

    def __len__(self) -> int:
        return len(self.track)

    def of(self, chosen: Bool[np.ndarray, "n"]) -> "Cases":
        """Return the chosen cases."""
        return jax.tree.map(lambda numbers: numbers[chosen], self)


def cut_cases(recordings: Sequence[Recording], others: Others = "recorded") -> Cases:
    """Cut every driver's track into cases that start at its beginning and at every full second after that.

    A case ends with the track, and counts for the horizons that it reaches.

    Args:
        recordings: the recordings to cut.
        others: see `Others`.

    Raises:
        ValueError: if no driver was seen for as long as the shortest horizon.
    """
    groups = number_groups(recordings)
    lanes = most_lanes(recordings)
    most_cars = max((CARS, *(item.states.shape[1] - 1 for item in recordings)))
    rows, track = [], 0
    for recording in recordings:
        times = STEPS + 1
        everyone = np.pad(recording.states, ((0, times), (0, 0), (0, 0)), constant_values=np.nan)
        for driver in map(int, recording.drivers):
            scene = scene_of(recording, driver, lanes)
            seen = np.flatnonzero(recording.seen[:, driver])
            for start in range(seen[0], seen[-1] - 10 * HORIZONS[0] + 1, APART):
                stretch = everyone[start : start + times]
                if others == "coasting":
                    now = np.where(np.arange(times)[:, None, None] == 0, stretch, np.nan)
                    around = coasting(now, recording.time_step)
                else:
                    around = stretch
                around = np.delete(around, driver, axis=1)[:-1]
                missing = most_cars - around.shape[1]
                around = np.pad(around, ((0, 0), (0, missing), (0, 0)), constant_values=np.nan)
                present = np.isfinite(around).all(axis=-1)
                limit, group = np.float64(recording.speed_limit), np.int64(groups[recording.group])
                cells = stretch[:, driver], np.nan_to_num(around).astype(np.float32), present, np.int64(track), group
                rows.append(Cases(scene, limit, *cells))
            track += 1
    if not rows:
        raise ValueError(
            f"no driver of the {len(recordings)} recordings was seen for {HORIZONS[0]} s, the shortest horizon"
        )
    return jax.tree.map(lambda *parts: np.stack(parts), *rows)


def drive(cases: Cases, weights: Mapping[str, float], horizon: int) -> Float[np.ndarray, "n 50 2"]:
    """Predict the positions after each step of drivers who plan with these weights.

    At every step the driver plans by Newton steps over a horizon, assumes that its neighbours keep their velocity, and
    executes the first control, as `ms_highway.vehicle.HumanVehicle` does.

    Args:
        cases: the cases to predict.
        weights: of the reward by name, divided by the temperature, which sets the scale that Newton steps need.
        horizon: of the plans, in steps.
    """
    scene = jax.tree.map(lambda numbers: numbers[0], cases.scenes)
    names = features_for(weights, least=FEATURES)
    game = driving_game(scene, float(cases.speed_limit[0]), weights, names, "newton", grip=None)
    game, start = replace(game, planner=replace(game.planner, horizon=horizon)), cases.recorded[:, 0]
    return in_batches(partial(_drive, game), (cases.scenes, cases.speed_limit, start, cases.others, cases.present))


@jit_quickly
def _drive(game: Game, cases: tuple[Any, ...]) -> Float[jax.Array, "n 50 2"]:
    def one(
        scene: Scene, limit: jax.Array, start: jax.Array, others: jax.Array, present: jax.Array
    ) -> Float[jax.Array, "50 2"]:
        here = replace(game, scene=scene, robot=replace(game.robot, speed_limit=limit))

        def go(car: jax.Array, around: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
            close = neighbours(car, *around, jnp.asarray(scene.lane_width))
            state = jnp.concatenate([car[None], close])
            plan = Naive().plan(here, state).robot
            moved = step(here.dynamics, car, plan[0] * here.planner.control_scale)
            return moved.at[3].max(0.0), moved[:2]

        return jax.lax.scan(go, start, (others, present))[1]

    return jax.vmap(one)(*cases)


def constant_velocity(cases: Cases) -> Float[np.ndarray, "n 50 2"]:
    """Predict the positions of drivers who keep their velocity."""
    x, y, heading, speed = np.moveaxis(np.asarray(cases.recorded)[:, 0], -1, 0)[..., None]
    distance = speed * np.arange(1, STEPS + 1) * PAPER_DYNAMICS.time_step
    return np.stack([x + distance * np.cos(heading), y + distance * np.sin(heading)], axis=-1)


def idm(cases: Cases) -> Float[np.ndarray, "n 50 2"]:
    """Predict the positions of highway-env's IDM vehicles, which keep their lane and whose target is their first speed.

    They observe the six neighbours of each step. With highway-env's lane changes, predictions are worse.
    """
    single = (jax.tree.map(lambda numbers, case=case: numbers[case], cases) for case in range(len(cases)))
    return np.array(
        [
            list(_idm(case.scenes, case.speed_limit, case.recorded[0], zip(case.others, case.present, strict=True)))
            for case in single
        ]
    )[..., :2]


def predictions(cases: Cases, weights: Mapping[str, float], horizon: int) -> dict[str, Float[np.ndarray, "n 50 2"]]:
    """Return the positions that each predictor gives; ``model`` is `drive`, which explains the arguments."""
    paths = {"model": drive(cases, weights, horizon), "constant_velocity": constant_velocity(cases)}
    return {**paths, "idm": idm(cases)}


def _idm(
    scene: Scene,
    speed_limit: float,
    start: Float[np.ndarray, "4"],
    around: Iterable[tuple[Float[np.ndarray, "cars 4"], Bool[np.ndarray, "cars"]]],
) -> Iterator[Float[np.ndarray, "4"]]:
    """Yield an IDM vehicle's state after each step, given the others, and which are present, before the step."""
    network, width = RoadNetwork(), float(scene.lane_width)
    for y in np.unique(scene.lanes):
        network.add_lane("start", "end", StraightLane([-1e4, y], [1e4, y], width=width, speed_limit=float(speed_limit)))
    road = Road(network, np_random=np.random.RandomState(0))
    x, y, heading, speed = np.asarray(start, dtype=float)
    driver = IDMVehicle(road, [x, y], heading, speed, enable_lane_change=False)
    for others, present in around:
        now = np.array([*driver.position, driver.heading, driver.speed])
        cars, taken = places(now, np.asarray(others, dtype=float), present, width)
        road.vehicles = [driver, *(Vehicle(road, state[:2], *state[2:]) for state in others[cars[taken]])]
        driver.act()
        driver.step(PAPER_DYNAMICS.time_step)
        yield np.array([*driver.position, driver.heading, driver.speed])


def idm_controls(windows: Windows) -> Float[np.ndarray, "n K 2"]:
    """Return the controls of an IDM vehicle, see `idm`, in every window; neighbours are taken after each step."""
    controls = []
    for number in range(len(windows)):
        window = jax.tree.map(lambda numbers, number=number: numbers[number], windows)
        here = np.ones(len(window.others), dtype=bool)
        around = ((states, here) for states in np.moveaxis(window.others, 1, 0))
        states = np.array([window.start, *_idm(window.scenes, window.speed_limit, window.start, around)])
        controls.append(recover_control(PAPER_DYNAMICS, states[:-1], states[1:]))
    return np.array(controls)


def gaussian_log_likelihoods(windows: Windows, expected: Float[np.ndarray, "n K 2"]) -> Float[np.ndarray, "n"]:
    """Return log p of the scaled controls in every window, if independent and normal around the expected ones.

    The two standard deviations are fitted to the same windows, an advantage that a learned reward does not have.
    """
    scale = np.asarray(driver_game(windows, {}).planner.control_scale, dtype=float)
    difference = (np.asarray(windows.controls) - expected) / scale
    deviation = np.maximum(np.sqrt(np.mean(difference**2, axis=(0, 1))), LEAST_DEVIATION)
    return stats.norm.logpdf(difference, scale=deviation).sum(axis=(1, 2))


def errors(paths: Float[np.ndarray, "n 50 2"], cases: Cases) -> dict[str, dict[str, float]]:
    """Return the displacement errors of predicted paths, by horizon in seconds.

    Returns:
        ``fde``: mean distance at the horizon [m]; ``ade``: mean distance up to it [m]; ``rmse``: root mean square of
        the distance at it [m]; ``miss``: share of cases whose distance at it exceeds 2 m.
    """
    distance = np.linalg.norm(paths - np.asarray(cases.recorded)[:, 1:, :2], axis=-1)
    found: dict[str, dict[str, float]] = {"fde": {}, "ade": {}, "rmse": {}, "miss": {}}
    for horizon in HORIZONS:
        until = distance[:, : 10 * horizon]
        until = until[np.isfinite(until[:, -1])]
        if not len(until):
            continue
        last = until[:, -1]
        values = last.mean(), until.mean(), np.sqrt((last**2).mean()), (last > MISS).mean()
        for kind, value in zip(found, values, strict=True):
            found[kind][str(horizon)] = float(value)
    return found
