"""Describe humans' situations by numbers that mean the same in all scenes.

They are the inputs of the networks of `ms_highway.choice.learned_value`.
"""

from functools import partial

import jax
from jax import numpy as jnp
from jaxtyping import Float, Int

from ms_highway.game.dynamics import without_turns
from ms_highway.game.features import features
from ms_highway.game.game import Game, others_of, pair
from ms_highway.game.reward import PAPER_FEATURES, Reward
from ms_highway.game.scene import headways, neighbours
from ms_highway.runtime.arrays import Array, Index, State

LOOKAHEADS = (0.0, 0.5, 1.0, 2.0)
"""Times during which all cars keep their velocity [s]. They are among the inputs of the
shipped networks, which a change invalidates.
"""


def description_names() -> tuple[str, ...]:
    """Return the names of the numbers of `describe`, in their order."""
    players = ("robot", "human")

    # Terms of a reward: its features, then its gradient.
    gradient = []
    for whose in ("own", "partner's"):
        for part in ("x", "y", "heading", "speed"):
            gradient.append(f"d/d {whose} {part}")
    terms = (*PAPER_FEATURES, "other", *gradient)

    # The terms of both rewards, after each lookahead.
    rewards = []
    for player in players:
        for time in LOOKAHEADS:
            rewards += [f"{player}: {term} after {time:g} s" for term in terms]

    # The robot's state less the human's, and each of the two on the road.
    relative = ["x ahead of human", "y ahead of human", "speed ahead of human"]
    own = []
    for player in players:
        for part in ("heading", "speed", "y from target lane"):
            own.append(f"{player}: {part}")

    # Time gaps to the cars around both.
    gaps = []
    for player in players:
        for place in ("", " left", " right"):
            gaps.append(f"{player}: time gap ahead{place}")
            gaps.append(f"{player}: time gap behind{place}")

    return (*rewards, *relative, *own, *gaps, "share of humans nearer to the robot")


def describe(
    game: Game,
    state: State,
    humans: Int[Array, "some"],
) -> Float[jax.Array, "some numbers"]:
    """Compute the inputs of the networks for some humans, as `description_names` names.

    1. The rewards of robot and human, after all cars have kept their velocity for each
       of `LOOKAHEADS`: the weighted features, with a single sum for those beyond the
       paper's, and the gradient with respect to the states of both cars, in the scene's
       unit of length.
    2. The robot's state less the human's.
    3. For robot and human, the heading, the speed as a share of the speed limit, and
       the distance from the target lane.
    4. For robot and human, the time gaps to the cars around them.
    5. The share of humans who are nearer to the robot.

    Numbers n of 1 to 3 are compressed by ``sign(n) log(1 + |n|)``, as a collision or
    leaving the road costs a thousand times more than anything else; time gaps by
    ``log(1 + gap / s)``.

    Args:
        game: game with the rewards that the robot believes the humans to have.
        state: all cars.
        humans: indices of the humans to describe.
    """
    state = jnp.asarray(state)
    car_length, _ = game.scene.car_size
    rank = distance_rank(game, state)

    def gaps(car: Index) -> Float[jax.Array, "6"]:
        """Return the compressed time gaps of a car to the cars around it."""
        own = state[car]
        others = state[jnp.asarray(others_of(len(state)))[car]]
        present = jnp.ones(len(others), bool)
        width = jnp.asarray(game.scene.lane_width)
        around = neighbours(own, others, present, width)
        return jnp.log1p(headways(own, around, car_length))

    def describe_one(human: Index) -> Float[jax.Array, "numbers"]:
        numbers = _describe_pair(*pair(game, state, human))
        of_robot = gaps(0)
        of_human = gaps(1 + human)
        nearer = rank[human][None] / game.number
        return jnp.concatenate([numbers, of_robot, of_human, nearer])

    return jax.vmap(describe_one)(humans)


def distance_rank(game: Game, state: State) -> Int[jax.Array, "humans"]:
    """Return the rank of each human by the distance to the robot, 0 for the nearest.

    Of equally near ones, the first counts as nearer.
    """
    positions = jnp.asarray(state)[: 1 + game.number, :2]
    distances = jnp.linalg.norm(positions[1:] - positions[0], axis=1)
    by_distance = jnp.argsort(distances)
    return jnp.argsort(by_distance)


def _describe_pair(game: Game, state: State) -> Float[jax.Array, "numbers"]:
    """Return the compressed numbers of the robot and a human alone."""
    unit = jnp.asarray(game.scene.length_unit)
    limit = jnp.asarray(game.robot.speed_limit)
    _, y, any_heading, speed = jnp.moveaxis(state, -1, 0)  # each [cars]

    # States after all cars have kept their velocity: [lookaheads, cars, 4].
    heading = without_turns(any_heading)
    zeros = jnp.zeros_like(speed)
    along = speed * jnp.cos(heading)
    across = speed * jnp.sin(heading)
    change = jnp.stack([along, across, zeros, zeros], axis=-1)  # per second, [cars, 4]
    seconds = jnp.asarray(LOOKAHEADS)[:, None, None]
    coasted = state + seconds * change

    # The same with the human as the first car: [players, lookaheads, cars, 4].
    two_swapped = coasted[:, 1::-1]
    scripted = coasted[:, 2:]
    mirrored = jnp.concatenate([two_swapped, scripted], axis=1)
    states = jnp.stack([coasted, mirrored])

    # Features of both rewards then, and gradients: [players, lookaheads, terms].
    players = game.players()
    terms = jax.vmap(partial(_reward_terms, game))(players, states)

    # Where the robot is to the human.
    difference = state[0] - state[1]
    scale = jnp.stack([unit, unit, jnp.ones_like(unit), limit])
    x_y_speed = jnp.array([0, 1, 3])
    relative = (difference / scale)[x_y_speed]

    # Where each of the two is on the road: [players, 3].
    from_target_lane = (y[:2] - game.scene.target_lane) / unit
    speed_share = speed[:2] / limit
    own = jnp.stack([heading[:2], speed_share, from_target_lane], axis=1)

    numbers = jnp.concatenate([terms.ravel(), relative, own.ravel()])
    return jnp.sign(numbers) * jnp.log1p(jnp.abs(numbers))


def _reward_terms(
    game: Game,
    player: Reward,
    states: Float[jax.Array, "times cars 4"],
) -> Float[jax.Array, "times terms"]:
    """Return the weighted features of one player, car 0, and its reward's gradient.

    The gradient is the one with respect to the states of the first two cars.
    """

    def weighted_features(
        states: Float[jax.Array, "times cars 4"],
    ) -> Float[jax.Array, "times features"]:
        return features(game.scene, player, states) * player.weights

    weighted, vjp = jax.vjp(weighted_features, states)
    paper_features = weighted[:, : len(PAPER_FEATURES)]
    other_features = weighted[:, len(PAPER_FEATURES) :]
    other_sum = other_features.sum(axis=1, keepdims=True)

    # The reward is the sum of the weighted features.
    (gradient,) = vjp(jnp.ones_like(weighted))  # [times, cars, 4]
    unit = jnp.asarray(game.scene.length_unit)
    per_unit = jnp.stack([unit, unit, jnp.ones_like(unit), unit])
    scaled = gradient[:, :2] * per_unit  # [times, 2 cars, 4]
    flat = scaled.reshape(len(states), -1)
    return jnp.concatenate([paper_features, other_sum, flat], axis=1)
