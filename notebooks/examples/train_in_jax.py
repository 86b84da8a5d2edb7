"""Train an agent to choose human models, by PPO in JAX.

It trains on many environments at once; needs optax. The agent chooses a model for every
human in every step, and pays for the plan: its reward is r_R - lambda T(M). With one
human its action space is Discrete, with several MultiDiscrete; the same network serves
both::

    pip install -e ".[learning]"
    python notebooks/examples/train_in_jax.py merger-v1
    python notebooks/examples/train_in_jax.py dense_merge --set humans=3 --updates 20

Prints the reward of the agent while it learns, and at the end beside random choice,
``naive`` and ``learned:1``.
"""

import argparse
from time import perf_counter

import gymnasium as gym
import jax
import jax.numpy as jnp
import numpy as np
import optax

import ms_highway
from ms_highway.cli.options import configuration
from ms_highway.envs import environment_id
from ms_highway.experiments.batch import simulated
from ms_highway.experiments.comparison import Comparison

DISCOUNT = 0.97
TRACE = 0.9
CLIP = 0.2
ENTROPY = 0.01
EPOCHS = 6
BATCHES = 8
HIDDEN = 64
SCALE = 0.1  # of rewards, so that values are about 1


def layers(key, sizes):
    """Draw the weights and biases of a network."""
    keys = jax.random.split(key, len(sizes) - 1)
    shapes = list(zip(keys, sizes[:-1], sizes[1:], strict=True))
    return [
        (jax.random.normal(key, (one, other)) / one**0.5, jnp.zeros(other))
        for key, one, other in shapes
    ]


def network(parameters, inputs):
    """Return the outputs of a network with tanh units."""
    for weights, biases in parameters[:-1]:
        inputs = jnp.tanh(inputs @ weights + biases)
    weights, biases = parameters[-1]
    return inputs @ weights + biases


def logits_of(parameters, observations, heads):
    """Return the log-probability of each model for each human [..., humans, rungs]."""
    flat = network(parameters["policy"], observations)
    return jax.nn.log_softmax(flat.reshape(*flat.shape[:-1], *heads))


def log_probability(logits, actions):
    return jnp.take_along_axis(logits, actions[..., None].astype(int), axis=-1)[
        ..., 0
    ].sum(axis=-1)


def advantages(rewards, values, last, ends):
    """Return generalised advantage estimates of [steps, environments]."""

    def back(carry, step):
        following, ahead = carry
        reward, value, end = step
        delta = reward + DISCOUNT * ahead * (1 - end) - value
        advantage = delta + DISCOUNT * TRACE * (1 - end) * following
        return (advantage, value), advantage

    return jax.lax.scan(
        back, (jnp.zeros_like(last), last), (rewards, values, ends), reverse=True
    )[1]


def loss(parameters, batch, heads):
    """Return PPO's clipped loss."""
    observations, actions, before, advantage, returns = batch
    logits = logits_of(parameters, observations, heads)
    ratio = jnp.exp(log_probability(logits, actions) - before)
    normal = (advantage - advantage.mean()) / (advantage.std() + 1e-6)
    gain = jnp.minimum(
        ratio * normal, jnp.clip(ratio, 1 - CLIP, 1 + CLIP) * normal
    ).mean()
    entropy = -(jnp.exp(logits) * logits).sum(axis=(-2, -1)).mean()
    error = jnp.square(
        network(parameters["value"], observations)[..., 0] - returns
    ).mean()
    return error / 2 - gain - ENTROPY * entropy


def train(env, updates, steps, optimiser, seed=0):
    """Return the parameters of a trained agent, and its shape; print how it learns."""
    space = env.single_action_space
    heads = (
        (1, int(space.n))
        if isinstance(space, gym.spaces.Discrete)
        else (len(space.nvec), int(space.nvec[0]))
    )
    inputs = int(np.prod(env.single_observation_space.shape))
    keys = jax.random.split(jax.random.key(seed), 3)
    sizes = [inputs, HIDDEN, HIDDEN]
    parameters = {
        "policy": layers(keys[0], [*sizes, heads[0] * heads[1]]),
        "value": layers(keys[1], [*sizes, 1]),
    }
    state = optimiser.init(parameters)
    key = keys[2]

    @jax.jit
    def choose(parameters, observations, key):
        logits = logits_of(parameters, observations, heads)
        actions = jax.random.categorical(key, logits)
        return (
            actions,
            log_probability(logits, actions),
            network(parameters["value"], observations)[..., 0],
        )

    @jax.jit
    def learn(parameters, state, rollout, last, key):
        observations, actions, before, values, rewards, ends = rollout
        advantage = advantages(rewards, values, last, ends)
        data = observations, actions, before, advantage, advantage + values
        flat = jax.tree.map(lambda part: part.reshape(-1, *part.shape[2:]), data)

        def update(carry, places):
            batch = jax.tree.map(lambda part: part[places], flat)
            slopes = jax.grad(loss)(carry[0], batch, heads)
            changes, state = optimiser.update(slopes, carry[1], carry[0])
            return (optax.apply_updates(carry[0], changes), state), None

        count = len(flat[0])
        orders = jax.vmap(lambda key: jax.random.permutation(key, count))(
            jax.random.split(key, EPOCHS)
        )
        return jax.lax.scan(
            update, (parameters, state), orders.reshape(EPOCHS * BATCHES, -1)
        )[0]

    observations = flatten(env.reset(seed=seed)[0])
    start = perf_counter()
    for number in range(updates):
        rollout = []
        for _ in range(steps):
            key, drawn = jax.random.split(key)
            actions, before, values = choose(parameters, observations, drawn)
            seen, rewards, terminated, truncated, _ = env.step(
                np.asarray(actions).reshape(env.action_space.shape)
            )
            rollout.append(
                (
                    observations,
                    actions,
                    before,
                    values,
                    SCALE * rewards,
                    terminated | truncated,
                )
            )
            observations = flatten(seen)
        rollout = [
            np.stack([np.asarray(step[part]) for step in rollout]).astype(np.float32)
            for part in range(6)
        ]
        key, drawn = jax.random.split(key)
        last = choose(parameters, observations, drawn)[2]
        parameters, state = learn(parameters, state, rollout, last, drawn)
        print(
            f"{perf_counter() - start:5.0f} s, update {number + 1}:"
            f" {rollout[4].mean() / SCALE:.3f} per step",
            flush=True,
        )
    return parameters, heads


def flatten(observations):
    return observations.reshape(len(observations), -1)


def judge(env, choose, seed):
    """Return the mean reward per step of a whole episode in every environment."""
    seen = env.reset(seed=seed)[0]
    total = 0.0
    count = 0
    done = False
    while not done:
        seen, rewards, _, truncated, _ = env.step(choose(seen))
        total = total + rewards.mean()
        count = count + 1
        done = truncated.all()
    return total / count


if __name__ == "__main__":
    ms_highway.keep_compilations()  # before JAX computes anything
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("scenario", nargs="?", default="merger-v1")
    parser.add_argument(
        "--price",
        type=float,
        default=1.0,
        help="lambda, reward per second (default: 1)",
    )
    parser.add_argument("--updates", type=int, default=30)
    parser.add_argument("--environments", type=int, default=64)
    parser.add_argument(
        "--set", dest="keys", action="append", default=[], metavar="KEY=VALUE"
    )
    options = parser.parse_args()
    config = configuration(options)
    action = {"action": {"type": "HumanModelAction", "lambda": options.price}}
    env = gym.make_vec(
        environment_id(options.scenario),
        options.environments,
        config=config | action,
        autoreset_mode="SameStep",
    )
    steps = env.unwrapped.episode_steps
    optimiser = optax.chain(optax.clip_by_global_norm(1.0), optax.adam(2e-3))
    parameters, heads = train(env, options.updates, steps, optimiser)

    def agent(seen):
        best = logits_of(parameters, flatten(seen), heads).argmax(axis=-1)
        return np.asarray(best).reshape(env.action_space.shape)

    seed = 10_000  # of starts from which the agent has not learned
    earned = {
        "agent": judge(env, agent, seed),
        "random": judge(env, lambda _: env.action_space.sample(), seed),
    }
    peers = Comparison(
        {options.scenario: ["naive", "learned:1"]}, options.environments, seed, config
    )
    steps = simulated(peers)
    less = steps["reward"] - options.price * steps["counted_seconds"]
    earned |= less.groupby(steps["controller"]).mean().to_dict()
    for name, reward in earned.items():
        print(f"{name:12}{reward:8.3f} per step, less lambda T")
