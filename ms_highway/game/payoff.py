"""Sum a car's reward over its trajectory among those of others, and differentiate the sum."""

from dataclasses import dataclass, field
from typing import NamedTuple

import jax
from jax import numpy as jnp
from jaxtyping import Float

from ms_highway.game.curvature import Bends, curvature
from ms_highway.game.dynamics import Motion
from ms_highway.game.features import motion_reward
from ms_highway.game.reward import Reward
from ms_highway.game.scene import Scene
from ms_highway.game.stopping import stopping_cost
from ms_highway.numerics.second_derivatives import along_fields
from ms_highway.runtime.arrays import Scalar, Trajectories, Trajectory


class SecondOrder(NamedTuple):
    """Derivatives of a payoff at every step of a trajectory.

    Attributes:
        slope: in the car's own fields.
        own: twice in its own fields.
        partner: in its own fields, then in those of its partner.
    """

    slope: Trajectory
    own: Bends
    partner: Bends


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Payoff:
    """What trajectories earn. It holds only what this needs, so that all plans share one trace of each method.

    Attributes:
        scene: road, obstacles and bodies.
        reward: of the car.
        braking: deceleration with which the car keeps room to stop before obstacles, see
            `ms_highway.game.stopping.stopping_cost`, at the price of a collision; None without this cost.
        smooth: whether jumps of the reward are smooth (static).
    """

    scene: Scene
    reward: Reward
    braking: Scalar | None
    smooth: bool = field(metadata={"static": True})

    @jax.jit
    def steps(self, own: Trajectory, others: Trajectories) -> Float[jax.Array, "steps"]:
        """Compute the reward after each step of a trajectory, among the trajectories of all others."""
        motion = Motion(*own)
        rewards = motion_reward(self.scene, self.reward, motion, Motion(*jnp.moveaxis(others, 1, 0)), self.smooth)
        if self.braking is None:
            return rewards
        return rewards - self.reward.price("collision") * stopping_cost(self.scene, self.braking, motion)

    @jax.jit
    def total(self, own: Trajectory, others: Trajectories) -> Scalar:
        """Sum the rewards of all steps."""
        return jnp.sum(self.steps(own, others))

    @jax.jit
    def slopes(self, own: Trajectory, others: Trajectories) -> tuple[Trajectory, Trajectories]:
        """Differentiate the sum in the car's trajectory, and in those of all others."""
        return jax.grad(lambda *paths: self.total(*paths), argnums=(0, 1))(own, others)

    @jax.jit
    def second_order(self, own: Trajectory, others: Trajectories) -> SecondOrder:
        """Differentiate the sum twice, in as many directions as a motion has fields."""

        def slopes(own: Trajectory) -> tuple[Trajectory, Trajectory]:
            slope, around = self.slopes(own, others)
            return slope, around[0]

        (slope, _), bends = along_fields(slopes, own)
        return SecondOrder(slope, *bends)

    @jax.jit
    def curvature(self, own: Trajectory, others: Trajectories) -> Bends:
        """Return a convex form of the sum's second derivatives in the car's trajectory, see `curvature`."""
        return curvature(self.scene, self.reward, own, Motion(*jnp.moveaxis(others, 1, 0)), self.braking)
