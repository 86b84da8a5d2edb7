"""Learn the value of computation by rounds of rollouts and fits.

This is cost-sensitive policy iteration. Rollouts of later rounds follow the rule of the
last fit, from states that this rule visits. Every scenario and every fit of a round has
its own stream of random numbers. Therefore, a seed gives the same values on any number
of devices, even if learning was interrupted.
"""

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from enum import IntEnum
from itertools import pairwise
from math import ceil
from pathlib import Path
from zlib import crc32

import jax
import numpy as np
from jax import numpy as jnp

from ms_highway.choice.learned_value import Network, Values, noise, outputs
from ms_highway.choice.situation import description_names
from ms_highway.experiments.batch import Batch, make_batch
from ms_highway.experiments.comparison import Comparison
from ms_highway.experiments.directory import ResultsDirectory, this_run
from ms_highway.experiments.rollouts import (
    LearningSettings,
    Random,
    Rollouts,
    RolloutSimulator,
)
from ms_highway.planning.costs import Costs
from ms_highway.planning.ladders import cheapest_first, human_model, ladder
from ms_highway.runtime.arrays import Array
from ms_highway.runtime.compilation import Devices
from ms_highway.runtime.extras import needing
from ms_highway.runtime.files import read_arrays, reading, replacing
from ms_highway.runtime.sources import late_sources

with needing("learning"):
    import optax


class Stream(IntEnum):
    """Number the streams of random numbers of a round."""

    ROLLOUTS = 1
    FIT = 2


@dataclass(frozen=True)
class FitSettings:
    """Set the networks and how they are fitted."""

    networks: int = 4
    """Number of networks. They differ in their first weights and in the order of the
    examples, and so tell how sure they are.
    """
    hidden: tuple[int, ...] = (32, 32)
    """Number of units in each hidden layer."""
    steps: int = 3000
    """Number of gradient steps."""
    examples: int = 256
    """Number of examples in a gradient step of a network."""
    rate: float = 3e-3
    """First learning rate, which falls to 0 as a cosine."""
    decay: float = 0.5
    """Share that weights lose per step, times the learning rate."""
    min_spread: float = 1e-3
    """Added to the standard deviation of an input, which may be 0."""


FIT = FitSettings()


def prepare(
    comparison: Comparison,
    rounds: int | None,
    states: int | None,
    horizon: int | None,
    seed: int,
) -> tuple[LearningSettings, list[Batch]]:
    """Return the settings of learning, and the scenarios.

    None stands for the usual number.

    Args:
        comparison: the scenarios, with a controller that needs T(M) of all models.
        rounds: number of rounds of rollouts and fits.
        states: number of states from which rollouts start in the first round. With one
            human, each later round has 5 for every 8 of them.
        horizon: number of steps of a rollout.
        seed: seed of everything that is drawn.

    Raises:
        ValueError: naming what prevents learning.
    """
    scenarios = comparison.controllers
    batches = [make_batch(comparison, scenario) for scenario in scenarios]
    models = cheapest_first(name for batch in batches for name in batch.rungs)
    several = batches[0].humans > 1
    if any((batch.humans > 1) != several for batch in batches):
        raise ValueError(
            "some scenarios have one human, others several; learn a file for each kind"
        )
    if any(human_model(name).warm for name in models):
        raise ValueError(
            "rollouts begin without a last plan; leave +warm out of the ladder"
        )
    if batches[0].loop.drivers:
        remedy = "leave config['yielding'] and config['human_driver'] out"
        raise ValueError(
            f"values are learned among humans who plan for their reward; {remedy}"
        )

    # What the file of the values will tell about how they were learned.
    horizons = sorted({batch.environment.settings.horizon for batch in batches})
    provenance = {
        **comparison.common_config(),
        "versions": this_run()["versions"],
        "scenarios": list(scenarios),
        "seed": seed,
        # Of plans, where "horizon" is that of rollouts; a list if scenarios differ.
        "planning_horizon": horizons[0] if len(horizons) == 1 else horizons,
    }

    # Numbers that differ from the defaults.
    own: dict = dict(LearningSettings.for_several_humans) if several else {}
    if rounds:
        own["rounds"] = rounds
    if horizon:
        own["horizon"] = horizon
    if states:
        own["states"] = (states, states if several else ceil(states * 5 / 8))

    seconds: dict[str, float] = {}
    for batch in batches:
        seconds |= batch.costs.seconds
    costs = {name: seconds[name] for name in models}
    learning = LearningSettings(costs, seed=seed, settings=provenance, **own)
    return learning, batches


def fit_values(
    learning: LearningSettings,
    done: Sequence[Rollouts],
    number: int,
) -> Values:
    """Fit values to the rollouts of ``number`` rounds.

    Without rollouts, return values that mean nothing.
    """
    random = _stream(learning, number, Stream.FIT)
    names = description_names()
    models = tuple(learning.costs)
    network = new_network(random, len(names), len(models) - 1)
    centre = np.zeros(len(names))
    spread = np.ones(len(names))
    if done:
        descriptions = np.concatenate([part.descriptions for part in done])
        gains = np.concatenate([part.gains for part in done])
        centre = descriptions.mean(axis=0)
        spread = descriptions.std(axis=0) + FIT.min_spread
        standard = (descriptions - centre) / spread

        # Indices of the examples of every gradient step and network.
        size = (FIT.steps, FIT.networks, FIT.examples)
        chosen = random.integers(len(descriptions), size=size)
        fitted_network = _fit(
            network,
            chosen,
            np.float32(standard),
            np.float32(gains),
        )
        network = jax.tree.map(np.asarray, fitted_network)
    provenance = {
        **learning.settings,
        "examples": sum(len(part.descriptions) for part in done),
        "rounds": number,
        "horizon": learning.horizon,
        "held": learning.held,
    }
    return Values(network, centre, spread, models, names, provenance)


def _stream(learning: LearningSettings, *place: int) -> Random:
    """Return the random numbers of a place: a round, a `Stream` and a scenario."""
    return np.random.default_rng([learning.seed, *place])


def learn(
    learning: LearningSettings,
    batches: Sequence[Batch],
    kept: Path,
    devices: Devices | None = None,
) -> Iterator[tuple[str, Values | None]]:
    """Learn values in some scenarios.

    Args:
        learning: settings.
        batches: the scenarios.
        kept: directory that keeps all rollouts, so that an interrupted run can resume;
            the caller removes it.
        devices: that simulate the rollouts; by default, the first.

    Yields:
        What was done, after the rollouts of each scenario and after each fit; and after
        a fit, the values.

    Raises:
        ValueError: if the directory exists and holds something else.
    """
    # A run is resumed only in the same games.
    games = [_fingerprint(batch) for batch in batches]
    results = ResultsDirectory(kept)
    sources = batches[0].comparison.sources()
    settings = results.take_up({**asdict(learning), "games": games}, sources)
    results.write_settings(settings)

    values = fit_values(learning, [], 0)
    done: list[Rollouts] = []
    for number in range(1, learning.rounds + 1):
        is_later = number > 1
        for place, batch in enumerate(batches):
            file = kept / f"{number}-{place}.npz"
            if not file.exists():
                # The rule of the last fit drives, on the ladder of the scenario.
                seconds = {name: learning.costs[name] for name in batch.rungs}
                costs = Costs.of(seconds, batch.humans)
                rule = values.rule(ladder(batch.rungs), costs, learning.prices[0])
                simulator = RolloutSimulator(batch, learning, rule, is_later, devices)

                random = _stream(learning, number, Stream.ROLLOUTS, place)
                count = learning.states[is_later]
                found = simulator.roll_out(random, count)
                results.add_late_sources(settings, late_sources())
                with replacing(file) as path:
                    np.savez(path, **found._asdict())
            done.append(read_rollouts(file))
            scenario = batch.environment.scenario.name
            yield f"round {number} of {learning.rounds}: {scenario}", None
        values = fit_values(learning, done, number)
        yield f"round {number} of {learning.rounds}: fitted", values


def _fingerprint(batch: Batch) -> tuple[str, int, list[str], int]:
    """Return what tells the game of a scenario apart from others."""
    leaves = jax.tree.leaves(batch.loop.game)
    numbers = [np.asarray(leaf, np.float32).tobytes() for leaf in leaves]
    checksum = crc32(b"".join(numbers))
    scenario = batch.environment.scenario.name
    return scenario, batch.steps, batch.rungs, checksum


def read_rollouts(file: Path) -> Rollouts:
    """Read rollouts that an interrupted run has kept.

    Raises:
        ValueError: if the file is damaged, or holds numbers that are not finite.
    """
    with reading(file, "remove it, or choose another --out"):
        # It is not compressed, so its arrays are not larger than the file.
        kept = Rollouts(**read_arrays(file, file.stat().st_size))
        are_finite = np.isfinite(kept.descriptions).all()
        # A gain is -inf where a rung is not on the ladder.
        if not are_finite or not (kept.gains < np.inf).all():
            raise ValueError("it holds numbers that are not finite")
    return kept


def new_network(random: Random, inputs: int, means: int) -> Network:
    """Draw the first weights of networks.

    Their variance keeps the scale of activations across tanh layers (LeCun et al.
    1998).

    Args:
        random: random numbers.
        inputs: number of inputs.
        means: number of gains; the networks have a mean and a spread of each.
    """
    widths = [inputs, *FIT.hidden, 2 * means]
    layers = []
    for before, after in pairwise(widths):
        drawn = random.normal(size=(FIT.networks, before, after))
        weights = (drawn / np.sqrt(before)).astype(np.float32)
        biases = np.zeros((FIT.networks, after), np.float32)
        layers.append((weights, biases))
    return tuple(layers)


@jax.jit
def _fit(network: Network, chosen: Array, inputs: Array, gains: Array) -> Network:
    """Fit the gains of rungs over the first one, and their spreads.

    AdamW maximises the likelihood of normal errors. If small causes have large effects,
    as in Stay Back with 20 gradient steps, the spread is large, and errors weigh less.

    Args:
        network: first weights.
        chosen: places of the examples of every gradient step and network, [steps,
            networks, examples].
        inputs: standardised descriptions of all examples.
        gains: their gains.
    """

    def predict(network: Network, inputs: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Return the mean and the spread of each gain, by one network of its own."""
        single_network = jax.tree.map(lambda weights: weights[None], network)
        means, spreads = outputs(single_network, inputs)
        return means[0], noise(spreads[0])

    def loss(network: Network, chosen: Array) -> Array:
        """Return the loss of all networks on examples, [networks, examples]."""
        predict_all = jax.vmap(jax.vmap(predict, in_axes=(None, 0)))
        # [networks, examples, rungs above the first]
        means, spreads = predict_all(network, jnp.asarray(inputs)[chosen])

        # Models off the ladder, with gains of -inf, do not count.
        counts = jnp.isfinite(gains[chosen])
        errors = means - jnp.where(counts, gains[chosen], 0)

        # Negative logarithm of a normal density, times the spread: errors weigh more
        # than their likelihood says (Seitzer et al. 2022).
        surprise = errors**2 / (2 * spreads**2) + jnp.log(spreads)
        surprise *= jax.lax.stop_gradient(spreads)
        counted = jnp.where(counts, surprise, 0)
        return counted.sum(axis=-1).mean(axis=-1).sum()

    rate = optax.cosine_decay_schedule(FIT.rate, len(chosen))
    optimizer = optax.adamw(rate, weight_decay=FIT.decay)

    def step(
        carry: tuple[Network, optax.OptState],
        chosen: jax.Array,
    ) -> tuple[tuple[Network, optax.OptState], None]:
        """Take one gradient step."""
        network, state = carry
        gradient = jax.grad(loss)(network, chosen)
        updates, state = optimizer.update(gradient, state, network)
        return (optax.apply_updates(network, updates), state), None

    start = (network, optimizer.init(network))
    (network, _), _ = jax.lax.scan(step, start, jnp.asarray(chosen))
    return network
