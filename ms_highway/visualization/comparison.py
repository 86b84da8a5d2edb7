"""Tables and figures of a comparison, from its records of steps and their summary."""

from collections.abc import Sequence
from itertools import cycle
from textwrap import wrap
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter
from rich.box import SIMPLE
from rich.console import JustifyMethod
from rich.table import Table

from ms_highway.envs.controllers import CHOOSING
from ms_highway.envs.crowd.controllers import any_controller
from ms_highway.experiments.records import models_of, share_column
from ms_highway.game.scenario import title
from ms_highway.planning.human_models import is_model, known_models
from ms_highway.visualization.colors import choosing_shades, color_of

__all__ = ["bars", "cells", "episode_count", "table", "timeline"]

MEASURED = {"planning_ms": "plan ms", "decision_ms": "decide ms"}
LEGEND_COLUMNS = 5
HEADING_WIDTH = 11  # characters, after which headings of narrow columns are wrapped


def cells(summaries: pd.DataFrame, scenario: str) -> pd.DataFrame:
    """Return the summary of one scenario as text: a row per controller, and texts under the columns' headings.

    Planning has two columns: as decisions count it, at T(M), and as it was measured, if it was. Steps driven by
    fallback have a column if there are any, and success where there are several humans.
    """
    chosen = summaries[summaries["scenario"] == scenario]
    failed = "fallbacks" in chosen and bool(chosen["fallbacks"].any())
    succeeded = "success" in chosen and bool(chosen["success"].notna().any())
    models = models_of(summaries, share_column)
    rows = [
        {
            "controller": row["controller"],
            "reward/step": f"{row['reward']:.2f}",
            "90 % interval": f"{row['reward_low']:.2f}, {row['reward_high']:.2f}"
            if row["episodes"] > 1
            else "one episode",
            "counted ms": "" if np.isnan(row["counted_ms"]) else f"{row['counted_ms']:.0f}",
            **{heading: f"{row[name]:.2f}" for name, heading in MEASURED.items() if name in row},
            f"{' / '.join(models)} %": " / ".join(f"{100 * row[share_column(name)]:.0f}" for name in models),
            "collisions": f"{row['collision_episodes']} of {row['episodes']}",
            **(_among_several(row) if succeeded else {}),
            **({"fallback steps": f"{row['fallbacks']}"} if failed else {}),
        }
        for row in chosen.to_dict("records")
    ]
    return pd.DataFrame(rows)


def _among_several(row: dict[str, Any]) -> dict[str, str]:
    """Return texts under headings of what is summarised among several humans, as far as a summary has it."""
    texts = {"success": f"{100 * row['success']:.0f} %"}
    if "cycle_ms_p99" in row:
        texts |= {
            "humans under tom": f"{row['humans_tom']:.1f}",
            "cycle ms p50, p99": f"{row['cycle_ms_p50']:.1f}, {row['cycle_ms_p99']:.1f}",
            "late %": f"{100 * row['late']:.1f}",
        }
    return texts


def table(summaries: pd.DataFrame, scenario: str) -> Table:
    """Return the summary of one scenario, to be printed."""
    texts = cells(summaries, scenario)
    grid = Table(title=scenario, box=SIMPLE, title_justify="left", title_style="bold")
    for column in texts:
        justify: JustifyMethod = "left" if column == "controller" else "right"
        heading = wrap(column, max(HEADING_WIDTH, int(texts[column].str.len().max())))
        grid.add_column("\n".join(heading), justify=justify, no_wrap=True)
    for row in texts.itertuples(index=False):
        grid.add_row(*row)
    return grid


def episode_count(rows: pd.DataFrame) -> str:
    """Return the number of episodes that the rows of a summary stand for, as text for titles."""
    least, most = rows["episodes"].min(), rows["episodes"].max()
    return f"{most if least == most else f'{least} to {most}'} episodes per controller"


def bars(summaries: pd.DataFrame, scenario: str) -> Figure:
    """Draw reward and time per step of each controller, like Fig. 3 of the paper; whiskers are the 90 % intervals."""
    rows = summaries[summaries["scenario"] == scenario]
    names, colors = list(rows["controller"]), _colors(list(rows["controller"]))
    figure = Figure(figsize=(10, 4), layout="constrained")
    left, right = figure.subplots(1, 2)
    ends = rows[["reward_low", "reward_high"]].to_numpy()
    errors = np.nan_to_num(np.abs(ends - rows[["reward"]].to_numpy())).T.tolist()  # a list, of which one may be alone
    left.bar(names, rows["reward"], yerr=errors, color=colors, capsize=4)
    left.axhline(0, color="black", linewidth=0.8)
    left.set(title="reward", ylabel="mean reward per step")
    right.bar(names, rows["planning_ms"], color=colors)
    right.bar(
        names,
        rows["decision_ms"],
        bottom=rows["planning_ms"],
        color="white",
        edgecolor="black",
        hatch="///",
    )
    right.use_sticky_edges = False  # else the foot of a last bar without height ends the axes
    right.margins(y=0.3)  # room for the legend
    right.set_ylim(bottom=0)
    right.set(title="computation", ylabel="mean time per step [ms]")
    right.legend(
        handles=[Patch(color="grey", label="planning"), Patch(fc="white", ec="black", hatch="///", label="deciding")]
    )
    for axes in (left, right):
        axes.tick_params(axis="x", rotation=20)
        axes.spines[["top", "right"]].set_visible(False)
    figure.suptitle(f"{title(scenario)}: {episode_count(rows)}")
    return figure


def timeline(records: pd.DataFrame, scenario: str) -> Figure:
    """Draw time per step along the episode, and the model in use, like Fig. 2 of the paper.

    The upper axes show the mean over episodes of planning plus deciding; below, a row per episode of each
    controller that chooses online shows the model of every step.
    """
    rows = records[records["scenario"] == scenario]
    controllers = list(dict.fromkeys(rows["controller"]))
    choosing = [name for name in controllers if any_controller(name).type in CHOOSING]
    figure = Figure(figsize=(10, 4 + 1.6 * len(choosing)), layout="constrained")
    heights = [2.5] + [1] * len(choosing)
    axes = np.atleast_1d(figure.subplots(len(heights), 1, sharex=True, height_ratios=heights))
    for name, color in zip(controllers, _colors(controllers), strict=True):
        steps = rows[rows["controller"] == name]
        seconds = (steps["planning_seconds"] + steps["decision_seconds"]).groupby(steps["step"]).mean()
        style = "-" if name in choosing else "--"
        axes[0].plot(seconds.index, 1e3 * seconds, style, color=color, label=name, linewidth=2)
    axes[0].set(
        title=f"{title(scenario)}: computation along the episode", ylabel="planning + deciding [ms]", yscale="log"
    )
    axes[0].yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axes[0].yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axes[0].yaxis.set_minor_formatter(NullFormatter())
    axes[0].legend(
        ncols=min(len(controllers), LEGEND_COLUMNS), loc="upper center", bbox_to_anchor=(0.5, -0.02), frameon=False
    )
    for name, panel in zip(choosing, axes[1:], strict=True):
        _models_in_use(panel, rows[rows["controller"] == name], name)
    axes[-1].set_xlabel("step (0.1 s)")
    return figure


def _models_in_use(axes: Axes, steps: pd.DataFrame, name: str) -> None:
    models = known_models(steps["model"].unique())
    grid = steps.pivot(index="seed", columns="step", values="model").map(
        lambda model: models.index(model) if model in models else np.nan
    )
    colormap = ListedColormap([color_of(model) for model in models])
    axes.imshow(
        grid.to_numpy(dtype=float),
        aspect="auto",
        cmap=colormap,
        vmin=-0.5,
        vmax=len(models) - 0.5,
        interpolation="nearest",
    )
    axes.set_title(name, loc="left", fontsize="medium")
    axes.set_ylabel("episode")
    axes.legend(
        handles=[Patch(color=color_of(model), label=model) for model in models if model in set(steps["model"])],
        loc="center left",
        bbox_to_anchor=(1, 0.5),
        frameon=False,
    )


def _colors(controllers: Sequence[str]) -> list[str]:
    """Return a model's own colour for a fixed model, shades of its kind's for one that chooses online, else greys."""
    kinds = [kind if (kind := any_controller(name).type) in CHOOSING else "switching" for name in controllers]
    shades = {kind: cycle(choosing_shades(kind)) for kind in kinds}
    pairs = zip(controllers, kinds, strict=True)
    return [color_of(name) if is_model(name) else next(shades[kind]) for name, kind in pairs]
