"""Compare the block-diagonal response of several humans with their full joint one, in random situations."""

from functools import partial
from typing import Any

import jax
import numpy as np
from jax import numpy as jnp
from jaxtyping import Float

from ms_highway.game.crowd import Crowd, along_others, coasting, human_game, others_of
from ms_highway.game.crowd_scenario import crowd_game, crowd_scenario, draw_crowd
from ms_highway.game.game import constant_velocity, discomfort, move
from ms_highway.optimization.damped_newton import damped_factor
from ms_highway.runtime.compilation import jit_quickly

__all__ = ["ascent_directions", "compare_responses"]

ASIDE, SLOWER, TURNED, CONTROLS = 3.3, 6.0, 0.1, 0.1  # m, m/s, rad and scaled controls: spread of situations
QUANTILES = (0.0, 0.01, 0.05, 0.25, 0.5)


def compare_responses(scenario: str, humans: int, count: int, seed: int = 0) -> dict[str, Any]:
    """Compute the cosine between the robot's ascent directions with both responses, under theory of mind for all.

    The robot is placed between the lanes, turned and slowed down at random, amid a drawn crowd, and all players'
    controls differ at random from those that keep their velocity.

    Args:
        scenario: name of one with several humans.
        humans: their number.
        count: number of situations.
        seed: of the random numbers.

    Returns:
        ``cosines``: quantiles by name; ``situations``: number of situations in which they differ at all
        (below 1 - 1e-6); ``length_ratio``: median length of the block-diagonal direction over that of the full one.
    """
    chosen, random = crowd_scenario(scenario), np.random.default_rng(seed)
    crowd = crowd_game(chosen, humans)
    cosines, ratios = [], []
    for _ in range(count):
        starts, weights = draw_crowd(chosen, humans, random)
        starts[0] += [0.0, -random.uniform(0, ASIDE), random.normal(0, TURNED), -random.uniform(0, SLOWER)]
        noise = random.normal(0, CONTROLS, (1 + humans, crowd.game.planner.horizon, 2))
        state, aside = (np.asarray(part, np.float32) for part in (starts, noise))
        block, full = map(np.asarray, ascent_directions(Crowd(crowd.game, weights), state, aside))
        lengths = np.linalg.norm(block), np.linalg.norm(full)
        cosines.append(float(block @ full / (lengths[0] * lengths[1])))
        ratios.append(float(lengths[0] / lengths[1]))
    quantiles = {f"{share:g}": float(np.quantile(cosines, share)) for share in QUANTILES}
    differ = int(np.sum(np.array(cosines) < 1 - 1e-6))
    return {"cosines": quantiles, "situations": differ, "of": count, "length_ratio": float(np.median(ratios))}


@jit_quickly
def ascent_directions(
    crowd: Crowd, state: Float[jax.Array, "cars 4"], aside: Float[jax.Array, "players steps 2"]
) -> tuple[Float[jax.Array, "n"], Float[jax.Array, "n"]]:
    """Return the robot's ascent directions with the block-diagonal and with the full response of all humans.

    With F the stacked slopes of the humans' rewards in their own controls, the full response is
    ``-(dF/du_H)^-1 dF/du_R``; the block-diagonal one keeps the blocks on the diagonal of ``dF/du_H`` only. Both have
    the same damping, see `ms_highway.optimization.damped_newton.damped_factor`.

    Args:
        crowd: the game.
        state: all cars.
        aside: by how much scaled controls differ from those that keep the velocity, the robot's first.
    """
    game, humans = crowd.game, crowd.humans
    players = state[: 1 + humans]
    kept = jax.vmap(partial(constant_velocity, game))(players) + aside
    rest, others = coasting(game, state)[1 + humans :], jnp.asarray(others_of(len(state)))

    def paths(controls: Float[jax.Array, "players steps 2"]) -> Float[jax.Array, "cars fields steps"]:
        return jnp.concatenate([jax.vmap(partial(move, game))(players, controls), rest])

    def earned(human: Any, own: Any, controls: Float[jax.Array, "players steps 2"]) -> Float[jax.Array, ""]:
        rewarded, everybody = human_game(crowd, human), paths(controls)
        car = players[1 + human]
        sum_ = along_others(rewarded.scene, rewarded.robot, move(rewarded, car, own), everybody[others[1 + human]])
        return sum_ - discomfort(rewarded, car, own)

    def slopes(controls: Float[jax.Array, "players steps 2"]) -> Float[jax.Array, "humans n"]:
        one = jax.vmap(lambda human: jax.grad(partial(earned, human))(controls[1 + human], controls).ravel())
        return one(jnp.arange(humans))

    def robots(controls: Float[jax.Array, "players steps 2"]) -> Float[jax.Array, ""]:
        everybody = paths(controls)
        return along_others(game.scene, game.robot, everybody[0], everybody[1:]) - discomfort(
            game, players[0], controls[0]
        )

    gradient = jax.grad(robots)(kept).reshape(1 + humans, -1)
    size = gradient.shape[1]
    bends = jax.jacfwd(slopes)(kept).reshape(humans, size, 1 + humans, size)
    numbers = jnp.arange(humans)
    factors = jax.vmap(damped_factor)(bends[numbers, :, 1 + numbers])
    damped = factors @ jnp.swapaxes(factors, 1, 2)
    across = -bends[:, :, 1:].at[numbers, :, numbers].set(0.0)
    blocks = jnp.zeros_like(across).at[numbers, :, numbers].set(damped)
    pushed = gradient[1:].ravel()

    def direction(matrix: Float[jax.Array, "humans n humans n"]) -> Float[jax.Array, "n"]:
        answered = jnp.linalg.solve(matrix.reshape(humans * size, -1).T, pushed)
        return gradient[0] + bends[:, :, 0].reshape(humans * size, size).T @ answered

    return direction(blocks), direction(blocks + across)
