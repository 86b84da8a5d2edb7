"""Compare predictions with recordings after some seconds."""

from dataclasses import dataclass

import numpy as np
from jax import numpy as jnp
from jaxtyping import Float, Int

from ms_highway.irl.recording import CarFlags, CarStates


@dataclass(frozen=True)
class PredictionHorizons:
    """Set when predictions are compared with recordings."""

    seconds: tuple[int, ...] = (1, 2, 3, 5)
    """Horizons [s]."""
    typical_errors: tuple[tuple[float, float], ...] = (
        (0.4, 0.1),
        (1.0, 0.3),
        (1.8, 0.5),
        (3.5, 0.8),
    )
    """Typical errors at the horizons, along and across the road, by which fits divide
    errors [m].
    """

    @property
    def steps(self) -> Int[np.ndarray, "horizons"]:
        """Index of each horizon among the steps of 0.1 s."""
        return 10 * np.array(self.seconds) - 1

    @property
    def scales(self) -> Float[np.ndarray, "horizons 2"]:
        """The typical errors as an array [m]."""
        return np.array(self.typical_errors)


HORIZONS = PredictionHorizons()


def robust_errors(
    paths: CarStates,
    future: CarStates,
    chosen: CarFlags,
) -> tuple[CarStates, CarFlags]:
    """Return robust errors along and across the road at each horizon, for fits.

    They are ``sqrt(1 + (error / scale)^2) - 1``.

    Args:
        paths: predicted positions after each step [*n, 50, cars, 2].
        future: recorded states after each step, see
            `ms_highway.irl.snapshots.Snapshots`.
        chosen: cars whose errors count [*n, 1, cars].

    Returns:
        The errors [*n, horizons, cars, 2], 0 where they do not count; and whether they
        count [*n, horizons, cars].
    """
    predicted = paths[..., HORIZONS.steps, :, :]
    recorded = future[..., HORIZONS.steps, :, :2]
    known = jnp.isfinite(recorded).all(axis=-1) & chosen
    differences = predicted - jnp.nan_to_num(recorded)
    errors = jnp.where(known[..., None], differences, 0.0)
    scaled = errors / HORIZONS.scales[:, None]
    return jnp.sqrt(1 + scaled**2) - 1, known
