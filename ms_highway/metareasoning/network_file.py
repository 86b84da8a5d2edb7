"""Write and read networks of learned values: a NumPy archive of the network, its standardisation, and a description."""

import json
from collections.abc import Mapping
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from ms_highway.metareasoning.learned_value import Network
from ms_highway.runtime.files import replacing

__all__ = ["NetworkFile", "check_network", "read_network", "write_network"]


class NetworkFile(NamedTuple):
    """What a file of learned values holds.

    Attributes:
        about: what describes it, of JSON's types.
        network: of the values.
        centre, spread: of the network's inputs.
    """

    about: Mapping[str, Any]
    network: Network
    centre: Float[np.ndarray, "inputs"]
    spread: Float[np.ndarray, "inputs"]


def check_network(
    network: Network,
    centre: Float[np.ndarray, "inputs"],
    spread: Float[np.ndarray, "inputs"],
    inputs: int,
    outputs: int,
    whose: str = "",
) -> None:
    """Check a network and the standardisation of its inputs.

    Args:
        network: of learned values.
        centre: of the inputs.
        spread: of the inputs.
        inputs: their number.
        outputs: number of the network's outputs.
        whose: ends the message about shapes.

    Raises:
        ValueError: naming the problem.
    """
    sizes = [inputs, *(np.shape(biases)[-1] for _, biases in network)]
    shapes = [np.shape(weights)[1:] for weights, _ in network]
    if shapes != list(pairwise(sizes)) or sizes[-1] != outputs:
        raise ValueError(f"the layers of the network are of shapes {shapes}{whose}")
    numbers = [centre, spread, *(part for layer in network for part in layer)]
    if {np.shape(part) for part in numbers[:2]} != {(inputs,)} or not all(np.isfinite(n).all() for n in numbers):
        raise ValueError("the numbers of the network are not finite, or not as many as its inputs")


def write_network(path: Path, content: NetworkFile) -> None:
    """Write a file of learned values, atomically."""
    arrays: dict[str, Any] = {"about": np.array(json.dumps(content.about))}
    arrays |= {"centre": content.centre, "spread": content.spread}
    for number, (weights, biases) in enumerate(content.network):
        arrays |= {f"weights_{number}": np.asarray(weights), f"biases_{number}": np.asarray(biases)}
    with replacing(path) as temporary, temporary.open("wb") as file:
        np.savez(file, **arrays)


def read_network(path: Path) -> NetworkFile:
    """Read a file of learned values; what damages raise is `ms_highway.metareasoning.values.DAMAGES`."""
    with path.open("rb") as file, np.load(file, allow_pickle=False) as archive:
        arrays = {name: archive[name] for name in archive.files}
    layers = range((len(arrays) - 3) // 2)
    network = tuple((arrays[f"weights_{number}"], arrays[f"biases_{number}"]) for number in layers)
    return NetworkFile(json.loads(str(arrays["about"])), network, arrays["centre"], arrays["spread"])
