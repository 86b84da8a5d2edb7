"""Keep what is known of the drivers in sight from step to step: what each is like, and which model it follows."""

from dataclasses import replace
from typing import Any

import jax
import numpy as np
from jaxtyping import Float

from ms_highway.game.arrays import Belief
from ms_highway.game.road import RoadScene
from ms_highway.metareasoning.belief import first_belief
from ms_highway.metareasoning.road_belief import updated_road_belief
from ms_highway.optimization.kalman import Gaussian
from ms_highway.planning.road.traits import prior, traits_of, updated_traits
from ms_highway.runtime.compilation import jit_quickly

Known = tuple[Gaussian, Belief]
Path = Float[Any, "steps 3"]


def _updated(known: Known, before: RoadScene, path: Path, now: RoadScene, time_step: float) -> Known:
    traits = updated_traits(known[0], before, now, time_step)
    return traits, updated_road_belief(known[1], before, path, now, time_step)


_prior, _update = jit_quickly(prior), jit_quickly(_updated)


class DriversSeen:
    """Estimates and belief about the drivers in sight, updated in every step of a robot.

    Args:
        traits: whether what drivers are like is estimated.
        belief: whether the model that each follows is inferred.
        time_step: between two steps [s].
    """

    def __init__(self, traits: bool, belief: bool, time_step: float) -> None:
        self.traits, self.belief, self.time_step = traits, belief, time_step
        self._before: tuple[RoadScene, Path] | None = None
        self._known: Known | None = None

    def prepare(self, scene: RoadScene, steps: int) -> None:
        """Compile, with a look at the road and the number of steps of plans."""
        seen = DriversSeen(self.traits, self.belief, self.time_step)
        seen.planned(seen.look(scene)[0], np.zeros((steps, 3), np.float32))
        seen.look(scene)

    def look(self, scene: RoadScene) -> tuple[RoadScene, Belief | None]:
        """Learn from a look at the road.

        Returns:
            The road, with the traits of the drivers if they are estimated; and the probability of each model for the
            car on each path, None if it is not inferred.
        """
        if not self.traits and not self.belief:
            return scene, None
        if self._before is None:
            self._known = _prior(scene), first_belief(len(scene.names))
        else:
            self._known = _update(self._known, *self._before, scene, self.time_step)
        estimates, belief = jax.tree.map(np.asarray, self._known)
        if self.traits:
            scene = replace(scene, traits=jax.tree.map(np.asarray, traits_of(estimates.mean)))
        return scene, belief if self.belief else None

    def planned(self, scene: RoadScene, path: Path) -> None:
        """Remember the robot's plan on the road that it looked at last; an empty one ends all learning until now."""
        self._before = (scene, path) if len(path) else None
