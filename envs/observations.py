"""What an agent sees: all cars in the order of their roles, scaled for learning or exact for recording."""

from typing import Any

import numpy as np
from gymnasium import spaces
from highway_env.envs.common.observation import ObservationType
from jaxtyping import Float

__all__ = ["CarStates", "CarTracks", "finite"]

FEATURES = ("x", "y", "vx", "vy", "cos_h", "sin_h")
SCALES = np.array([100.0, 10.0, 40.0, 40.0, 1.0, 1.0])  # m, m, m/s, m/s, 1, 1
LARGEST = float(np.finfo(np.float32).max)


class CarStates(ObservationType):
    """``x, y, vx, vy, cos_h, sin_h`` of robot, human and scripted cars, in this order, scaled to about [-1, 1].

    The robot's row is absolute, the others' positions and velocities are relative to it, as in highway-env's
    ``Kinematics``; positions are divided by 100 m and 10 m, velocities by 40 m/s. Nothing is clipped: who drives
    further than 100 m still sees where it is.
    """

    def __init__(self, env: Any, cars: int) -> None:
        super().__init__(env)
        self.shape = (cars, len(FEATURES))

    def space(self) -> spaces.Box:
        high = np.tile(np.array([LARGEST] * 4 + [1, 1], np.float32), (self.shape[0], 1))
        return spaces.Box(-high, high, dtype=np.float32)

    def observe(self) -> Float[np.ndarray, "cars 6"]:
        x, y, heading, speed = self.env.car_states.T
        cosine, sine = np.cos(heading), np.sin(heading)
        rows = np.array([x, y, speed * cosine, speed * sine, cosine, sine]).T
        rows[1:, :4] -= rows[0, :4]
        return (rows / SCALES).clip(-LARGEST, LARGEST).astype(np.float32, order="C")


class CarTracks(ObservationType):
    """``presence, x, y, heading, speed`` of the driver and of all others, in SI units, absolute and unscaled.

    Always as many rows as there may be cars; rows of absent cars are zero. ``env.car_states`` may hold anything there,
    ``env.present`` says which cars are there.
    """

    BOUND = 1e4  # m, rad or m/s; never reached

    def __init__(self, env: Any, cars: int) -> None:
        super().__init__(env)
        self.shape = (cars, 5)

    def space(self) -> spaces.Box:
        high = np.full(self.shape, self.BOUND, dtype=np.float32)
        high[:, 0] = 1
        low = -high
        low[:, 0] = 0
        return spaces.Box(low, high, dtype=np.float32)

    def observe(self) -> Float[np.ndarray, "cars 5"]:
        present = self.env.present
        tracks = np.concatenate([present[:, None], self.env.car_states], axis=-1) * present[:, None]
        return tracks.clip(-self.BOUND, self.BOUND).astype(np.float32)


def finite(space: spaces.Space) -> spaces.Space:
    """Replace infinite bounds of a space, which some of highway-env's observations have, by the ends of its type."""
    if not isinstance(space, spaces.Box) or not np.issubdtype(space.dtype, np.floating):
        return space
    end = np.finfo(space.dtype).max
    return spaces.Box(np.maximum(space.low, -end), np.minimum(space.high, end), dtype=space.dtype.type)
