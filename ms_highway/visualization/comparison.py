"""Tables and figures of a comparison, from its records of steps and their summary."""

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from ms_highway.envs.registry import controller_config, priced_types
from ms_highway.envs.viewer import model_color
from ms_highway.experiments.records import models_of
from ms_highway.game.scenario import title
from ms_highway.planning.human_models import PAPER_MODELS, cheapest_first
from ms_highway.visualization.colors import color_of, controller_colors, styled
from ms_highway.visualization.tables import grid, texts, two_digits

FORMS = {
    "controller": "{controller}",
    "reward/step": "{reward:.2f}",
    "90 % interval": "{reward_low:.2f}, {reward_high:.2f}",
    "reward less T": "{reward_less_t:.2f}",
    "counted ms": "{counted}",
    "plan ms": "{planning_ms:.2f}",
    "decide ms": "{decision_ms:.2f}",
    "": "{shares}",
    "collisions": "{collision_episodes} of {episodes}",
    "success": "{success_percent:.0f} %",
    "humans under tom": "{humans_tom:.1f}",
    "cycle ms p50, p99": "{cycle_ms_p50:.1f}, {cycle_ms_p99:.1f}",
    "late %": "{late_percent:.1f}",
    "fallback steps": "{fallbacks}",
}
"""Headings of a summary's texts, and how they are made of its columns."""


def cells(summaries: pd.DataFrame, scenario: str) -> pd.DataFrame:
    """Return the summary of one scenario as text: a row per controller, and texts under the columns' headings.

    Planning has two columns: as decisions count it, at T(M), and as it was measured, if it was. The reward less T(M) is
    that at a price of 1 per second. Steps driven by fallback have a column if there are any; cycles, late steps and
    success where there are several humans.
    """
    rows = summaries.query("scenario == @scenario")
    models = models_of(summaries, "share")
    models = [name for name in models if name in PAPER_MODELS or summaries[f"share_{name}"].any()]
    shares = 100 * rows.reindex(columns=[f"share_{name}" for name in models])
    rows = rows.assign(
        reward_less_t=rows["reward"] - 1e-3 * rows["counted_ms"],
        counted=rows["counted_ms"].map(two_digits),
        shares=shares.map("{:.0f}".format).agg(" / ".join, axis=1),
        success_percent=100 * rows.get("success", np.nan),
        late_percent=100 * rows.get("late", np.nan),
    )
    forms = {heading or f"{' / '.join(models)} %": form for heading, form in FORMS.items()}
    if rows["success_percent"].isna().all():
        forms = {heading: form for heading, form in forms.items() if not heading.startswith(("cycle", "late"))}
    if not rows.get("fallbacks", rows["episodes"]).any():
        del forms["fallback steps"]
    return texts(forms, rows.to_dict("records"))


def table(summaries: pd.DataFrame, scenario: str) -> pd.DataFrame:
    """Return the summary of one scenario, to be printed; its title says which controllers' T(M) is not known."""
    said = scenario
    rows = summaries.query("scenario == @scenario and counted_ms.isna()")
    unknown = [row["controller"] for _, row in rows.iterrows() if row["kind"] not in ("agent", "driver")]  # have none
    if unknown:
        remedy = "put its model on the ladder, or give its seconds by costs"
        said += f"\nT(M) is not known of {', '.join(unknown)}; {remedy}"
    return grid(said, cells(summaries, scenario).replace(" / ", "/", regex=True))


def episode_count(rows: pd.DataFrame) -> str:
    """Return the number of episodes that the rows of a summary stand for, as text for titles."""
    least, most = rows["episodes"].min(), rows["episodes"].max()
    return f"{most if least == most else f'{least} to {most}'} episodes per controller"


@styled
def bars(summaries: pd.DataFrame, scenario: str) -> Figure:
    """Draw reward and time per step of each controller, like Fig. 3 of the paper; whiskers are the 90 % intervals."""
    rows = summaries.query("scenario == @scenario")
    names, colors = rows["controller"], controller_colors(rows["controller"])
    figure = Figure(figsize=(10, 4))
    left, right = figure.subplots(1, 2)
    left.bar(names, rows["reward"], yerr=whiskers(rows), color=colors, capsize=4)
    left.axhline(0, color="black", linewidth=0.8)
    left.set(title="reward", ylabel="mean reward per step")
    right.bar(names, rows["planning_ms"], color=colors)
    right.bar(names, rows["decision_ms"], bottom=rows["planning_ms"], fc="white", ec="black", hatch="///")
    right.set(title="computation: planning, and deciding (hatched)", ylabel="mean time per step [ms]")
    for axes in (left, right):
        axes.tick_params(axis="x", rotation=20)
    figure.suptitle(f"{title(scenario)}: {episode_count(rows)}")
    return figure


def whiskers(rows: pd.DataFrame) -> list[list[float]]:
    """Return how far the intervals of the rows of a summary reach below and above their rewards; 0 without any."""
    reward = rows["reward"]
    return [(rows.get(end, reward) - reward).abs().fillna(0).to_list() for end in ("reward_low", "reward_high")]


@styled
def timeline(records: pd.DataFrame, scenario: str) -> Figure:
    """Draw time per step along the episode, and the model in use, like Fig. 2 of the paper.

    The upper axes show the mean over episodes of planning plus deciding; below, a row per episode of each
    controller that chooses online shows the model of every step.
    """
    rows = records.query("scenario == @scenario")
    rows = rows.assign(ms=1e3 * (rows["planning_seconds"] + rows["decision_seconds"]))
    names = rows["controller"].unique()
    choosing = [name for name in names if controller_config(name)["type"] in priced_types()]
    heights = [2.5] + [1] * len(choosing)
    figure = Figure(figsize=(10, 4 + 1.6 * len(choosing)))
    above, *panels = figure.subplots(len(heights), 1, sharex=True, height_ratios=heights, squeeze=False)[:, 0]
    means = rows.pivot_table("ms", "step", "controller")
    for name, color in zip(names, controller_colors(names), strict=True):
        above.plot(means[name], "-" if name in choosing else "--", color=color, label=name, linewidth=2)
    above.set(title=f"{title(scenario)}: computation along the episode", ylabel="planning + deciding [ms]")
    above.set_yscale("log")
    for name, panel in zip(choosing, panels, strict=True):
        models = rows[rows["controller"] == name].pivot(index="seed", columns="step", values="model")
        panel.imshow(models.map(model_color).to_numpy().tolist(), aspect="auto", interpolation="nearest")
        panel.set_title(name, loc="left", fontsize="medium")
        panel.set(ylabel="episode", yticks=sorted({0, len(models) - 1}))
    figure.axes[-1].set_xlabel("step (0.1 s)")
    in_use = cheapest_first(rows.loc[rows["controller"].isin(choosing), "model"])
    used = [Patch(color=color_of(model), label=f"{model} in use") for model in in_use]
    figure.legend(handles=[*above.lines, *used], loc="outside lower center", ncols=5)
    return figure
