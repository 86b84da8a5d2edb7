"""Show on a stock environment's picture what the robot thinks: plan, predictions, rungs, belief; and a line of text."""

from collections import Counter
from operator import itemgetter
from typing import Any

import numpy as np
import pygame
from highway_env.vehicle.kinematics import Vehicle
from jaxtyping import Float

from ms_highway.control.road import RoadStep
from ms_highway.envs.graphics import INK, PAPER, Color, Viewer, model_color, words
from ms_highway.planning.road.settings import RUNGS

__all__ = ["RoadViewer", "show"]

PANEL, SIZE, GAP = 24, 13, 10  # px: height of the line of text, of its letters, and between its parts
BAR, BARS = 4, 14  # px: width and height of a bar of probability 1
NEAR = 8.0  # m, within which a prediction begins from the car that it is of


def show(env: Any) -> None:
    """Let an environment that is rendered be drawn by a `RoadViewer`, from the next picture on."""
    base = env.unwrapped
    if base.render_mode is not None and not isinstance(base.viewer, RoadViewer):
        if base.viewer is not None:
            base.viewer.close()
        base.viewer = RoadViewer(base)


class RoadViewer(Viewer):
    """Draws a stock environment as highway-env does, with the robot's thoughts on it and a line of text below."""

    offscreen: bool

    def __init__(self, env: Any) -> None:
        super().__init__(env)
        width, height = self.sim_surface.get_size()
        self.picture = pygame.Surface((width, height + PANEL))
        if not self.offscreen:
            self.screen = pygame.display.set_mode((width, height + PANEL))

    def display(self) -> None:
        """Draw everything."""
        offscreen, self.offscreen = self.offscreen, True  # or else the window would show a picture without the rest
        super().display()
        self.offscreen = offscreen
        step = getattr(self.env.vehicle, "last_step", None)
        if step is not None and not self.env.vehicle.crashed:
            self._think(step)
        self.picture.blit(self.sim_surface, (0, 0))
        self._tell(step)
        if not self.offscreen:
            self.screen.blit(self.picture, (0, 0))
            if self.env.config["real_time_rendering"]:
                self.clock.tick(self.env.config["simulation_frequency"])
            pygame.display.flip()

    def get_image(self) -> np.ndarray:
        """Return the picture, [height, width, 3]."""
        return np.moveaxis(pygame.surfarray.array3d(self.picture), 0, 1)

    def _think(self, step: RoadStep) -> None:
        """Draw the plan as a line, predictions as dots and the cars that they are of, in the colours of the rungs."""
        others = [car for car in self.env.road.vehicles if car is not self.env.vehicle and not car.crashed]
        thoughts = zip(step.rungs, np.asarray(step.predictions, dtype=float), strict=True)
        dearest_last = sorted(filter(itemgetter(0), thoughts), key=lambda thought: RUNGS.index(thought[0]))
        for rung, path in dearest_last:  # so that a car with several paths has the colour of the dearest
            color = model_color(rung)
            car = _car_of(path, others)
            if car is not None:
                pygame.draw.polygon(self.sim_surface, color, [self._place(corner) for corner in car.polygon()])
            for point in path[1::2]:
                pygame.draw.circle(self.sim_surface, PAPER, self._place(point), 3)
                pygame.draw.circle(self.sim_surface, color, self._place(point), 2)
        line = [self.env.vehicle.position, *np.asarray(step.path, dtype=float)[:, :2]]
        for color, width in ((PAPER, 4), (INK, 2)) if len(line) > 1 else ():
            pygame.draw.lines(self.sim_surface, color, False, [self._place(point) for point in line], width)

        if step.belief is not None:
            self._believe(step, step.belief, others)

    def _believe(self, step: RoadStep, belief: Float[np.ndarray, "traffic models"], others: list[Vehicle]) -> None:
        """Draw the probability of each model as a bar on the car that it is of, in the colours of the rungs."""
        for path, rung, probabilities in zip(step.predictions, step.rungs, belief.tolist(), strict=True):
            car = _car_of(np.asarray(path, dtype=float), others) if rung else None
            if car is None:
                continue
            x, y = self._place(car.position)
            left, width = x - len(RUNGS) * BAR // 2, len(RUNGS) * BAR
            pygame.draw.rect(self.sim_surface, PAPER, (left - 1, y - BARS - 1, width + 2, BARS + 2))
            for number, probability in enumerate(probabilities):
                height = round(BARS * probability)
                bar = (left + BAR * number, y - height, BAR, height)
                pygame.draw.rect(self.sim_surface, model_color(RUNGS[number]), bar)

    def _place(self, point: Float[np.ndarray, "2"]) -> tuple[int, int]:
        x, y = self.sim_surface.vec2pix(point)
        return int(x), int(y)

    def _tell(self, step: RoadStep | None) -> None:
        """Write how many cars each rung predicts, where the control comes from, and how long the plan took."""
        width, height = self.picture.get_size()
        pygame.draw.rect(self.picture, PAPER, (0, height - PANEL, width, PANEL))
        place = GAP
        if step is None:
            self._write("the episode starts", INK, place)
            return
        cars = dict.fromkeys(zip(step.rungs, np.asarray(step.owners).tolist(), strict=True))  # each of them once
        counts = Counter(rung for rung, _ in cars if rung)
        for rung, count in counts.items():
            pygame.draw.circle(self.picture, model_color(rung), (place + 4, height - PANEL // 2), 5)
            place = self._write(f"{rung} {count}", INK, place + 14)
        seconds = step.planning_seconds + step.decision_seconds
        self._write(f"{step.source}, {1e3 * seconds:.1f} ms, {self.env.vehicle.speed:.1f} m/s", INK, place)

    def _write(self, text: str, color: Color, place: int) -> int:
        """Write on the panel from a place on, and return the place after it."""
        label = words(text, SIZE, color)
        self.picture.blit(label, label.get_rect(midleft=(place, self.picture.get_height() - PANEL // 2)))
        return place + label.get_width() + GAP


def _car_of(path: Float[np.ndarray, "steps 2"], cars: list[Vehicle]) -> Vehicle | None:
    """Return the car whose prediction a path is, None where there is none near its begin."""
    distances = [float(np.linalg.norm(car.position - path[0])) for car in cars]
    return cars[int(np.argmin(distances))] if min(distances, default=NEAR) < NEAR else None
