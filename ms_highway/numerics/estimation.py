"""Estimate parameters from data: the minimum of a loss, and their covariance."""

from collections.abc import Callable
from typing import Any, TypeAlias

import numpy as np
from jaxtyping import Float, Int
from scipy import optimize

from ms_highway.runtime.arrays import Scalar

Parameters: TypeAlias = Float[Any, "parameters"]  # of NumPy or JAX
Matrix: TypeAlias = Float[np.ndarray, "parameters parameters"]


def minimum(
    loss: Callable[..., tuple[Scalar, Parameters]],
    first: Parameters,
    *arguments: object,
    **options: object,
) -> np.ndarray:
    """Return the parameters at which a loss is least, by L-BFGS.

    Args:
        loss: of parameters and the arguments; returns its value and its slope, in any
            precision.
        first: parameters to start from.
        arguments: of the loss.
        options: of `scipy.optimize.minimize`.
    """

    def value(parameters: np.ndarray) -> tuple[float, np.ndarray]:
        found, slope = loss(parameters, *arguments)
        return float(found), np.asarray(slope, dtype=float)

    result = optimize.minimize(
        value, first, jac=True, method="L-BFGS-B", options=options
    )
    return result.x


def slope_differences(
    slope: Callable[[Parameters], Parameters],
    parameters: Parameters,
    step: float,
) -> Matrix:
    """Return second derivatives by central differences of a slope.

    There is a row per parameter.
    """
    rows = []
    for change in step * np.eye(len(parameters)):
        above = np.asarray(slope(parameters + change))
        below = np.asarray(slope(parameters - change))
        rows.append(above - below)
    return np.array(rows, dtype=float) / (2 * step)


def grouped_covariance(
    inverse: Matrix,
    scores: Float[np.ndarray, "n parameters"],
    groups: Int[np.ndarray, "n"],
) -> Matrix:
    """Return the covariance of estimates from groups of data (Huber 1967).

    Data of a group depend on each other. With the score s_i, the slope of the loss over
    all data of group i, it is ``B sum_i s_i s_i^T B``.

    Args:
        inverse: B, of the loss's Hessian.
        scores: slopes of each datum's part of the loss.
        groups: that the data belong to.
    """
    sums = []
    for group in np.unique(groups):
        of_group = scores[groups == group]
        sums.append(of_group.sum(axis=0))
    summed = np.stack(sums)  # [groups, parameters]

    outer_products = summed.T @ summed  # sum_i s_i s_i^T
    return inverse @ outer_products @ inverse
