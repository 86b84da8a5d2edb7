"""Learn the value of computation by rounds of rollouts and fits, as cost-sensitive
policy iteration.

Rollouts of later rounds follow the rule of the last fit, from states that this rule
visits. Every scenario and every fit of a round has its own stream of random numbers.
Therefore, a seed gives the same values on any number of devices, even if learning was
interrupted.
"""

from collections.abc import Iterator, Sequence
from dataclasses import asdict
from itertools import pairwise
from math import ceil
from pathlib import Path
from typing import Any
from zlib import crc32

import jax
import numpy as np
from jax import numpy as jnp

from ms_highway.choice.learned_value import Network, Values, noise, outputs
from ms_highway.choice.situation import description_names
from ms_highway.experiments.batch import Batch, make_batch
from ms_highway.experiments.comparison import Comparison
from ms_highway.experiments.directory import ResultsDirectory, this_run
from ms_highway.experiments.rollouts import SEVERAL, Driving, Learning, Random, Rollouts
from ms_highway.planning.costs import Costs
from ms_highway.planning.ladders import cheapest_first, human_model, ladder
from ms_highway.runtime.arrays import Array
from ms_highway.runtime.compilation import Devices
from ms_highway.runtime.extras import needing
from ms_highway.runtime.files import read_arrays, reading, replacing
from ms_highway.runtime.sources import late_sources

with needing("learning"):
    import optax

REMEDY = "remove it, or choose another --out"
MIN_SPREAD = 1e-3  # added to the standard deviation of an input, which may be 0
SCENARIO, FIT = 1, 2  # streams of random numbers

NETWORKS = 4  # which differ in their first weights and in the order of the examples
HIDDEN = (32, 32)
STEPS = 3000
EXAMPLES = 256  # per gradient step of each network
RATE = 3e-3  # first learning rate, which falls to 0 as a cosine
DECAY = 0.5  # share that weights lose per step, times the learning rate


def prepare(
    comparison: Comparison,
    rounds: int | None,
    states: int | None,
    horizon: int | None,
    seed: int,
) -> tuple[Learning, list[Batch]]:
    """Return the settings of learning, and the scenarios. None stands for the usual
    number.

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
    batches = [make_batch(comparison, scenario) for scenario in comparison.controllers]
    models = cheapest_first(name for batch in batches for name in batch.rungs)
    costs = {
        name: seconds
        for batch in batches
        for name, seconds in batch.costs.seconds.items()
    }
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
    horizons = sorted({batch.environment.settings.horizon for batch in batches})
    settings = {
        **comparison.common_config(),
        "versions": this_run()["versions"],
        "scenarios": list(comparison.controllers),
        "seed": seed,
        # Of plans, where "horizon" is that of rollouts; a list if scenarios differ.
        "planning_horizon": horizons[0] if len(horizons) == 1 else horizons,
    }
    later = states and (states if several else ceil(states * 5 / 8))
    given = {"rounds": rounds, "horizon": horizon, "states": later and (states, later)}
    own: dict = (SEVERAL if several else {}) | {
        name: value for name, value in given.items() if value
    }
    return (
        Learning(
            {name: costs[name] for name in models}, seed=seed, settings=settings, **own
        ),
        batches,
    )


def fitted(how: Learning, done: Sequence[Rollouts], number: int) -> Values:
    """Fit values to the rollouts of ``number`` rounds; without rollouts, return values
    that mean nothing.
    """
    random = _stream(how, number, FIT)
    names = description_names()
    network = new_network(random, len(names), len(how.costs) - 1)
    centre = np.zeros(len(names))
    spread = np.ones(len(names))
    if done:
        rollouts = Rollouts(*map(np.concatenate, zip(*done, strict=True)))
        centre = rollouts.descriptions.mean(axis=0)
        spread = rollouts.descriptions.std(axis=0) + MIN_SPREAD
        chosen = random.integers(
            len(rollouts.descriptions), size=(STEPS, NETWORKS, EXAMPLES)
        )
        standard = np.float32((rollouts.descriptions - centre) / spread)
        network = jax.tree.map(
            np.asarray, _fit(network, chosen, standard, np.float32(rollouts.gains))
        )
    examples = sum(len(part.descriptions) for part in done)
    settings = {
        "examples": examples,
        "rounds": number,
        "horizon": how.horizon,
        "held": how.held,
    }
    return Values(
        network, centre, spread, tuple(how.costs), names, {**how.settings, **settings}
    )


def _stream(how: Learning, *place: int) -> Random:
    """Return the stream of random numbers of a place, such as a round and the number of
    a scenario.
    """
    return np.random.default_rng([how.seed, *place])


def learn(
    learning: Learning,
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
    names = [batch.environment.scenario.name for batch in batches]
    games = []
    for name, batch in zip(names, batches, strict=True):
        numbers = [
            np.asarray(leaf, np.float32).tobytes()
            for leaf in jax.tree.leaves(batch.loop.game)
        ]
        games.append((name, batch.steps, batch.rungs, crc32(b"".join(numbers))))
    results = ResultsDirectory(kept)
    settings = results.take_up(
        {**asdict(learning), "games": games}, batches[0].comparison.sources()
    )
    results.write_settings(settings)
    values = fitted(learning, [], 0)
    done = list[Rollouts]()
    for number in range(1, learning.rounds + 1):
        for place, batch in enumerate(batches):
            file = kept / f"{number}-{place}.npz"
            if not file.exists():
                seconds = {name: learning.costs[name] for name in batch.rungs}
                costs = Costs.of(seconds, batch.humans)
                rule = values.rule(ladder(batch.rungs), costs, learning.prices[0])
                driving = Driving(batch, learning, rule, number > 1, devices)
                found = driving.roll_out(
                    _stream(learning, number, SCENARIO, place),
                    learning.states[number > 1],
                )
                results.add_late_sources(settings, late_sources())
                with replacing(file) as path:
                    np.savez(path, **found._asdict())
            done.append(read_rollouts(file))
            yield f"round {number} of {learning.rounds}: {names[place]}", None
        values = fitted(learning, done, number)
        yield f"round {number} of {learning.rounds}: fitted", values


def read_rollouts(file: Path) -> Rollouts:
    """Read rollouts that an interrupted run has kept.

    Raises:
        ValueError: if the file is damaged, or holds numbers that are not finite.
    """
    with reading(file, REMEDY):
        kept = Rollouts(
            **read_arrays(file, file.stat().st_size)
        )  # it is not compressed
        if not np.isfinite(kept.descriptions).all() or not (kept.gains < np.inf).all():
            raise ValueError("it holds numbers that are not finite")
    return kept


def new_network(random: Random, inputs: int, means: int) -> Network:
    """Draw first weights whose variance keeps the scale of activations across tanh
    layers (LeCun et al. 1998).
    """
    return tuple(
        (
            (random.normal(size=(NETWORKS, one, other)) / np.sqrt(one)).astype(
                np.float32
            ),
            np.zeros((NETWORKS, other), np.float32),
        )
        for one, other in pairwise([inputs, *HIDDEN, 2 * means])
    )


@jax.jit
def _fit(network: Network, chosen: Array, inputs: Array, gains: Array) -> Network:
    """Fit the gains of rungs over the first one, and their spreads, by AdamW and the
    likelihood of normal errors.

    If small causes have large effects, as in Stay Back with 20 gradient steps, the
    spread is large, and errors weigh less.

    Args:
        network: first weights.
        chosen: places of the examples of every gradient step and network, [steps,
            networks, examples].
        inputs: standardised descriptions of all examples.
        gains: their gains.
    """

    def one(network: Network, inputs: jax.Array) -> tuple[jax.Array, jax.Array]:
        means, spreads = outputs(jax.tree.map(lambda part: part[None], network), inputs)
        return means[0], noise(spreads[0])

    def loss(network: Network, chosen: Array) -> Array:
        means, apart = jax.vmap(jax.vmap(one, in_axes=(None, 0)))(
            network, jnp.asarray(inputs)[chosen]
        )
        counts = jnp.isfinite(gains[chosen])
        errors = means - jnp.where(counts, gains[chosen], 0)
        surprise = errors**2 / (2 * apart**2) + jnp.log(apart)
        surprise *= jax.lax.stop_gradient(
            apart
        )  # errors weigh more than their likelihood says (Seitzer et al. 2022)
        return jnp.where(counts, surprise, 0).sum(axis=-1).mean(axis=-1).sum()

    optimizer = optax.adamw(
        optax.cosine_decay_schedule(RATE, len(chosen)), weight_decay=DECAY
    )

    def step(carry: Any, chosen: jax.Array) -> tuple[Any, None]:
        network, state = carry
        updates, state = optimizer.update(
            jax.grad(loss)(network, chosen), state, network
        )
        return (optax.apply_updates(network, updates), state), None

    (network, _), _ = jax.lax.scan(
        step, (network, optimizer.init(network)), jnp.asarray(chosen)
    )
    return network
