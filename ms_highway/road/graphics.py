"""Show on a stock environment's picture what the robot thinks: plan, predictions, rungs; and a line of text."""

from collections import Counter
from operator import itemgetter
from typing import Any

import numpy as np
import pygame

from ms_highway.envs.viewer import INK, PAPER, Viewer, model_color, words
from ms_highway.road.constants import MODELS
from ms_highway.road.driver import RoadStep

PANEL, SIZE, GAP = 24, 13, 10  # px: height of the line of text, of its letters, and between its parts
MEANINGS = {"proposal": "proposal: planned now", "last plan": "last plan: planned earlier"}


def show(env: Any) -> None:
    """Let an environment that is rendered be drawn by a `RoadViewer`, from the next picture on."""
    base = env.unwrapped
    if base.render_mode is not None and not isinstance(base.viewer, RoadViewer):
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
        for area in getattr(self.env, "goal_areas", ()):
            pygame.draw.polygon(self.sim_surface, PAPER, [self.sim_surface.vec2pix(corner) for corner in area], 2)
        if step is not None and not self.env.vehicle.crashed:
            self._draw_thoughts(step)
        self.picture.blit(self.sim_surface, (0, 0))
        self._draw_panel(step)
        self.show(self.picture)

    def get_image(self) -> np.ndarray:
        """Return the picture, [height, width, 3]."""
        return np.moveaxis(pygame.surfarray.array3d(self.picture), 0, 1)

    def _draw_thoughts(self, step: RoadStep) -> None:
        """Draw predictions as dots and their cars in the colours of the rungs, the plan as a line."""
        ego, surface = self.env.vehicle, self.sim_surface
        known, predictions = list(ego.road_memory.numbers), np.asarray(step.humans, dtype=float)
        thoughts = [
            (MODELS.index(rung), known[owner], path)
            for rung, owner, path in zip(step.models, step.owners, predictions, strict=True)
            if rung
        ]
        for rung, car, path in sorted(thoughts, key=itemgetter(0)):  # a car's most expensive rung colours it
            color = model_color(MODELS[rung])
            if not car.crashed:
                pygame.draw.polygon(surface, color, [surface.vec2pix(corner) for corner in car.polygon()])
            for point in path[1::2]:
                pygame.draw.circle(surface, PAPER, surface.vec2pix(point), 3)
                pygame.draw.circle(surface, color, surface.vec2pix(point), 2)
        line = [surface.vec2pix(point) for point in (ego.position, *np.asarray(step.path, dtype=float)[:, :2])]
        for color, width in ((PAPER, 4), (INK, 2)) if len(line) > 1 else ():
            pygame.draw.lines(surface, color, False, line, width)

    def _draw_panel(self, step: RoadStep | None) -> None:
        """Write how many cars each rung predicts, where the control comes from, and how long the plan took."""
        width, height = self.picture.get_size()
        pygame.draw.rect(self.picture, PAPER, (0, height - PANEL, width, PANEL))
        text, place = f"{self.env.vehicle.speed:.1f} m/s", GAP
        if step is not None:
            cars = dict.fromkeys(zip(step.models, np.asarray(step.owners).tolist(), strict=True))  # each of them once
            for rung, count in Counter(rung for rung, _ in cars if rung).items():
                pygame.draw.circle(self.picture, model_color(rung), (place + 4, height - PANEL // 2), 5)
                place = self._write(f"{rung} {count}", place + 14)
            milliseconds = 1e3 * (step.planning_seconds + step.decision_seconds)
            text = f"{MEANINGS.get(step.source, step.source)}, {milliseconds:.1f} ms, {text}"
        self._write(text, place)

    def _write(self, text: str, place: int) -> int:
        """Write on the panel from a place on, and return the place after it."""
        label = words(text, SIZE, INK)
        self.picture.blit(label, label.get_rect(midleft=(place, self.picture.get_height() - PANEL // 2)))
        return place + label.get_width() + GAP
