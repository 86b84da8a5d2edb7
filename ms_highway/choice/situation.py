"""Describe humans' situations by numbers that mean the same in all scenes.

Learned values of computation take these numbers.
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
from ms_highway.runtime.arrays import Array, Index, Rungs, State

LOOKAHEADS = (0.0, 0.5, 1.0, 2.0)
"""Times during which all cars keep their velocity [s]. Shipped values know these."""


def description_names() -> tuple[str, ...]:
    """Return the names of the numbers of `describe`, in their order."""
    state = ("x", "y", "heading", "speed")
    slopes = [f"d/d {whose} {part}" for whose in ("own", "partner's") for part in state]
    terms = (*PAPER_FEATURES, "other", *slopes)

    players = ("robot", "human")
    rewards = [
        f"{player}: {term} after {time:g} s"
        for player in players
        for time in LOOKAHEADS
        for term in terms
    ]
    relative = [f"{part} ahead of human" for part in ("x", "y", "speed")]
    own = [
        f"{player}: {part}"
        for player in players
        for part in ("heading", "speed", "y from target lane")
    ]
    places = (
        *("ahead", "behind"),
        *("ahead left", "behind left"),
        *("ahead right", "behind right"),
    )
    gaps = [f"{player}: time gap {place}" for player in players for place in places]
    return (*rewards, *relative, *own, *gaps, "share of humans nearer to the robot")


def describe(
    game: Game,
    state: State,
    humans: Int[Array, "some"],
) -> Float[jax.Array, "some numbers"]:
    """Compute the numbers by which learned values choose, for some humans.

    `description_names` names them.

    For robot and human, after all cars have kept their velocity for each of
    `LOOKAHEADS`: the weighted features of their rewards, with a single sum for those
    beyond the paper's, and the derivatives of the rewards in both cars' states, in the
    scene's unit of length. Then their relative state, their headings, their speeds as
    shares of the speed limit, and their distances from the target lane. All these are
    compressed by ``sign(n) log(1 + |n|)``, as a collision or leaving the road costs a
    thousand times more than anything else. Finally, the time gaps of both to the cars
    around them, as ``log(1 + gap / s)``, and the share of humans who are nearer to the
    robot.

    Args:
        game: game with the rewards that the robot believes the humans to have.
        state: all cars.
        humans: places of the humans to describe.
    """
    state = jnp.asarray(state)
    car_length, _ = game.scene.car_size
    rank = nearness(game, state)

    def gaps(car: Index) -> Float[jax.Array, "6"]:
        """Return the compressed time gaps of a car to the cars around it."""
        others = state[jnp.asarray(others_of(len(state)))[car]]
        present = jnp.ones(len(others), bool)
        width = jnp.asarray(game.scene.lane_width)
        return jnp.log1p(
            headways(
                state[car], neighbours(state[car], others, present, width), car_length
            )
        )

    def one(human: Index) -> Float[jax.Array, "numbers"]:
        numbers = _describe_pair(*pair(game, state, human))
        of_robot = gaps(0)
        of_human = gaps(1 + human)
        nearer = rank[human][None] / game.number
        return jnp.concatenate([numbers, of_robot, of_human, nearer])

    return jax.vmap(one)(humans)


def nearness(game: Game, state: State) -> Rungs:
    """Return, for each human, how many are nearer to the robot.

    Of equally near ones, the first counts as nearer.
    """
    places = jnp.asarray(state)[: 1 + game.number, :2]
    distances = jnp.linalg.norm(places[1:] - places[0], axis=1)
    return jnp.argsort(jnp.argsort(distances))


def _describe_pair(game: Game, state: State) -> Float[jax.Array, "numbers"]:
    """Return the compressed numbers of the robot and a human alone."""
    unit = jnp.asarray(game.scene.length_unit)
    limit = jnp.asarray(game.robot.speed_limit)
    _, y, turned, speed = jnp.moveaxis(state, -1, 0)  # each [cars]

    # States after all cars have kept their velocity, [lookaheads, cars, 4], and the
    # same with the human as the first car.
    heading = without_turns(turned)
    none = jnp.zeros_like(speed)
    velocity = jnp.stack(
        [speed * jnp.cos(heading), speed * jnp.sin(heading), none, none], axis=-1
    )
    coasted = state + jnp.asarray(LOOKAHEADS)[:, None, None] * velocity
    mirrored = jnp.concatenate([coasted[:, 1::-1], coasted[:, 2:]], axis=1)

    # What both rewards are then, and how they change: [players, lookaheads, terms].
    players = game.players()
    states = jnp.stack([coasted, mirrored])
    terms = jax.vmap(partial(_terms, game))(players, states)

    # Where the two are to each other, and each to the road.
    difference = state[0] - state[1]
    relative = difference / jnp.stack([unit, unit, jnp.ones_like(unit), limit])
    from_target_lane = (y[:2] - game.scene.target_lane) / unit
    own = jnp.stack([heading[:2], speed[:2] / limit, from_target_lane], axis=1)

    x_y_speed = jnp.array([0, 1, 3])
    numbers = jnp.concatenate([terms.ravel(), relative[x_y_speed], own.ravel()])
    return jnp.sign(numbers) * jnp.log1p(jnp.abs(numbers))


def _terms(
    game: Game,
    player: Reward,
    states: Float[jax.Array, "times cars 4"],
) -> Float[jax.Array, "times terms"]:
    """Return the weighted features of one player, car 0, and its reward's derivatives.

    The derivatives are those in both cars' states.
    """
    weighted, pull = jax.vjp(
        lambda states: features(game.scene, player, states) * player.weights, states
    )
    papers = weighted[:, : len(PAPER_FEATURES)]
    other = weighted[:, len(PAPER_FEATURES) :].sum(axis=1, keepdims=True)

    slopes = pull(jnp.ones_like(weighted))[0][:, :2]  # [times, 2 cars, 4]
    unit = jnp.asarray(game.scene.length_unit)
    slopes = slopes * jnp.stack([unit, unit, jnp.ones_like(unit), unit])
    return jnp.concatenate([papers, other, slopes.reshape(len(states), -1)], axis=1)
