"""Draw the figures of a comparison from its records of steps and their summary, and
those of a frontier.
"""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from matplotlib.patheffects import withStroke
from matplotlib.ticker import LogLocator, NullFormatter

from ms_highway.envs.colors import model_color
from ms_highway.envs.registry import (
    controller_config,
    controller_settings,
    fixed_order_types,
    priced_types,
)
from ms_highway.experiments.comparison import common_seeds, models_of, one_episode
from ms_highway.experiments.summary import (
    choosing_controllers,
    interval,
    most_informative_pair,
)
from ms_highway.game.scenario import title
from ms_highway.planning.ladders import cheapest_first
from ms_highway.visualization.style import (
    Look,
    color_of,
    legend,
    looks,
    plain_ticks,
    short,
    styled,
)

SCHEDULE_COLOR = "#8a93a5"
FRONTIER_COLOR = "#c2185b"
LABEL = np.array([0.08, 0.05])  # width and height of a label, as shares of the axes
COUNTED = "planning per step, counted at T(M) [ms]"


@styled
def curve(summaries: pd.DataFrame, scenario: str) -> Figure:
    """Draw reward against computation of every controller; whiskers are the 90 %
    intervals, but not for schedules.

    On the left, planning is counted at the seconds T(M) that decisions count. On the
    right are planning and deciding as measured on this machine, if they were. A line
    per kind joins controllers that choose online, in the order of lambda. The dashed
    line is the highest reward of schedules and fixed models with at most this
    computation. Crosses are random controllers.
    """
    rows = summaries.query("scenario == @scenario")
    measures = {"counted_ms": COUNTED}
    if {"planning_ms", "decision_ms"} <= set(rows):
        rows = rows.assign(measured_ms=rows["planning_ms"] + rows["decision_ms"])
        measures["measured_ms"] = "planning + deciding per step, measured [ms]"
    figure = Figure(figsize=(4 + 3 * len(measures), 4.4))
    panels = figure.subplots(1, len(measures), sharey=True, squeeze=False)[0]
    for axes, (measure, label) in zip(panels, measures.items(), strict=True):
        orders = rows[rows["kind"].isin(fixed_order_types())].sort_values(measure)
        if (orders["kind"] != "fixed").any():
            best = {
                "linestyle": "--",
                "drawstyle": "steps-post",
                "label": "best fixed schedules",
            }
            axes.plot(
                orders[measure],
                orders["reward"],
                ".",
                color=SCHEDULE_COLOR,
                markersize=5,
            )
            axes.plot(
                orders[measure], orders["reward"].cummax(), color=SCHEDULE_COLOR, **best
            )
        _draw(axes, rows, measure)
        axes.set_xlabel(label)
    panels[0].set_ylabel("reward per step")
    legend(figure, *panels[0].get_legend_handles_labels())
    figure.suptitle(
        f"{title(scenario)}: reward against computation, {episode_count(rows)}"
    )
    return figure


@styled
def frontier(behind: pd.DataFrame, scenario: str, starts: int) -> Figure:
    """Draw reward against counted computation: the orders of models that a search
    found, and controllers.

    The line joins, over the prices that were searched, the means of the best orders of
    each start. Dots are orders that are the same for all starts.

    Args:
        behind: rows of `ms_highway.experiments.frontier.regrets`, with columns
            ``scenario`` and ``price``.
        scenario: its name.
        starts: number of starts.
    """
    rows = behind.query("scenario == @scenario")
    rows = rows.assign(counted_ms=1e3 * rows["counted_seconds"])
    found = rows.query("kind == 'search'").sort_values("counted_ms", ascending=False)
    others = rows.query("kind != 'search'").drop_duplicates("controller")
    orders = others[
        others["kind"].isin(fixed_order_types()) & (others["kind"] != "fixed")
    ]
    figure = Figure(figsize=(7, 4.4))
    axes = figure.subplots()
    label = "best order of each start"
    axes.plot(
        orders["counted_ms"],
        orders["reward"],
        ".",
        color=SCHEDULE_COLOR,
        label="orders for all starts",
    )
    axes.plot(
        found["counted_ms"], found["reward"], "D-", color=FRONTIER_COLOR, label=label
    )
    prices = [controller_settings(name).price for name in others["controller"]]
    _draw(axes, others.assign(price=prices), "counted_ms")
    axes.set(xlabel=COUNTED, ylabel="reward per step")
    figure.suptitle(f"{title(scenario)}: the best orders of models, {starts} starts")
    searched = ", ".join(f"{price:g}" for price in found["price"])
    axes.set_title(
        f"diamonds, from the right: a second of planning costs {searched}",
        fontsize="small",
    )
    legend(figure, *axes.get_legend_handles_labels())
    return figure


def _draw(axes: Axes, rows: pd.DataFrame, measure: str) -> None:
    """Draw the reward of all controllers but fixed orders over a measure of
    computation.

    Controllers that differ only in lambda are joined by a line, and random ones have
    one label.
    """
    shown = rows[
        ~rows["kind"].isin([*fixed_order_types(), "search"]) | (rows["kind"] == "fixed")
    ]
    look = looks(rows["controller"])
    priced = shown["kind"].isin(priced_types())
    without_lambda = shown["controller"].str.replace(
        r"^(\w+):[^:+]*", r"\1", regex=True
    )  # with the file, if any
    series = (
        shown["controller"]
        .mask(priced, without_lambda)
        .mask(shown["kind"] == "random", "random")
    )
    for name, own in shown.assign(series=series).groupby("series", sort=False):
        first = look[own["controller"].iloc[0]]
        kind = own["kind"].iloc[0]
        form: dict[str, Any] = {
            "marker": first.marker,
            "linestyle": "none",
            "label": first.label,
        }
        if kind in priced_types():
            own = own.sort_values("price", kind="stable")
            form |= {"linestyle": first.line, "label": f"{short(str(name))}, by lambda"}
        elif kind == "random":
            form |= {"marker": "x", "label": kind}
        elif kind == "fixed":
            form |= {
                "markersize": 9,
                "zorder": 1.9,
            }  # seen around others in the same place
        axes.errorbar(
            own[measure],
            own["reward"],
            whiskers(own),
            color=first.color,
            capsize=3,
            linewidth=1.2,
            **form,
        )
    axes.margins(0.1)  # so that labels of points at the edges are inside
    axes.set_xlim(left=0)
    axes.grid()
    axes.autoscale_view()
    labelled: list[np.ndarray] = []
    for price, *place in shown.dropna(subset="price")[
        ["price", measure, "reward"]
    ].to_numpy(float):
        spot = axes.transAxes.inverted().transform(
            axes.transData.transform(place)
        )  # as shares of the axes
        if all(
            (np.abs(spot - other) > LABEL).any() for other in labelled
        ):  # else labels would cover each other
            labelled.append(spot)
            halo = [
                withStroke(linewidth=2, foreground="white")
            ]  # over whiskers and markers
            form = {
                "xytext": (5, -11),
                "textcoords": "offset points",
                "fontsize": "x-small",
            }
            axes.annotate(f"{price:.3g}", tuple(place), path_effects=halo, **form)


def episode_count(rows: pd.DataFrame) -> str:
    """Return the number of episodes of each row of a summary, as text for titles."""
    least = rows["episodes"].min()
    most = rows["episodes"].max()
    return f"{most if least == most else f'{least} to {most}'} episodes per controller"


def whiskers(rows: pd.DataFrame) -> list[list[float]]:
    """Return how far the intervals in a summary reach below and above the rewards; 0
    without an interval.
    """
    reward = rows["reward"]
    return [
        (rows.get(end, reward) - reward).abs().fillna(0).to_list()
        for end in ("reward_low", "reward_high")
    ]


MIN_LAMBDAS = 3  # of a curve
MAX_CONTROLLERS = 8  # in bars and timelines
MAX_DECIDING = 2  # controllers whose decisions are drawn beside each other
SMALL_GAIN = 0.01

CAPTIONS = {
    "reward": (
        "Reward along the episode: the mean over episodes, with its 90 % interval at"
        " each step, of the first eight controllers."
    ),
    "bars": (
        "Reward and time per step of each controller. Whiskers are the 90 % intervals"
        " of the mean over episodes; the hatched part is the time of deciding about the"
        " model. Of more than eight controllers, the first are shown."
    ),
    "timeline": (
        "Computation along the episode, as the mean over episodes, of the first eight"
        " controllers. Below, which model was in use at every step of every episode of"
        " the controllers that choose it online."
    ),
    "curve": (
        "Reward against computation: on the left, planning as decisions count it, at"
        " T(M); on the right, planning and deciding as measured. Whiskers are the 90 %"
        " intervals. Controllers that choose online are labelled by lambda. Where"
        " schedules were compared, a dashed line is the highest reward of fixed orders"
        " with at most this computation, in these episodes. Crosses are controllers"
        " that draw their models at random."
    ),
    "decisions": (
        "Decisions in single episodes. Above, the estimated gain of each model over the"
        " first one, in this step, before the price of its time. For learned values, it"
        " is the gain of all that follows. Below, the reward. The background is the"
        " model in use."
    ),
}
"""What the figures of `figures` show."""


def figures(
    records: pd.DataFrame, summaries: pd.DataFrame, scenario: str
) -> dict[str, Callable[[], Figure]]:
    """Return functions that draw the figures of a scenario, by the names of `CAPTIONS`.

    Reward and computation are a curve of all controllers if a kind has three lambdas,
    and bars otherwise. Bars, rewards along the episode and timelines show the first
    `MAX_CONTROLLERS`. Decisions are those of two controllers that choose online, beside
    the best fixed model, from the first start that they share.

    Args:
        records: a row per step, see
            `ms_highway.experiments.comparison.Comparison.columns`.
        summaries: of `ms_highway.experiments.summary.summary`.
        scenario: its name.
    """
    rows = summaries.query("scenario == @scenario")
    main = rows["controller"][:MAX_CONTROLLERS]
    if rows.groupby("kind")["price"].nunique().max() >= MIN_LAMBDAS:
        found: dict[str, Callable[[], Figure]] = {
            "curve": partial(curve, summaries, scenario)
        }
    else:
        found = {"bars": partial(bars, rows[rows["controller"].isin(main)], scenario)}
    found["reward"] = partial(
        rewards, records[records["controller"].isin(main)], scenario
    )
    found["timeline"] = partial(
        timeline, records[records["controller"].isin(main)], scenario
    )
    deciding = choosing_controllers(summaries, scenario)[:MAX_DECIDING]
    beside = [
        name
        for name in most_informative_pair(summaries, scenario)
        if name not in deciding
    ][:1]
    seeds = common_seeds(records, scenario, [*deciding, *beside])
    if deciding and seeds:
        episodes = [
            one_episode(records, scenario, name, seeds[0])
            for name in (*deciding, *beside)
        ]
        found["decisions"] = partial(
            decisions, episodes[: len(deciding)], *episodes[len(deciding) :]
        )
    return found


@styled
def bars(summaries: pd.DataFrame, scenario: str) -> Figure:
    """Draw reward and time per step of each controller, like Fig. 3 of the paper;
    whiskers are the 90 % intervals.
    """
    rows = summaries.query("scenario == @scenario")
    look = looks(rows["controller"])
    labels = [each.label for each in look.values()]
    colors = [each.color for each in look.values()]
    figure = Figure(figsize=(10, 4.4))
    left, right = figure.subplots(1, 2)
    left.bar(labels, rows["reward"], yerr=whiskers(rows), color=colors, capsize=4)
    left.axhline(0, color="black", linewidth=0.8)
    left.set(title="reward", ylabel="mean reward per step")
    right.bar(labels, rows["planning_ms"], color=colors)
    right.bar(
        labels,
        rows["decision_ms"],
        bottom=rows["planning_ms"],
        fc="white",
        ec="black",
        hatch="///",
    )
    right.set(
        title="computation: planning, and deciding (hatched)",
        ylabel="mean time per step [ms]",
    )
    for axes in (left, right):
        axes.tick_params(axis="x", labelrotation=35, labelsize="small")
        for label in axes.get_xticklabels():
            label.set(horizontalalignment="right", rotation_mode="anchor")
    figure.suptitle(f"{title(scenario)}: {episode_count(rows)}")
    return figure


@styled
def rewards(records: pd.DataFrame, scenario: str) -> Figure:
    """Draw the reward along the episode of each controller: the mean over episodes,
    with its 90 % interval.

    The interval at a step is by Student's t over the episodes that have this step; a
    single episode has none. The axis ends at the smallest and the largest reward, and
    cuts off what intervals of few episodes have beyond.

    Args:
        records: a row per step, see
            `ms_highway.experiments.comparison.Comparison.columns`.
        scenario: its name.
    """
    rows = records.query("scenario == @scenario")
    look = looks(rows["controller"].unique())
    figure = Figure(figsize=(10, 4.8))
    axes = figure.subplots()
    for name, each in look.items():
        by_step = rows[rows["controller"] == name].groupby("step")["reward"]
        mean = by_step.mean()
        ends = [interval(own) for _, own in by_step]
        axes.plot(mean.index, mean, linewidth=1.8, **_marked_line(each, look))
        axes.fill_between(
            mean.index, *np.transpose(ends), color=each.color, alpha=0.2, linewidth=0
        )
    least = rows["reward"].min()
    most = rows["reward"].max()
    room = 0.05 * max(most - least, SMALL_GAIN)
    axes.set(
        xlabel="step (0.1 s)",
        ylabel="reward per step",
        ylim=(least - room, most + room),
    )
    axes.grid()
    axes.set_title(
        f"{title(scenario)}: reward along the episode, mean and 90 % interval"
    )
    legend(figure, *axes.get_legend_handles_labels())
    return figure


def _marked_line(own: Look, every: Mapping[str, Look]) -> dict[str, Any]:
    """Return how a controller's line over steps is drawn; the marks of all controllers
    are at different steps.
    """
    place = [*every.values()].index(own)
    marks = {"marker": own.marker, "markevery": (place, len(every)), "markersize": 5}
    return {"color": own.color, "linestyle": own.line, "label": own.label, **marks}


@styled
def timeline(records: pd.DataFrame, scenario: str) -> Figure:
    """Draw time per step along the episode, and the model in use, like Fig. 2 of the
    paper.

    The upper axes show planning plus deciding, as means over episodes. Below, for each
    controller that chooses online, a row per episode shows the model of every step.
    """
    rows = records.query("scenario == @scenario")
    rows = rows.assign(ms=1e3 * (rows["planning_seconds"] + rows["decision_seconds"]))
    names = rows["controller"].unique()
    choosing = [
        name for name in names if controller_config(name)["type"] in priced_types()
    ]
    heights = [2.5] + [1] * len(choosing)
    figure = Figure(figsize=(10, 4 + 1.6 * len(choosing)))
    above, *panels = figure.subplots(
        len(heights), 1, sharex=True, height_ratios=heights, squeeze=False
    )[:, 0]
    means = rows.pivot_table("ms", "step", "controller")
    look = looks(names)
    for name, each in look.items():
        above.plot(means[name], linewidth=1.6, **_marked_line(each, look))
    above.set(
        title=f"{title(scenario)}: computation along the episode",
        ylabel="planning + deciding [ms]",
    )
    above.set_yscale("log")
    above.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    above.yaxis.set_major_formatter(plain_ticks)
    above.yaxis.set_minor_formatter(NullFormatter())
    for name, panel in zip(choosing, panels, strict=True):
        models = rows[rows["controller"] == name].pivot(
            index="seed", columns="step", values="model"
        )
        panel.imshow(
            models.map(model_color).to_numpy().tolist(),
            aspect="auto",
            interpolation="nearest",
        )
        panel.set_title(look[name].label, loc="left", fontsize="medium")
        panel.set(ylabel="episode", yticks=sorted({0, len(models) - 1}))
    figure.axes[-1].set_xlabel("step (0.1 s)")
    in_use = cheapest_first(rows.loc[rows["controller"].isin(choosing), "model"])
    used = [Patch(color=color_of(model), label=f"{model} in use") for model in in_use]
    handles = [*above.lines, *used]
    legend(figure, handles, [str(handle.get_label()) for handle in handles])
    return figure


@styled
def decisions(
    episodes: Sequence[pd.DataFrame], reference: pd.DataFrame | None = None
) -> Figure:
    """Draw the decisions and the reward of episodes, a column per episode.

    Above, the estimated gains of the models over the first one, before the price of
    their time, in the step at which they are drawn. Algorithm 1 estimates the gain of
    the last step. Learned values of computation estimate the gain of all that follows,
    less a margin for doubt. The scale is linear up to 0.01 and logarithmic beyond.
    Below, the reward per step, on a background of the models in use.

    Args:
        episodes: of controllers that choose online, see
            `ms_highway.experiments.comparison.one_episode`.
        reference: an episode from the same start, whose reward is drawn for comparison.
    """
    figure = Figure(figsize=(10, 5))
    panels = figure.subplots(
        2,
        len(episodes),
        sharex=True,
        sharey="row",
        squeeze=False,
        height_ratios=[1.2, 1],
    )
    shown = {}
    for (upper, lower), episode in zip(panels.T, episodes, strict=True):
        first = episode.iloc[0]
        steps = episode["step"]
        rewards = episode["reward"]
        name = short(first["controller"])
        upper.set_title(
            f"{title(first['scenario'])}, {name}, seed {first['seed']}",
            fontsize="medium",
        )
        upper.set_yscale("symlog", linthresh=SMALL_GAIN)
        upper.yaxis.set_major_formatter(plain_ticks)
        upper.axhline(0, color="black", linewidth=0.8)
        for name in models_of(episode.dropna(axis=1, how="all"), "gain"):
            style = {"color": color_of(name), "markersize": 4, "linewidth": 0.8}
            shown[f"gain of {name}"] = upper.plot(
                steps, episode[f"gain_{name}"], "o-", **style
            )[0]
        lower.plot(steps, rewards, color="black", linewidth=1.5)
        lower.set(xlabel="step (0.1 s)", xlim=(-0.5, len(steps) - 0.5))
        lower.set_title(
            f"mean reward {rewards.mean():.2f}", loc="right", fontsize="small"
        )
        if reference is not None:
            (line,) = lower.plot(
                reference["step"], reference["reward"], ":", color="black"
            )
            shown[f"reward of {short(reference['controller'].iloc[0])}"] = line
        for axes in (upper, lower):
            for step, model in zip(steps, episode["model"], strict=True):
                span = axes.axvspan(
                    step - 0.5,
                    step + 0.5,
                    color=color_of(model),
                    alpha=0.25,
                    linewidth=0,
                    zorder=0,
                )
                shown[f"{model} in use"] = span
    panels[0, 0].set_ylabel("estimated gain")
    panels[1, 0].set_ylabel("reward per step")
    legend(figure, shown.values(), shown)
    return figure
