"""What a user's module may look like: a feature, and a scenario whose robot is paid for it."""

from dataclasses import replace

from jax import numpy as jnp

from ms_highway.envs import MergerEnv, add_scenario
from ms_highway.game.reward import add_feature


def room(scene, own, others):
    """Squared distance to the nearest car or cone in length units, softly: nearer ones count more."""
    x, y = (
        jnp.concatenate([ours, theirs])
        for ours, theirs in ((others.x, scene.obstacles[:, 0]), (others.y, scene.obstacles[:, 1]))
    )
    squares = ((own.x - x) ** 2 + (own.y - y) ** 2) / scene.length_unit**2
    return -jnp.log(jnp.sum(jnp.exp(-squares)))


class RoomyEnv(MergerEnv):
    """Merger with a cone beside the road, and a robot that likes to have room."""

    scenario = replace(
        MergerEnv.scenario,
        name="roomy",
        cones=((0.4, 0.08),),
        robot_weights={**MergerEnv.scenario.robot_weights, "room": 30.0},
    )


add_feature("room", room)
add_scenario(RoomyEnv)
