"""A figure and a table of what plans count on and what comes of them."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from rich.box import SIMPLE
from rich.table import Table

from ms_highway.envs.graphics import CONE, model_meaning
from ms_highway.experiments.analysis.plan_outcomes import PlanOutcome
from ms_highway.game.scene import Scene
from ms_highway.visualization.colors import color_of, paint
from ms_highway.visualization.road import car_outline, draw_road

__all__ = ["plan_outcome_figure", "plan_outcome_table"]

HUMAN, OTHERS = "#111318", "#8a93a5"
BEFORE = 2.0  # m of road that are drawn behind the last and before the first car
WIDTH = 13.0  # inches


def plan_outcome_figure(foresights: Sequence[PlanOutcome], scene: Scene) -> Figure:
    """Draw plans, predictions and outcomes, a panel per model, on the road seen from above.

    The picture moves along at the speed that the human drives at now: a car that keeps this speed stands still in it,
    and one that brakes falls back. Cars are drawn where they are at the end of the plan, robot and human also, dotted,
    where they are now; y points to the right, so that the left is up.

    Args:
        foresights: of one situation, see `ms_highway.experiments.analysis.plan_outcomes.follow_plan`.
        scene: where.
    """
    lanes, width = np.unique(np.asarray(scene.lanes, dtype=float)), float(scene.lane_width)
    everyone = [_alongside(one, states) for one in foresights for states in (one.expected, one.actual)]
    reach = float(np.asarray(scene.car_size)[0]) / 2 + BEFORE
    near = np.concatenate([states[:, :2, 0].ravel() for states in everyone])
    stretch = float(near.min() - reach), float(near.max() + reach)
    across = np.ptp(lanes) + 2 * width
    height = WIDTH / len(foresights) * across / (stretch[1] - stretch[0])  # at one scale along and across
    figure = Figure(figsize=(WIDTH, height + 1.3), layout="constrained")
    panels = np.atleast_1d(figure.subplots(1, len(foresights), sharey=True))
    for axes, one in zip(panels, foresights, strict=True):
        draw_road(axes, lanes, width, stretch)
        _draw(axes, one, scene)
        axes.set_title(f"{one.model}: {model_meaning(one.model)}", loc="left", fontsize="medium")
    panels[0].set_ylabel("to the right [m]")
    speed = foresights[0].actual[0, 1, 3]
    middle = panels[len(panels) // 2]
    middle.set_xlabel(f"along the road [m]; the picture moves at the human's {speed:.1f} m/s")
    figure.legend(handles=_key(), loc="outside lower center", ncols=3, frameon=False)
    return figure


def plan_outcome_table(foresights: Sequence[PlanOutcome]) -> Table:
    """Tabulate what the plan under each model counts on, and what comes of it."""
    title = f"{foresights[0].seconds:g} s ahead"
    grid = Table(title=title, box=SIMPLE, title_justify="left", title_style="bold")
    grid.add_column("model", no_wrap=True)
    columns = (
        "robot to the left, m",
        "human expected to accelerate, m/s²",
        "does, m/s²",
        "human off by, m",
        "reward per step, expected",
        "earned",
    )
    for column in columns:
        grid.add_column(column, justify="right")
    for one in foresights:
        numbers = (
            one.actual[0, 0, 1] - one.actual[-1, 0, 1],
            one.expected_acceleration,
            one.actual_acceleration,
            one.error,
            one.expected_reward.mean(),
            one.actual_reward.mean(),
        )
        grid.add_row(one.model, *(f"{round(float(number), 2) + 0.0:.2f}" for number in numbers))
    return grid


def _alongside(one: PlanOutcome, states: Float[np.ndarray, "times cars 4"]) -> Float[np.ndarray, "times cars 4"]:
    """States in a frame that moves at the human's first speed, and starts where the human does."""
    x, _, _, speed = one.actual[0, 1]
    moved = x + speed * one.time_step * np.arange(len(states))
    return states - moved[:, None, None] * [1.0, 0.0, 0.0, 0.0]


def _draw(axes: Axes, one: PlanOutcome, scene: Scene) -> None:
    """Draw one model's panel."""
    color, size = color_of(one.model), np.asarray(scene.car_size, dtype=float)
    expected, actual = _alongside(one, one.expected), _alongside(one, one.actual)
    for place in np.asarray(scene.obstacles, dtype=float):
        still = np.tile([*place, 0.0, 0.0], (len(actual), 1, 1))
        cone = _alongside(one, still)[-1, 0]
        axes.add_patch(car_outline(cone, np.asarray(scene.obstacle_size), facecolor=paint(CONE), zorder=2))
    for car in actual[-1, 2:]:
        axes.add_patch(car_outline(car, size, facecolor="#d9dce2", edgecolor=OTHERS, zorder=2))
    for car in actual[0, :2]:
        axes.add_patch(car_outline(car, size, fill=False, edgecolor=OTHERS, linestyle=":", zorder=2))
    axes.add_patch(car_outline(actual[-1, 1], size, facecolor="#dbe8f8", edgecolor=HUMAN, linewidth=1.4, zorder=3))
    axes.add_patch(
        car_outline(expected[-1, 1], size, fill=False, edgecolor=color, linewidth=2, linestyle="--", zorder=4)
    )
    axes.add_patch(car_outline(actual[-1, 0], size, facecolor="#dcefe1", edgecolor=color, linewidth=2, zorder=3))
    axes.plot(*actual[:, 0, :2].T, "o-", color=color, linewidth=2, markersize=4, zorder=5)
    axes.plot(*actual[:, 1, :2].T, "D-", color=HUMAN, linewidth=1, markersize=3, zorder=5)
    axes.plot(*expected[:, 1, :2].T, "o", color=color, markersize=4.5, markeredgecolor="white", zorder=6)
    for name, (x, y, heading, _) in zip(("robot", "human"), actual[-1], strict=False):
        back = 0.45 * size[0]
        place = x - back * np.cos(heading), y - back * np.sin(heading)
        axes.text(*place, name, fontsize="small", color=HUMAN, va="center", rotation=-np.degrees(heading), zorder=7)


def _key() -> list[Any]:
    """Explain outlines, lines and dots."""
    plan = "in the model's colour"
    return [
        Line2D([], [], marker="o", color=OTHERS, linewidth=2, label=f"robot's plan, {plan}"),
        Line2D([], [], marker="o", color=OTHERS, linestyle="", label=f"human, as the plan expects, {plan}"),
        Line2D([], [], marker="D", markersize=4, color=HUMAN, linewidth=1, label="human, as it turns out"),
        Patch(fill=False, edgecolor=OTHERS, linestyle=":", label="robot and human now"),
        Patch(fill=False, edgecolor=OTHERS, linestyle="--", linewidth=2, label="human at the end, as expected"),
        Patch(facecolor="#dbe8f8", edgecolor=HUMAN, linewidth=1.4, label="human at the end, as it turns out"),
    ]
