"""Draw the road from above, and a panel that shows what the robot thinks.

On the road there are plans and predictions.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from itertools import accumulate, pairwise

import jax
import numpy as np
import pygame
from highway_env.road.graphics import LaneGraphics, RoadGraphics
from highway_env.vehicle.objects import Obstacle

from ms_highway.envs.colors import PALETTE, Color, model_color, model_meaning
from ms_highway.envs.spaces import HumanModelAction
from ms_highway.envs.viewer import Viewer, words
from ms_highway.game.dynamics import step as move
from ms_highway.game.scenario import title
from ms_highway.loop.controller import ControlStep
from ms_highway.planning.ladders import PACKAGE_MODELS, cheapest_first
from ms_highway.runtime.arrays import Car, Controls, ModelProbabilities


@dataclass(frozen=True)
class PanelLayout:
    """Set places and sizes in the panel below the road [px]."""

    margin: int = 16
    """Space around texts and charts."""
    text_width: int = 440
    """Width of the left part, which has texts; charts are beside it."""
    chart_height: int = 42
    """Height of a chart."""
    large: int = 24
    """Size of the names of models."""
    medium: int = 15
    """Size of lines of text."""
    small: int = 13
    """Size of labels."""


PANEL_LAYOUT = PanelLayout()


class InteractionViewer(Viewer):
    """Draws an `ms_highway.envs.base.InteractionEnv`.

    The surface is ``screen_width`` x ``screen_height``. Predicted paths have the
    colours of their models; among several humans, the humans have them, too.

    Attributes:
        panel_height: of the panel below the road [px].
        longest: planning time of all films that share the scale of planning times [s].
    """

    panel_height = 150
    longest = 0.0

    def display(self) -> None:
        """Draw everything.

        The view follows the robot along the road, but not to the side.
        """
        env = self.env
        step = env.robot.last_step
        self._draw_road()
        self._draw_traffic(step)
        if step:
            self._draw_plan(step)
        self._write_names()
        self._draw_panel(step)
        self.show(self.sim_surface)

    # The road from above

    def _draw_road(self) -> None:
        """Draw the lanes and the cones around the robot."""
        surface = self.sim_surface
        env = self.env
        lanes = np.asarray(env.game.scene.lanes, float)
        half_lane = float(env.game.scene.lane_width) / 2
        left = lanes.min() - half_lane
        right = lanes.max() + half_lane
        middle = np.mean([left, right])
        robot_x = env.robot.position[0]
        surface.move_display_window_to(np.array([robot_x, middle]))

        _, above = surface.pos2pix(0, left)
        _, below = surface.pos2pix(0, right)
        road = (0, above, surface.get_width(), below - above)
        surface.fill(PALETTE.ground)
        surface.fill(PALETTE.asphalt, road)
        for lane in env.road.network.lanes_list():
            LaneGraphics.display(lane, surface)
        for cone in env.road.objects:
            self._draw_cone(cone)

    def _draw_cone(self, cone: Obstacle) -> None:
        """Draw a cone as it counts: a circle on physical ground, else a rectangle."""
        surface = self.sim_surface
        centre = surface.vec2pix(cone.position)
        if self.env.game.scene.bodies_collide:
            radius = surface.pix(cone.WIDTH / 2)
            pygame.draw.circle(surface, PALETTE.cone, centre, radius)
        else:
            corners = [surface.vec2pix(corner) for corner in cone.polygon()]
            pygame.draw.polygon(surface, PALETTE.cone, corners)
        pygame.draw.circle(surface, PALETTE.paper, centre, surface.pix(cone.WIDTH / 4))

    def _draw_traffic(self, step: ControlStep | None) -> None:
        """Draw all cars; several humans have the colours of their models."""
        env = self.env
        if len(env.humans) > 1:
            first = env.settings.models[0].name
            models = step.models if step else [first] * len(env.humans)
            for human, model in zip(env.humans, models, strict=True):
                human.color = model_color(model)
        RoadGraphics.display_traffic(
            env.road, self.sim_surface, offscreen=self.offscreen
        )

    def _draw_plan(self, step: ControlStep) -> None:
        """Draw the predicted paths as dots, and the robot's plan as a line.

        They have the colours of their models.
        """
        surface = self.sim_surface
        robot, *others = self.env.robot.last_state
        dynamics = jax.tree.map(float, self.env.game.dynamics)

        def path(state: Car, controls: Controls) -> list[tuple[int, int]]:
            """Return the pixels that a car passes."""
            states = accumulate(controls, partial(move, dynamics), initial=state)
            return [surface.vec2pix(each) for each in states]

        # Among several humans, every second dot, and smaller ones.
        every = 1
        radius = 4
        if len(step.models) > 1:
            every = 2
            radius = 2
        predicted = zip(others, step.humans, step.models, strict=False)
        for state, controls, model in predicted:
            color = model_color(model)
            for point in path(state, controls)[every::every]:
                pygame.draw.circle(surface, PALETTE.paper, point, radius + 2)
                pygame.draw.circle(surface, color, point, radius)

        plan = path(robot, step.plan)
        pygame.draw.lines(surface, PALETTE.paper, False, plan, 8)
        pygame.draw.lines(surface, model_color(step.model), False, plan, 4)

    def _write_names(self) -> None:
        """Write a name on the robot and on every human."""
        env = self.env
        names = ["robot", "human"]
        if len(env.humans) > 1:
            numbers = range(1, 1 + len(env.humans))
            names = ["robot", *map(str, numbers)]
        cars = [env.robot, *env.humans]
        for name, car in zip(names, cars, strict=True):
            centre = self.sim_surface.vec2pix(car.position)
            size = PANEL_LAYOUT.small
            self._write(name, size, PALETTE.paper, PALETTE.asphalt, center=centre)

    # The panel

    def _draw_panel(self, step: ControlStep | None) -> None:
        """Draw the panel below the road."""
        env = self.env
        layout = PANEL_LAYOUT
        width, height = self.sim_surface.get_size()
        top = height - self.panel_height
        self.sim_surface.fill(PALETTE.paper, (0, top, width, self.panel_height))
        if not env.history:
            text = f"{title(env.scenario.name)}: the episode starts"
            corner = (layout.margin, top + layout.margin)
            self._write(text, layout.medium, topleft=corner)
            return

        # The charts on the right.
        steps, rewards = zip(*env.history, strict=True)
        chart_width = width - layout.text_width - layout.margin
        chart = pygame.Rect(
            layout.text_width, top + 26, chart_width, layout.chart_height
        )
        self._draw_curve(chart.move(0, layout.chart_height + 28), rewards)
        if step:
            self._draw_bars(chart, steps)

        # Texts on the left.
        if step:
            self._draw_models(step, layout.margin, top + 10)
        else:
            corner = (layout.margin, top + 10)
            self._write("the agent drives", layout.large, topleft=corner)
        if step and step.belief is not None:
            self._draw_beliefs(step.belief, top + 122)
        lines = [self._outcome(rewards[-1])]
        if step:
            lines += [self._times(step), self._remarks(step)]
        for place, line in enumerate(lines):
            corner = (layout.margin, top + 46 + 24 * place)
            self._write(line, layout.medium, topleft=corner)

    def _outcome(self, reward: float) -> str:
        """Return a line about what has happened so far, with the last reward."""
        env = self.env
        happened = ""
        if env.collision:
            happened = "COLLISION"
        elif env.scenario.streams and env.success:
            happened = "in the target lane"
        return f"step {len(env.history)}    reward {reward:+.2f}    {happened}"

    def _times(self, step: ControlStep) -> str:
        """Return a line about the times that the robot took, with its budget."""
        times = {
            "planning": step.planning_seconds,
            "deciding": step.decision_seconds,
            "budget": self.env.settings.controller.budget,
        }
        parts = []
        for name, seconds in times.items():
            if seconds:
                parts.append(f"{name} {1e3 * seconds:.1f} ms")
        return ", ".join(parts)

    def _remarks(self, step: ControlStep) -> str:
        """Return a line of remarks.

        These are the reason for a single human's model, the distance to cones, and the
        plan's status.
        """
        env = self.env
        remarks = []
        agent_chooses = isinstance(env.action_type, HumanModelAction)
        rule_chooses = env.settings.controller.chooses and not agent_chooses
        if rule_chooses and len(step.models) == 1:
            remarks.append(_reason(step))
        if env.scenario.streams and env.distance_to_cones < np.inf:
            remarks.append(f"cones in {env.distance_to_cones:.0f} m")
        if step.status != "planned":
            remarks.append(step.status)
        return "    ".join(remarks)

    def _draw_models(self, step: ControlStep, left: int, top: int) -> None:
        """Write which model predicts the human, with its meaning.

        For several humans, write how many each model predicts.
        """
        layout = PANEL_LAYOUT
        if len(step.models) == 1:
            texts = {step.model: f" {step.model} "}
        else:
            names = dict.fromkeys((*step.ladder, *step.models))
            texts = {name: f" {name} {step.models.count(name)} " for name in names}
        for name, text in texts.items():
            color = model_color(name)
            corner = (left, top)
            box = self._write(text, layout.large, PALETTE.paper, color, topleft=corner)
            left = box.right + 8
        if len(step.models) == 1:
            meaning = model_meaning(step.model)
            self._write(meaning, layout.small, topleft=(left, top + 8))

    def _draw_beliefs(self, belief: ModelProbabilities, top: int) -> None:
        """Draw a bar for every human: the probabilities of the models.

        They stand side by side, behind the number of the human.
        """
        layout = PANEL_LAYOUT
        width = (layout.text_width - 5 * layout.margin) / len(belief)
        for index, probabilities in enumerate(belief):
            left = layout.margin + index * width
            right = left + width - 4
            if len(belief) > 1:
                number = str(index + 1)
                box = self._write(number, layout.small, topleft=(left, top))
                left = box.right + 3
            self._draw_belief(probabilities, left, right, top)

    def _draw_belief(
        self,
        probabilities: np.ndarray,
        left: float,
        right: float,
        top: int,
    ) -> None:
        """Draw a bar with a part for each model, as wide as its probability."""
        small = PANEL_LAYOUT.small
        named_width = 60  # px, from which a part of a bar shows its name
        ends = left + (right - left) * np.cumsum([0.0, *probabilities])
        parts = zip(PACKAGE_MODELS, pairwise(ends), strict=False)
        for name, (start, end) in parts:
            area = (start, top, end - start + 1, 17)
            part = self.sim_surface.fill(model_color(name), area)
            if part.width > named_width:
                self._write(name, small, PALETTE.paper, center=part.center)

    def _draw_chart(
        self,
        box: pygame.Rect,
        heading: str,
        values: Sequence[float],
        low: float,
        high: float,
    ) -> list[pygame.Rect]:
        """Draw a chart's heading, its lowest line and the ends of its scale.

        Returns:
            The bar of every step's value.
        """
        faint = PALETTE.faint
        small = PANEL_LAYOUT.small
        self._write(heading, small, faint, topleft=(box.left, box.top - 20))
        for end, y in ((high, box.top), (low, box.bottom)):
            self._write(f"{end:.3g}", small, faint, midright=(box.left - 8, y))
        pygame.draw.line(self.sim_surface, faint, box.bottomleft, box.bottomright)

        width = box.width / max(self.env.episode_steps, len(values))
        tops = np.interp(values, [low, high], [box.bottom - 3, box.top])
        bars = []
        for step, top in enumerate(tops):
            left = box.left + step * width
            bars.append(pygame.Rect(left, top, max(1, width - 2), box.bottom - top))
        return bars

    def _draw_bars(self, box: pygame.Rect, steps: Sequence[ControlStep]) -> None:
        """Draw a bar per step in the colours of the humans' models.

        With one human, its height is the planning time.
        """
        humans = len(steps[0].models)
        values = [float(humans)] * len(steps)
        heading = "humans that each model predicts"
        high = float(humans)
        if humans == 1:
            values = [1e3 * step.planning_seconds for step in steps]
            heading = "planning time of each step [ms], in the colour of its model"
            high = max(*values, 1e3 * self.longest)
        bars = self._draw_chart(box, heading, values, 0.0, high)
        for step, bar in zip(steps, bars, strict=True):
            by_cost = cheapest_first(step.models)
            models = sorted(step.models, key=by_cost.index)
            for index, model in enumerate(models):
                top = bar.top + bar.height * index / humans
                area = (bar.left, top, bar.width, bar.bottom - top)
                self.sim_surface.fill(model_color(model), area)

    def _draw_curve(self, box: pygame.Rect, rewards: Sequence[float]) -> None:
        """Draw the reward of each step, and a line at 0 if it is within the chart."""
        # Lower rewards are cut off: a collision would dwarf everything else.
        low = max(min(rewards), -10.0)
        high = max(*rewards, low + 1.0)
        heading = f"reward of each step, {np.mean(rewards):+.2f} on average"
        bars = self._draw_chart(box, heading, rewards, low, high)
        points = [bar.midtop for bar in bars]
        surface = self.sim_surface
        if low < 0 < high:
            zero = np.interp(0.0, [low, high], [box.bottom, box.top])
            left = (box.left, zero)
            right = (box.right, zero)
            pygame.draw.line(surface, PALETTE.grid, left, right)
        pygame.draw.lines(surface, PALETTE.ink, False, [points[0], *points], 2)
        pygame.draw.circle(surface, PALETTE.ink, points[-1], 3)

    def _write(
        self,
        text: str,
        size: int,
        color: Color = PALETTE.ink,
        ground: Color | None = None,
        **place: tuple[float, float],
    ) -> pygame.Rect:
        """Write a text, and return its rectangle.

        The rectangle has a corner, side or centre at this place.
        """
        label = words(text, size, color, ground)
        return self.sim_surface.blit(label, label.get_rect(**place))


def _reason(step: ControlStep) -> str:
    """Return the reason for this model: the estimated gains over the first one.

    These are gains before the price of planning.
    """
    if step.choice_failed:
        return f"choice failed: {step.model} to be safe"
    first = step.ladder[0]
    gains = []
    for name, gain in step.highest_gains().items():
        if name != first:
            gains.append(f"{name} {gain:+.3f}")
    if not gains:
        return "no other model considered"
    return f"gain over {first}: {', '.join(gains)}"
