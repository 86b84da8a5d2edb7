"""Draw the road from above with plans and predictions, and a panel that shows what the
robot thinks.
"""

from collections.abc import Sequence
from functools import partial
from itertools import accumulate
from typing import Any

import jax
import numpy as np
import pygame
from highway_env.road.graphics import LaneGraphics, RoadGraphics
from highway_env.vehicle.objects import Obstacle

from ms_highway.envs.spaces import HumanModelAction
from ms_highway.envs.viewer import (
    ASPHALT,
    CONE,
    FAINT,
    GRID,
    GROUND,
    INK,
    PAPER,
    Color,
    Viewer,
    model_color,
    model_meaning,
    words,
)
from ms_highway.game.dynamics import step as move
from ms_highway.game.scenario import title
from ms_highway.loop.controller import ControlStep
from ms_highway.planning.ladders import PACKAGE_MODELS, cheapest_first
from ms_highway.runtime.arrays import Belief, Car, Controls

MARGIN = 16  # px
TEXT_WIDTH, CHART = 440, 42  # px, width of the panel's left part, height of a chart
LARGE, MEDIUM, SMALL = 24, 15, 13  # px, sizes of texts
NAMED = 60  # px, width from which a part of a bar shows its name
WORST = -10.0  # lowest reward of the chart, as a collision would dwarf everything else


class InteractionViewer(Viewer):
    """Draws an `ms_highway.envs.base.InteractionEnv` on a surface of ``screen_width`` x
    ``screen_height``.

    Predicted paths have the colours of their models; among several humans, the humans
    have them, too.
    """

    panel_height = 150  # px
    # s, longest planning time of all films that share the scale of planning times
    longest = 0.0

    def display(self) -> None:
        """Draw everything; the view follows the robot along the road, but not to the
        side.
        """
        surface = self.sim_surface
        env = self.env
        step = self.env.robot.last_step
        lanes = np.asarray(env.game.scene.lanes, float)
        half = float(env.game.scene.lane_width) / 2
        ends = lanes.min() - half, lanes.max() + half
        surface.move_display_window_to(np.array([env.robot.position[0], np.mean(ends)]))
        above, below = (surface.pos2pix(0, end)[1] for end in ends)
        surface.fill(GROUND)
        surface.fill(ASPHALT, (0, above, surface.get_width(), below - above))
        for lane in env.road.network.lanes_list():
            LaneGraphics.display(lane, surface)
        for cone in env.road.objects:
            self._draw_cone(cone)
        alone = len(env.humans) == 1
        for place, human in enumerate(() if alone else env.humans):
            human.color = model_color(
                step.models[place] if step else env.settings.models[0].name
            )
        RoadGraphics.display_traffic(env.road, surface, offscreen=self.offscreen)
        if step:
            self._draw_plan(step)
        names = ["human"] if alone else map(str, range(1, 1 + len(env.humans)))
        for name, car in zip(("robot", *names), (env.robot, *env.humans), strict=True):
            self._write(
                name, SMALL, PAPER, ASPHALT, center=surface.vec2pix(car.position)
            )
        self._draw_panel(step)
        self.show(surface)

    def _draw_cone(self, cone: Obstacle) -> None:
        """Draw a cone as it counts: a circle on physical ground, else a rectangle."""
        surface = self.sim_surface
        centre = surface.vec2pix(cone.position)
        if self.env.game.scene.bodies_collide:
            pygame.draw.circle(surface, CONE, centre, surface.pix(cone.WIDTH / 2))
        else:
            corners = [surface.vec2pix(corner) for corner in cone.polygon()]
            pygame.draw.polygon(surface, CONE, corners)
        pygame.draw.circle(surface, PAPER, centre, surface.pix(cone.WIDTH / 4))

    def _draw_plan(self, step: ControlStep) -> None:
        """Draw the predicted paths as dots in the colours of their models, and the
        robot's plan as a line.
        """
        surface, (own, *others) = self.sim_surface, self.env.robot.last_state
        dynamics = jax.tree.map(float, self.env.game.dynamics)

        def path(state: Car, controls: Controls) -> list[tuple[int, int]]:
            return [
                surface.vec2pix(each)
                for each in accumulate(controls, partial(move, dynamics), initial=state)
            ]

        every, radius = (1, 4) if len(step.models) == 1 else (2, 2)
        for state, controls, model in zip(
            others, step.humans, step.models, strict=False
        ):
            for point in path(state, controls)[every::every]:
                pygame.draw.circle(surface, PAPER, point, radius + 2)
                pygame.draw.circle(surface, model_color(model), point, radius)
        for color, width in ((PAPER, 8), (model_color(step.model), 4)):
            pygame.draw.lines(surface, color, False, path(own, step.plan), width)

    def _draw_panel(self, step: ControlStep | None) -> None:
        env, history, (width, height) = (
            self.env,
            self.env.history,
            self.sim_surface.get_size(),
        )
        top = height - self.panel_height
        self.sim_surface.fill(PAPER, (0, top, width, self.panel_height))
        if not history:
            self._write(
                f"{title(env.scenario.name)}: the episode starts",
                MEDIUM,
                topleft=(MARGIN, top + MARGIN),
            )
            return
        steps, rewards = zip(*history, strict=True)
        arrived = env.scenario.streams and env.success
        happened = (
            "COLLISION" if env.collision else "in the target lane" if arrived else ""
        )
        lines = [f"step {len(history)}    reward {rewards[-1]:+.2f}    {happened}"]
        chart = pygame.Rect(TEXT_WIDTH, top + 26, width - TEXT_WIDTH - MARGIN, CHART)
        self._draw_curve(chart.move(0, CHART + 28), rewards)
        if step:
            lines += self._thoughts(step)
            self._draw_models(step, MARGIN, top + 10)
            self._draw_bars(chart, steps)
            if step.belief is not None:
                self._draw_beliefs(step.belief, top + 122)
        else:
            self._write("the agent drives", LARGE, topleft=(MARGIN, top + 10))
        for place, line in enumerate(lines):
            self._write(line, MEDIUM, topleft=(MARGIN, top + 46 + 24 * place))

    def _draw_models(self, step: ControlStep, left: int, top: int) -> None:
        """Write the model of a single human and its meaning; for several humans, write
        how many each model predicts.
        """
        alone = len(step.models) == 1
        for name in (
            step.models if alone else dict.fromkeys((*step.ladder, *step.models))
        ):
            count = "" if alone else f"{step.models.count(name)} "
            left = (
                8
                + self._write(
                    f" {name} {count}",
                    LARGE,
                    PAPER,
                    model_color(name),
                    topleft=(left, top),
                ).right
            )
        if alone:
            self._write(model_meaning(step.model), SMALL, topleft=(left, top + 8))

    def _thoughts(self, step: ControlStep) -> tuple[str, str]:
        """Return two lines: times; the reason for a single human's model, the distance
        to cones, the plan's status.
        """
        controller = self.env.settings.controller
        cones = self.env.distance_to_cones
        remarks = []
        times = {
            "planning": step.planning_seconds,
            "deciding": step.decision_seconds,
            "budget": controller.budget,
        }
        if (
            len(step.models) == 1
            and controller.chooses
            and not isinstance(self.env.action_type, HumanModelAction)
        ):
            remarks.append(_reason(step))
        if self.env.scenario.streams and cones < np.inf:
            remarks.append(f"cones in {cones:.0f} m")
        if step.status != "planned":
            remarks.append(step.status)
        taken = [
            f"{name} {1e3 * seconds:.1f} ms"
            for name, seconds in times.items()
            if seconds
        ]
        return ", ".join(taken), "    ".join(remarks)

    def _draw_beliefs(self, belief: Belief, top: int) -> None:
        """Draw a bar for every human, behind its number: the probabilities of the
        models, side by side.
        """
        width = (TEXT_WIDTH - 5 * MARGIN) / len(belief)
        for place, shares in enumerate(belief):
            left = start = MARGIN + place * width
            if len(belief) > 1:
                start = (
                    self._write(str(place + 1), SMALL, topleft=(left, top)).right + 3
                )
            ends = start + (left + width - 4 - start) * np.cumsum([0.0, *shares])
            for name, low, high in zip(PACKAGE_MODELS, ends, ends[1:], strict=False):
                part = self.sim_surface.fill(
                    model_color(name), (low, top, high - low + 1, 17)
                )
                if part.width > NAMED:
                    self._write(name, SMALL, PAPER, center=part.center)

    def _draw_chart(
        self,
        box: pygame.Rect,
        heading: str,
        values: Sequence[float],
        low: float,
        high: float,
    ) -> list[pygame.Rect]:
        """Draw a chart's heading, its lowest line and the ends of its scale; return the
        bar of every step's value.
        """
        self._write(heading, SMALL, FAINT, topleft=(box.left, box.top - 20))
        for end, y in ((high, box.top), (low, box.bottom)):
            self._write(f"{end:.3g}", SMALL, FAINT, midright=(box.left - 8, y))
        pygame.draw.line(self.sim_surface, FAINT, box.bottomleft, box.bottomright)
        width = box.width / max(self.env.episode_steps, len(values))
        tops = np.interp(values, [low, high], [box.bottom - 3, box.top])
        return [
            pygame.Rect(
                box.left + place * width, top, max(1, width - 2), box.bottom - top
            )
            for place, top in enumerate(tops)
        ]

    def _draw_bars(self, box: pygame.Rect, steps: Sequence[ControlStep]) -> None:
        """Draw a bar per step in the colours of the humans' models; with one human, its
        height is the planning time.
        """
        humans = len(steps[0].models)
        values = [float(humans)] * len(steps)
        heading = "humans that each model predicts"
        high = float(humans)
        if humans == 1:
            values = [1e3 * step.planning_seconds for step in steps]
            heading = "planning time of each step [ms], in the colour of its model"
            high = max(*values, 1e3 * self.longest)
        for step, bar in zip(
            steps, self._draw_chart(box, heading, values, 0.0, high), strict=True
        ):
            for place, model in enumerate(
                sorted(step.models, key=cheapest_first(step.models).index)
            ):
                top = bar.top + bar.height * place / humans
                self.sim_surface.fill(
                    model_color(model), (bar.left, top, bar.width, bar.bottom - top)
                )

    def _draw_curve(self, box: pygame.Rect, rewards: Sequence[float]) -> None:
        """Draw the reward of each step, cut off at `WORST`, and a line at 0 if it is
        within the chart.
        """
        low = max(min(rewards), WORST)
        high = max(*rewards, low + 1.0)
        heading = f"reward of each step, {np.mean(rewards):+.2f} on average"
        points = [
            bar.midtop for bar in self._draw_chart(box, heading, rewards, low, high)
        ]
        if low < 0 < high:
            zero = np.interp(0.0, [low, high], [box.bottom, box.top])
            pygame.draw.line(
                self.sim_surface, GRID, (box.left, zero), (box.right, zero)
            )
        pygame.draw.lines(self.sim_surface, INK, False, [points[0], *points], 2)
        pygame.draw.circle(self.sim_surface, INK, points[-1], 3)

    def _write(
        self,
        text: str,
        size: int,
        color: Color = INK,
        ground: Color | None = None,
        **place: Any,
    ) -> pygame.Rect:
        """Write a text whose rectangle has a corner, side or centre at this place;
        return the rectangle.
        """
        label = words(text, size, color, ground)
        return self.sim_surface.blit(label, label.get_rect(**place))


def _reason(step: ControlStep) -> str:
    """Return the reason for this model: the estimated gains over the first one, before
    the price of planning.
    """
    if step.choice_failed:
        return f"choice failed: {step.model} to be safe"
    first = step.ladder[0]
    gains = [
        f"{name} {gain:+.3f}"
        for name, gain in step.highest_gains().items()
        if name != first
    ]
    return (
        f"gain over {first}: {', '.join(gains)}"
        if gains
        else "no other model considered"
    )
