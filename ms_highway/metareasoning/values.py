"""Learned values of computation and their file: the network, and what it was learned on."""

import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from importlib import resources
from os import PathLike
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np
from jaxtyping import Float

from ms_highway.metareasoning.learned_value import LearnedValue, Network
from ms_highway.metareasoning.network_file import NetworkFile, check_network, read_network, write_network
from ms_highway.metareasoning.situation import description_names
from ms_highway.planning.human_models import HumanModel

__all__ = ["SHIPPED_VALUES", "Values", "load_values", "save_values"]

SHIPPED_VALUES = "shipped"
"""Stands for the values that come with the package."""

VERSION = 1
REMEDY = "learn values with `ms-highway values learn`"
DAMAGES = AttributeError, BadZipFile, EOFError, LookupError, RecursionError, TypeError, ValueError, zlib.error
CLOSE = 1e-6  # relative difference of costs that are the same


@dataclass(frozen=True)
class Values:
    """Result of ``ms-highway values learn``.

    Attributes:
        network: see `ms_highway.metareasoning.learned_value.LearnedValue`.
        centre, spread: of its inputs.
        costs: T(M) by model, cheapest first [s]: the ladder that the values were learned on.
        prices: the least and the largest lambda that was learned.
        inputs: names of the network's inputs.
        provenance: scenarios, settings and versions of the software.
        place: where they were read from.
    """

    network: Network
    centre: Float[np.ndarray, "inputs"]
    spread: Float[np.ndarray, "inputs"]
    costs: Mapping[str, float]
    prices: tuple[float, float]
    inputs: tuple[str, ...]
    provenance: Mapping[str, Any]
    place: str = "learned values"

    def __post_init__(self) -> None:
        """Check the values.

        Raises:
            ValueError: naming the problem.
        """
        if len(self.costs) < 2:
            raise ValueError(f"the ladder has the models {list(self.costs)}; there must be two at least")
        if self.inputs != input_names():
            raise ValueError("the inputs of the network are those of another version")
        models = len(self.costs)
        check_network(self.network, self.centre, self.spread, len(self.inputs), 2 * models, f", for {models} models")
        if not (self.spread > 0).all() or not 0 < self.prices[0] <= self.prices[1] < np.inf:
            raise ValueError(f"spreads and prices must be positive; the prices are {self.prices}")

    def rule(self, models: tuple[HumanModel, ...], costs: Float[np.ndarray, "rungs"], price: float) -> LearnedValue:
        """Return the rule on a ladder of some of the models that were learned.

        Raises:
            ValueError: if a model was not learned, or with another T(M).
        """
        names, known = [model.name for model in models], list(self.costs)
        told = f"{self.place}: values were learned on the ladder {' '.join(known)}"
        if unknown := [name for name in names if name not in known]:
            raise ValueError(f"{told}, without {unknown[0]!r}; {REMEDY} --ladder {' '.join(names)}")
        learned = np.array([self.costs[name] for name in names])
        if not np.allclose(learned, costs, rtol=CLOSE, atol=0):
            now = ",".join(f"{name}={seconds:.9g}" for name, seconds in zip(names, costs, strict=True))
            then = ",".join(f"{name}={self.costs[name]:.9g}" for name in names)
            raise ValueError(f"{told} at costs of {then}, not {now}; use those costs, or {REMEDY} --costs {now}")
        *hidden, (weights, biases) = self.network
        places = [known.index(name) for name in names]
        places += [len(known) + place for place in places]  # means, then standard deviations
        network = (*hidden, (weights[..., places], biases[..., places]))
        cheapest, *_, top = self.costs.values()
        span = float(top - cheapest)
        return LearnedValue(
            learned.astype(np.float32), price, np.array(self.prices), span, network, self.centre, self.spread, models
        )


def input_names() -> tuple[str, ...]:
    """Return the names of a network's inputs."""
    return (*description_names(), "log10 lambda")


def save_values(values: Values, path: Path) -> None:
    """Write learned values as a NumPy archive, atomically."""
    about = {
        "version": VERSION,
        "costs": dict(values.costs),
        "prices": list(values.prices),
        "inputs": list(values.inputs),
        "provenance": dict(values.provenance),
    }
    write_network(path, NetworkFile(about, values.network, values.centre, values.spread))


def load_values(which: str | PathLike[str]) -> Values:
    """Read learned values: those that come with the package (`SHIPPED_VALUES`), or a file that `save_values` wrote.

    Raises:
        ValueError: if the file cannot be read, is damaged, or is of another version.
    """
    if which == SHIPPED_VALUES:
        return _shipped()
    try:
        return _read(Path(which), Path(which).stat().st_mtime_ns)
    except OSError as error:
        raise ValueError(f"{which} cannot be read as learned values: {error}; {REMEDY} --out {which}") from error


@cache
def _shipped() -> Values:
    with resources.as_file(resources.files("ms_highway") / "data" / "values.npz") as path:
        return _read(path, 0)


@cache
def _read(path: Path, changed: int) -> Values:
    """Read a file, once for every time that it was ``changed``."""
    try:
        about, network, centre, spread = read_network(path)
        if about["version"] != VERSION:
            raise ValueError(f"it is of version {about['version']}, not {VERSION}")
        return Values(
            network,
            centre,
            spread,
            about["costs"],
            tuple(about["prices"]),
            tuple(about["inputs"]),
            about["provenance"],
            str(path),
        )
    except DAMAGES as error:
        raise ValueError(f"{path} is damaged or no file of learned values: {error}; {REMEDY} --out {path}") from error
