"""Choose models by a learned value of computation (Russell and Wefald 1991; Callaway et al. 2018); keep it in files.

From the situation of a human, networks estimate how much more the robot earns per step if a rung, instead of the
cheapest one, predicts this human, while the same rung predicts all nearer humans. The price of the time that the human
adds to a plan is subtracted. A gap may open only if two humans yield together. Therefore, the rule adds up the values
of each rung from the nearest human outwards, and takes the rung and the number of humans with the highest sum. The
cheapest rung predicts the other humans.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache, partial
from importlib import resources
from itertools import pairwise
from os import PathLike
from pathlib import Path
from typing import Any, TypeAlias, TypedDict

import jax
import msgspec
import numpy as np
from jax import numpy as jnp
from jaxtyping import Float

from ms_highway.choice.rule import NOT_ESTIMATED, Decision, Memory, Outcome, Rule, unestimated
from ms_highway.choice.situation import describe, description_names, nearness
from ms_highway.game.game import Game
from ms_highway.game.scenario import Semantics
from ms_highway.planning.costs import Costs
from ms_highway.planning.human_models import HumanModel
from ms_highway.runtime.arrays import Array, Scalar, Structure, read, read_only
from ms_highway.runtime.files import read_arrays, reading, replacing
from ms_highway.runtime.sources import digest

Network: TypeAlias = tuple[tuple[Float[Array, "networks inputs outputs"], Float[Array, "networks outputs"]], ...]
"""Weights and biases of each layer of several networks; all layers but the last are followed by tanh."""

TOGETHER = 4  # at most so many humans, the nearest, are predicted by more than the first rung
DOUBT_MARGIN = 0.5  # in standard deviations among the networks
MIN_NOISE = 0.02  # least standard deviation of a gain


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class LearnedValue(Rule):
    """Take the rung and the number of the nearest humans with the highest total value.

    Attributes:
        costs: planning time of each rung.
        price: lambda, reward per second of planning.
        network: networks that estimate the gains over the first rung from `ms_highway.choice.situation.describe`.
        centre, spread: mean and standard deviation by which the inputs of the networks are standardised.
        ladder: human models, cheapest first (static).
        cautious: whether a decision tells the gains that it compares, those of the nearest humans, net of the price and
            of a margin for doubt. Otherwise, it tells the expected gains of all humans over the first rung, which
            budgets need. If the networks then expect a gain below `MIN_NOISE` from the top rung, a small gain replaces
            it, which is larger for nearer humans, so that spare time goes to them (static).
    """

    costs: Costs
    price: Scalar
    network: Network
    centre: Float[Array, "inputs"]
    spread: Float[Array, "inputs"]
    ladder: tuple[HumanModel, ...] = field(metadata={"static": True})
    cautious: bool = field(default=True, metadata={"static": True})

    def decide(self, game: Game, memory: Memory, outcome: Outcome) -> Decision:
        """Choose by the state after the last step.

        The value of a rung is its gain over the first one, less its price and `DOUBT_MARGIN` standard deviations among
        the networks, so that the first rung is chosen in doubt. A value that is not known counts as that of the first.
        """
        if len(self.ladder) == 1:
            return unestimated(memory, memory.rungs)
        rank = nearness(game, outcome.after)
        nearest = jnp.argsort(rank)[: TOGETHER if self.cautious else game.number]
        inputs = (describe(game, outcome.after, nearest) - self.centre) / self.spread
        means, _ = jax.vmap(partial(outputs, self.network))(inputs)  # [nearest, networks, rungs above the first]
        gains, doubts = (jnp.pad(part(means, axis=1), ((0, 0), (1, 0))) for part in (jnp.mean, jnp.std))
        known = jnp.isfinite(gains).all(axis=1, keepdims=True)
        values = gains - DOUBT_MARGIN * doubts - self.price * jnp.asarray(self.costs.each)
        worth = jnp.where(known, values - values[:, :1], 0.0)
        totals = jnp.cumsum(worth[:TOGETHER], axis=0)  # of the nearest humans under each rung
        fewer, rung = jnp.unravel_index(jnp.argmax(totals), totals.shape)
        rungs = jnp.where(rank <= fewer, rung, 0).astype(jnp.int32)
        if self.cautious:
            estimates = values - jnp.take_along_axis(values, jnp.asarray(memory.rungs)[nearest, None], axis=1)
        else:
            top, little = gains[:, -1], MIN_NOISE * (1 - np.arange(game.number) / game.number)
            estimates = gains.at[:, -1].set(jnp.where(jnp.abs(top) < MIN_NOISE, little, top))
        estimated = jnp.full(memory.last_check.shape, NOT_ESTIMATED)
        estimated = estimated.at[nearest].set(jnp.where(known, estimates, NOT_ESTIMATED))
        return Decision(memory._replace(rungs=rungs), estimated, ~known.all())


def outputs(
    network: Network, inputs: Float[jax.Array, "inputs"]
) -> tuple[Float[jax.Array, "networks means"], Float[jax.Array, "networks means"]]:
    """Return what each network expects for the same inputs, and the numbers from which `noise` computes spreads."""
    *hidden, (weights, biases) = network
    inputs = jnp.broadcast_to(inputs, (len(biases), *inputs.shape))
    for layer_weights, layer_biases in hidden:
        inputs = jnp.tanh(jnp.einsum("ni,nio->no", inputs, layer_weights) + layer_biases)
    means, spreads = jnp.split(jnp.einsum("ni,nio->no", inputs, weights) + biases, 2, axis=-1)
    return means, spreads


def noise(spreads: Float[jax.Array, "*shape"]) -> Float[jax.Array, "*shape"]:
    """Return standard deviations of outcomes from the second half of a network's `outputs`."""
    return MIN_NOISE + jax.nn.softplus(spreads)


# Files of learned values

SHIPPED_VALUES = "shipped"
"""Name of the values that come with the package."""

SHIPPED_FILES = {
    "pair": "values.npz",
    "physical": "physical_values.npz",
    "several": "several_values.npz",
    "physical several": "crowd_values.npz",
}
"""Files that come with the package, by kind of scene, see `ms_highway.choice.rule.shipped_kind`."""

VERSION = 3  # of the form of files
REMEDY = "learn values with `ms-highway values learn`"
ALTERNATIVES = f"choose another controller, such as switching at a lambda of 0.1, or {REMEDY}"
MAX_BYTES = 2**24  # of an unpacked file; the package's files have a hundredth
MIN_SPREAD, MAX_NUMBER = 1e-9, 1e9  # bounds of `spread` that rule out overflow; the second also bounds `centre`
MAX_WEIGHT = 1e3  # of networks; those of the package are below 1


@dataclass(frozen=True)
class Values:
    """Result of ``ms-highway values learn``.

    Attributes:
        network: see `LearnedValue`.
        centre, spread: mean and standard deviation of its inputs.
        ladder: names of the models that the values were learned on, cheapest first.
        inputs: names of the network's inputs.
        provenance: scenarios, settings and software versions with which the values were learned.
        place: file from which they were read, for messages.
    """

    network: Network
    centre: Float[np.ndarray, "inputs"]
    spread: Float[np.ndarray, "inputs"]
    ladder: tuple[str, ...]
    inputs: tuple[str, ...]
    provenance: Mapping[str, Any]
    place: str = "learned values"

    def __post_init__(self) -> None:
        """Check the values.

        Raises:
            ValueError: naming the problem.
        """
        if len(self.ladder) < 2 or len({*self.ladder}) < len(self.ladder):
            raise ValueError(f"the ladder has the models {list(self.ladder)}; it must have at least two, each once")
        if self.inputs != description_names():
            raise ValueError("the networks have the inputs of another version")
        layers = [part for layer in self.network for part in layer]
        shapes = [np.shape(part) for part in layers]
        networks, sizes = shapes[0][:1] if shapes else (), [len(self.inputs)]
        sizes += [size for shape in shapes[1::2] for size in shape[-1:]]
        wanted = [networks + shape for one, other in pairwise(sizes) for shape in ((one, other), (other,))]
        if shapes != wanted or 0 in networks or sizes[-1] != 2 * (len(self.ladder) - 1):
            raise ValueError(f"the networks have layers of shapes {shapes}, not those for {len(self.ladder)} models")
        standard = np.shape(self.centre), np.shape(self.spread)
        if set(standard) != {(sizes[0],)} or not all(
            (np.abs(part) <= MAX_NUMBER).all() for part in (self.centre, self.spread)
        ):
            raise ValueError(f"centre or spread has a number beyond {MAX_NUMBER:g}, or not one for each input")
        if not all((np.abs(part) <= MAX_WEIGHT).all() for part in layers):
            raise ValueError(f"the weights of the networks are beyond {MAX_WEIGHT:g}, or not finite")
        if np.min(self.spread) < MIN_SPREAD:
            raise ValueError(f"spreads are below {MIN_SPREAD:g}")

    def rule(self, models: tuple[HumanModel, ...], costs: Costs, price: float) -> LearnedValue:
        """Return the rule on a ladder of learned models that begins with the cheapest of them.

        Raises:
            ValueError: if values of a model were not learned, or the ladder begins with another model.
        """
        names = [model.name for model in models]
        message = f"{self.place}: values were learned on the ladder {' '.join(self.ladder)}"
        if unknown := [name for name in names if name not in self.ladder]:
            raise ValueError(f"{message}, without {unknown[0]!r}; {ALTERNATIVES} --set ladder={','.join(names)}")
        if names[0] != self.ladder[0]:
            raise ValueError(f"{message}, over {self.ladder[0]!r}; begin the ladder with it, {ALTERNATIVES}")
        gains = len(self.ladder) - 1
        places = [self.ladder.index(name) - 1 for name in names[1:]]
        places += [gains + place for place in places]
        *hidden, (weights, biases) = self.network
        network = (*hidden, (weights[..., places], biases[..., places]))
        return LearnedValue(costs, price, network, self.centre, self.spread, models)


class _Provenance(TypedDict, total=False):
    """Entries of the provenance of values by which scenes are compared; all others are for people to read."""

    scenarios: list[str]
    semantics: Semantics
    solver: str
    planning_horizon: int | list[int]
    human_reward: str | dict[str, float] | None


class _About(Structure):
    """Description in a file of values; the fields are those of `Values`."""

    ladder: tuple[str, ...]
    inputs: tuple[str, ...]
    provenance: dict[str, Any]


def save_values(values: Values, path: Path) -> None:
    """Write learned values as a NumPy archive, atomically."""
    about = {"version": VERSION, **{name: getattr(values, name) for name in _About.__struct_fields__}}
    arrays: dict[str, Any] = {"about": np.array(json.dumps(about, default=dict))}
    arrays |= {"centre": values.centre, "spread": values.spread}
    for number, (weights, biases) in enumerate(values.network):
        arrays |= {f"weights_{number}": np.asarray(weights), f"biases_{number}": np.asarray(biases)}
    with replacing(path) as temporary, temporary.open("wb") as file:
        np.savez(file, **arrays)


def load_values(which: str | PathLike[str], kind: str = "pair") -> Values:
    """Read learned values from the package or from a file that `save_values` wrote.

    Args:
        which: `SHIPPED_VALUES`, or a file.
        kind: kind of scene of the package's values, a key of `SHIPPED_FILES`.

    Raises:
        ValueError: if the file cannot be read, is damaged, or has another version.
    """
    if which == SHIPPED_VALUES:
        return _shipped(SHIPPED_FILES[kind])
    with reading(Path(which), f"{REMEDY} --out {which}", " as learned values"):
        return _read(Path(which), digest(Path(which)))


@cache
def _shipped(name: str) -> Values:
    with resources.as_file(resources.files("ms_highway") / "data" / name) as path:
        return _read(path, "")


@cache
def _read(path: Path, content: str) -> Values:
    """Read a file once for every content, whose digest is given."""
    arrays = read_arrays(path, MAX_BYTES)
    about = json.loads(str(arrays.pop("about")))
    version = about.pop("version", None) if isinstance(about, dict) else None
    if version != VERSION:
        raise ValueError(f"it is of version {version}, not {VERSION}")
    if wrong := [name for name, array in arrays.items() if array.dtype.kind not in "fiu"]:
        raise ValueError(f"{wrong[0]} holds {arrays[wrong[0]].dtype}; it must hold numbers")
    with np.errstate(over="ignore"):
        numbers = read_only({name: array.astype(np.float32) for name, array in arrays.items()})  # as all share them
    centre, spread, layers = numbers.pop("centre"), numbers.pop("spread"), range(len(numbers) // 2)
    network = tuple((numbers[f"weights_{number}"], numbers[f"biases_{number}"]) for number in layers)
    read(about.get("provenance"), _Provenance)
    return Values(network, centre, spread, **msgspec.structs.asdict(read(about, _About)), place=str(path))
