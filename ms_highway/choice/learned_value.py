"""Choose models by a learned value of computation, and keep it in files.

A rung is the index of a human model on the ladder, from cheap to expensive models. The
gain of a rung is the value of its computation (Russell and Wefald 1991; Callaway et al.
2018) before the cost of time: how much more the robot earns per step if this rung,
instead of the first one, predicts a human, while the same rung predicts all nearer
humans. Networks estimate it from the situation of the human
(`ms_highway.choice.situation`); several of them, so that their disagreement tells how
uncertain an estimate is.

These gains are marginal: those of the k nearest humans add up to the gain of giving all
k the rung, which `ms_highway.choice.choosers.PriceTogether` maximises. So a rung may
pay where a robot that merges finds room only if two humans yield together.

`Values` is the content of a file. `LearnedValue` is the estimator: it names a file
until an episode starts, and then holds the networks for the ladder of the episode.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cache, partial
from importlib import resources
from itertools import pairwise
from os import PathLike
from pathlib import Path
from typing import Annotated, Any, TypeAlias, TypedDict

import jax
import numpy as np
from jax import numpy as jnp
from jaxtyping import Float
from msgspec import Meta

from ms_highway.choice.budget import Budget
from ms_highway.choice.choosers import PriceTogether
from ms_highway.choice.rule import (
    FROM_START,
    NOT_ESTIMATED,
    Estimate,
    Estimator,
    GameEvidence,
    Memory,
    Rule,
    Start,
)
from ms_highway.choice.shipped import VALUE_FILES, SceneKind, shipped_kind
from ms_highway.choice.situation import describe, description_names, distance_rank
from ms_highway.game.scenario import Semantics
from ms_highway.planning.costs import Costs
from ms_highway.planning.human_models import HumanModel
from ms_highway.runtime.arrays import Array, Scalar, Structure, read, read_only
from ms_highway.runtime.files import read_arrays, reading, replacing
from ms_highway.runtime.sources import digest

SHIPPED_VALUES = "shipped"
"""Name of the values that come with the package."""


# Networks

Layer: TypeAlias = tuple[
    Float[Array, "networks _inputs _outputs"], Float[Array, "networks _outputs"]
]
"""Weights and biases of one layer of several networks."""

Network: TypeAlias = tuple[Layer, ...]
"""Layers of several networks; all layers but the last are followed by tanh."""


def outputs(
    network: Network,
    inputs: Float[jax.Array, "inputs"],
) -> tuple[Float[jax.Array, "networks means"], Float[jax.Array, "networks means"]]:
    """Return the mean that each network predicts, and its raw standard deviation.

    `noise` computes the standard deviation from the raw one.
    """
    *hidden, (weights, biases) = network
    activations = jnp.broadcast_to(inputs, (len(biases), *inputs.shape))
    for layer_weights, layer_biases in hidden:
        sums = jnp.einsum("ni,nio->no", activations, layer_weights)
        activations = jnp.tanh(sums + layer_biases)
    both = jnp.einsum("ni,nio->no", activations, weights) + biases
    means, raw_stds = jnp.split(both, 2, axis=-1)
    return means, raw_stds


def noise(raw_stds: Float[jax.Array, "*shape"]) -> Float[jax.Array, "*shape"]:
    """Return standard deviations of outcomes from the raw ones of `outputs`.

    The floor is `Budget.little_gain`, the gain that counts as nothing.
    """
    return Budget.little_gain + jax.nn.softplus(raw_stds)


# The estimator

ValuesFile = Annotated[
    str | None, Meta(description="say 'shipped' or name a file of learned values")
]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class LearnedValue(Estimator[GameEvidence]):
    """Estimate gains by networks, from the situation of each human.

    The gain of a rung over the first one is a lower confidence bound: the mean over the
    networks, less a margin for their disagreement.

    Attributes:
        values: file of learned values, or ``"shipped"`` for the package's file for the
            kind of scene. None and ``""`` mean the package's file as well, but allow a
            longer ladder among several humans, see `values_for`. None in an episode,
            where the networks stand for it (static).
        margin: how much disagreement lowers a gain, in standard deviations among the
            means of the networks.
        nearest: number of the nearest humans for whom gains are estimated; None for all
            (static).
        network: networks that estimate the gains over the first rung from
            `ms_highway.choice.situation.describe`; none outside an episode.
        input_mean, input_std: mean and standard deviation by which the inputs of the
            networks are standardised; None outside an episode.
    """

    values: ValuesFile = field(default=None, metadata={"static": True})
    margin: Scalar = field(default=0.5, metadata=FROM_START)
    nearest: int | None = field(
        default=PriceTogether.most_humans, metadata={"static": True} | FROM_START
    )
    network: Network = field(default=(), metadata=FROM_START)
    input_mean: Float[Array, "inputs"] | None = field(default=None, metadata=FROM_START)
    input_std: Float[Array, "inputs"] | None = field(default=None, metadata=FROM_START)

    def __post_init__(self) -> None:
        # Refuse a file that cannot be read now; what was read is cached.
        if self.values and self.values != SHIPPED_VALUES:
            load_values(self.values)

    def values_for(self, start: Start) -> "Values":
        """Return the values of the file, or the shipped values for a kind of scene.

        Shipped values for several humans under physical semantics were learned on a
        shorter ladder. If a model is not on it, those under the paper's semantics are
        taken, unless ``values`` is an explicit ``"shipped"``.
        """
        kind = shipped_kind(start.semantics, start.humans)
        found = load_values(self.values or SHIPPED_VALUES, kind)

        names = {model.name for model in start.ladder}
        lacks_model = not names <= {*found.ladder}
        may_fall_back = not self.values and start.humans > 1
        if may_fall_back and lacks_model:
            return load_values(SHIPPED_VALUES, "several")
        return found

    def at_start(self, start: Start) -> "LearnedValue":
        """Return the estimator with the networks of its values.

        Args:
            start: start of an episode, whose ladder the estimator gets.

        Raises:
            ValueError: see `load_values` and `Values.estimator`.
        """
        values = self.values_for(start)
        estimator = values.estimator(start.ladder)
        return replace(estimator, margin=self.margin, nearest=self.nearest)

    def estimate(self, memory: Memory, evidence: GameEvidence) -> Estimate:
        """Estimate the gains of all rungs in the present state."""
        gains = jnp.full(memory.last_check.shape, NOT_ESTIMATED)  # [humans, rungs]
        if gains.shape[1] == 1:  # with one model, nothing can be gained
            return Estimate(gains, jnp.bool(False))

        # Describe the situations of the nearest humans.
        game = evidence.game
        state = evidence.outcome.after
        rank = distance_rank(game, state)
        nearest = jnp.argsort(rank)[: self.nearest]
        described = describe(game, state, nearest)  # [nearest, inputs]
        assert self.input_mean is not None
        assert self.input_std is not None
        inputs = (described - self.input_mean) / self.input_std

        # Mean of each network: [nearest, networks, rungs above the first]. The noise
        # that they predict serves learning alone.
        means, _ = jax.vmap(partial(outputs, self.network))(inputs)

        # Mean over the networks and their disagreement, 0 for the first rung.
        expected = _with_first_rung(jnp.mean(means, axis=1))  # [nearest, rungs]
        disagreement = _with_first_rung(jnp.std(means, axis=1))

        # Lower confidence bound. Where a number is not finite, no gain is estimated.
        known = jnp.isfinite(expected).all(axis=1, keepdims=True)
        lower_bound = expected - self.margin * disagreement
        estimated = jnp.where(known, lower_bound, NOT_ESTIMATED)
        gains = gains.at[nearest].set(estimated)
        return Estimate(gains, ~known.all())


def _with_first_rung(
    above_first: Float[jax.Array, "humans above"],
) -> Float[jax.Array, "humans rungs"]:
    """Return numbers of all rungs, 0 for the first, given those of the rungs above."""
    return jnp.pad(above_first, ((0, 0), (1, 0)))


# What was learned


@dataclass(frozen=True)
class ValuesFormat:
    """Set the form of files of learned values, and the limits of their numbers."""

    version: int = 3
    """Version of the form; files of another one are refused."""

    max_bytes: int = 2**24
    """Largest size of an unpacked file; the package's files have a hundredth."""

    min_std: float = 1e-9
    """Least standard deviation of an input; it rules out overflow."""

    max_number: float = 1e9
    """Largest mean or standard deviation of an input; it rules out overflow."""

    max_weight: float = 1e3
    """Largest weight or bias of a network; those of the package are below 1."""

    remedy: str = "learn values with `ms-highway values learn`"
    """What to do about a file that cannot be used, for messages."""


VALUES_FORMAT = ValuesFormat()


@dataclass(frozen=True)
class Values:
    """Result of ``ms-highway values learn``, the content of a file.

    Attributes:
        network: see `LearnedValue`.
        input_mean, input_std: mean and standard deviation of its inputs; in files,
            ``centre`` and ``spread``.
        ladder: names of the models that the values were learned on, cheapest first.
        inputs: names of the network's inputs.
        provenance: scenarios, settings and software versions with which the values were
            learned.
        place: file from which they were read, for messages.
    """

    network: Network
    input_mean: Float[np.ndarray, "inputs"]
    input_std: Float[np.ndarray, "inputs"]
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
            raise ValueError(
                f"the ladder has the models {list(self.ladder)}; it must have at least"
                " two, each once"
            )
        if self.inputs != description_names():
            raise ValueError("the networks have the inputs of another version")
        self._check_shapes()
        self._check_numbers()

    def _check_shapes(self) -> None:
        """Check that the layers fit each other, the inputs and the ladder.

        For each rung above the first, the last layer gives a mean and a raw standard
        deviation.
        """
        shapes = []
        for weights, biases in self.network:
            shapes += [np.shape(weights), np.shape(biases)]
        networks = shapes[0][:1] if shapes else ()

        # Numbers of inputs and outputs of the layers, as the shapes of biases tell.
        sizes = [len(self.inputs)]
        for bias_shape in shapes[1::2]:
            sizes += bias_shape[-1:]

        # Shapes of weights and biases, layer by layer.
        expected = []
        for inputs, outputs in pairwise(sizes):
            expected += [(*networks, inputs, outputs), (*networks, outputs)]

        last = 2 * (len(self.ladder) - 1)
        if shapes != expected or 0 in networks or sizes[-1] != last:
            raise ValueError(
                f"the networks have layers of shapes {shapes}, not those for"
                f" {len(self.ladder)} models"
            )

    def _check_numbers(self) -> None:
        """Check that all numbers are within the limits of `ValuesFormat`."""
        limits = VALUES_FORMAT
        for scale in (self.input_mean, self.input_std):
            one_each = np.shape(scale) == (len(self.inputs),)
            if not one_each or not (np.abs(scale) <= limits.max_number).all():
                raise ValueError(
                    f"centre or spread has a number beyond {limits.max_number:g}, or"
                    " not one for each input"
                )
        for layer in self.network:
            if not all((np.abs(part) <= limits.max_weight).all() for part in layer):
                raise ValueError(
                    f"the weights of the networks are beyond {limits.max_weight:g}, or"
                    " not finite"
                )
        if np.min(self.input_std) < limits.min_std:
            raise ValueError(f"spreads are below {limits.min_std:g}")

    def estimator(self, models: tuple[HumanModel, ...]) -> LearnedValue:
        """Return the estimator on a ladder of learned models.

        Args:
            models: part of the learned ladder, with the same first model.

        Raises:
            ValueError: if values of a model were not learned, or the ladder begins with
                another model.
        """
        names = [model.name for model in models]
        self._check_ladder(names)

        # Select the outputs of these models: their means, then their raw deviations.
        above_first = len(self.ladder) - 1
        mean_columns = [self.ladder.index(name) - 1 for name in names[1:]]
        std_columns = [above_first + column for column in mean_columns]
        selected = mean_columns + std_columns
        *hidden, (weights, biases) = self.network
        last = (weights[..., selected], biases[..., selected])
        return LearnedValue(
            network=(*hidden, last),
            input_mean=self.input_mean,
            input_std=self.input_std,
        )

    def _check_ladder(self, names: list[str]) -> None:
        """Check that values of these models were learned relative to the first one."""
        message = (
            f"{self.place}: values were learned on the ladder {' '.join(self.ladder)}"
        )
        alternatives = (
            "choose another controller, such as switching at a lambda of 0.1, or"
            f" {VALUES_FORMAT.remedy}"
        )
        unknown = [name for name in names if name not in self.ladder]
        if unknown:
            raise ValueError(
                f"{message}, without {unknown[0]!r}; {alternatives} --set"
                f" ladder={','.join(names)}"
            )
        if names[0] != self.ladder[0]:
            raise ValueError(
                f"{message}, over {self.ladder[0]!r}; begin the ladder with it,"
                f" {alternatives}"
            )

    def rule(
        self,
        models: tuple[HumanModel, ...],
        costs: Costs,
        price: float,
    ) -> Rule[GameEvidence]:
        """Return the rule that chooses by these values at a price, see `estimator`."""
        return Rule(models, costs, PriceTogether(price), self.estimator(models))


# Files


class _Provenance(TypedDict, total=False):
    """Entries of the provenance of values by which scenes are compared.

    All others are for people to read.
    """

    scenarios: list[str]
    semantics: Semantics
    solver: str
    planning_horizon: int | list[int]
    human_reward: str | dict[str, float] | None


class _About(Structure):
    """Description in a file of values; it has some of the fields of `Values`."""

    ladder: tuple[str, ...]
    inputs: tuple[str, ...]
    provenance: dict[str, Any]


def save_values(values: Values, path: Path) -> None:
    """Write learned values as a NumPy archive, atomically."""
    about: dict[str, object] = {"version": VALUES_FORMAT.version}
    for name in _About.__struct_fields__:
        about[name] = getattr(values, name)

    arrays: dict[str, Any] = {
        "about": np.array(json.dumps(about, default=dict)),
        "centre": values.input_mean,
        "spread": values.input_std,
    }
    for number, (weights, biases) in enumerate(values.network):
        arrays[f"weights_{number}"] = np.asarray(weights)
        arrays[f"biases_{number}"] = np.asarray(biases)

    with replacing(path) as temporary, temporary.open("wb") as file:
        np.savez(file, **arrays)


def load_values(which: str | PathLike[str], kind: SceneKind = "pair") -> Values:
    """Read learned values from the package or from a file that `save_values` wrote.

    Args:
        which: `SHIPPED_VALUES`, or a file.
        kind: kind of scene of the package's values.

    Raises:
        ValueError: if the file cannot be read, is damaged, or has another version.
    """
    if which == SHIPPED_VALUES:
        return _shipped(VALUE_FILES[kind])
    remedy = f"{VALUES_FORMAT.remedy} --out {which}"
    with reading(Path(which), remedy, " as learned values"):
        return _read(Path(which), digest(Path(which)))


@cache
def _shipped(name: str) -> Values:
    with resources.as_file(resources.files("ms_highway") / "data" / name) as path:
        return _read(path, "")


@cache
def _read(path: Path, content_digest: str) -> Values:
    """Read a file, once for each path and content.

    Args:
        path: of the file.
        content_digest: only a key of the cache; empty for the package's own files,
            which do not change.
    """
    arrays = read_arrays(path, VALUES_FORMAT.max_bytes)

    # The version first, as files of another one may have any other content.
    about = json.loads(str(arrays.pop("about")))
    version = about.pop("version", None) if isinstance(about, dict) else None
    if version != VALUES_FORMAT.version:
        raise ValueError(f"it is of version {version}, not {VALUES_FORMAT.version}")

    # Accept numbers only, and make them read-only: all readers of the file share them.
    for name, array in arrays.items():
        if array.dtype.kind not in "fiu":
            raise ValueError(f"{name} holds {array.dtype}; it must hold numbers")
    with np.errstate(over="ignore"):
        single = {name: array.astype(np.float32) for name, array in arrays.items()}
    numbers = read_only(single)

    input_mean = numbers.pop("centre")
    input_std = numbers.pop("spread")
    layers = range(len(numbers) // 2)
    network = tuple((numbers[f"weights_{n}"], numbers[f"biases_{n}"]) for n in layers)

    # Check the entries of the provenance that are compared.
    read(about.get("provenance"), _Provenance)
    described = read(about, _About)
    return Values(
        network,
        input_mean,
        input_std,
        described.ladder,
        described.inputs,
        described.provenance,
        place=str(path),
    )
