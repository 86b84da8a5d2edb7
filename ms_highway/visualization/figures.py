"""Draw the figures of a comparison from its records of steps and their summary."""

from collections.abc import Callable, Mapping, Sequence
from functools import partial

import numpy as np
import pandas as pd
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from matplotlib.ticker import LogLocator, NullFormatter

from ms_highway.envs.colors import model_color
from ms_highway.envs.registry import controller_config, priced_types
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
from ms_highway.visualization.tradeoff import curve, episode_count, whiskers

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
    records: pd.DataFrame,
    summaries: pd.DataFrame,
    scenario: str,
) -> dict[str, Callable[[], Figure]]:
    """Return functions that draw the figures of a scenario, by the names of `CAPTIONS`.

    Reward and computation are a curve of all controllers if a kind has three lambdas,
    and bars otherwise. Bars, rewards along the episode and timelines show the first
    eight controllers. Decisions are those of two controllers that choose online, beside
    the best fixed model, from the first start that they share.

    Args:
        records: a row per step, see
            `ms_highway.experiments.comparison.Comparison.columns`.
        summaries: of `ms_highway.experiments.summary.summary`.
        scenario: its name.
    """
    rows = summaries.query("scenario == @scenario")
    main = rows["controller"][:8]
    main_rows = rows[rows["controller"].isin(main)]
    main_records = records[records["controller"].isin(main)]
    found: dict[str, Callable[[], Figure]] = {}
    if rows.groupby("kind")["price"].nunique().max() >= 3:
        found["curve"] = partial(curve, summaries, scenario)
    else:
        found["bars"] = partial(bars, main_rows, scenario)
    found["reward"] = partial(rewards, main_records, scenario)
    found["timeline"] = partial(timeline, main_records, scenario)

    # Controllers that decide, and one that is drawn beside them.
    deciding = choosing_controllers(summaries, scenario)[:2]
    pair = most_informative_pair(summaries, scenario)
    beside = [name for name in pair if name not in deciding][:1]
    seeds = common_seeds(records, scenario, [*deciding, *beside])
    if deciding and seeds:
        start = seeds[0]
        own = [one_episode(records, scenario, name, start) for name in deciding]
        others = [one_episode(records, scenario, name, start) for name in beside]
        found["decisions"] = partial(decisions, own, *others)
    return found


@styled
def bars(summaries: pd.DataFrame, scenario: str) -> Figure:
    """Draw reward and time per step of each controller, like Fig. 3 of the paper.

    Whiskers are the 90 % intervals.
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
    """Draw the mean reward along the episode of each controller, with 90 % intervals.

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
        low, high = np.transpose([interval(own) for _, own in by_step])
        axes.plot(mean.index, mean, linewidth=1.8, **_marked_line(each, look))
        axes.fill_between(
            mean.index, low, high, color=each.color, alpha=0.2, linewidth=0
        )

    # Some room above and below, also if all rewards are the same.
    least = rows["reward"].min()
    most = rows["reward"].max()
    room = 0.05 * max(most - least, 0.01)
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


def _marked_line(own: Look, every: Mapping[str, Look]) -> dict:
    """Return how a controller's line over steps is drawn.

    The marks of all controllers are at different steps.
    """
    place = [*every.values()].index(own)
    return {
        "color": own.color,
        "linestyle": own.line,
        "label": own.label,
        "marker": own.marker,
        "markevery": (place, len(every)),
        "markersize": 5,
    }


@styled
def timeline(records: pd.DataFrame, scenario: str) -> Figure:
    """Draw time per step and the model in use, like Fig. 2 of the paper.

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

    # Computation, on a logarithmic scale.
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

    # The models in use: a row of colours for each episode.
    for name, panel in zip(choosing, panels, strict=True):
        own = rows[rows["controller"] == name]
        models = own.pivot(index="seed", columns="step", values="model")
        colors = models.map(model_color).to_numpy().tolist()
        panel.imshow(colors, aspect="auto", interpolation="nearest")
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
    episodes: Sequence[pd.DataFrame],
    reference: pd.DataFrame | None = None,
) -> Figure:
    """Draw the decisions and the reward of episodes, a column per episode.

    Above are the estimated gains of the models over the first one, before the price of
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
    handles: dict[str, Artist] = {}
    for (upper, lower), episode in zip(panels.T, episodes, strict=True):
        handles |= _draw_gains(upper, episode)
        handles |= _draw_reward(lower, episode, reference)
        for axes in (upper, lower):
            handles |= _draw_models(axes, episode)
    panels[0, 0].set_ylabel("estimated gain")
    panels[1, 0].set_ylabel("reward per step")
    legend(figure, handles.values(), handles)
    return figure


def _draw_gains(axes: Axes, episode: pd.DataFrame) -> dict[str, Artist]:
    """Draw the estimated gains of an episode; return handles by label."""
    first = episode.iloc[0]
    name = short(first["controller"])
    axes.set_title(
        f"{title(first['scenario'])}, {name}, seed {first['seed']}", fontsize="medium"
    )
    axes.set_yscale("symlog", linthresh=0.01)
    axes.yaxis.set_major_formatter(plain_ticks)
    axes.axhline(0, color="black", linewidth=0.8)
    handles: dict[str, Artist] = {}
    for model in models_of(episode.dropna(axis=1, how="all"), "gain"):
        (line,) = axes.plot(
            episode["step"],
            episode[f"gain_{model}"],
            "o-",
            color=color_of(model),
            markersize=4,
            linewidth=0.8,
        )
        handles[f"gain of {model}"] = line
    return handles


def _draw_reward(
    axes: Axes,
    episode: pd.DataFrame,
    reference: pd.DataFrame | None,
) -> dict[str, Artist]:
    """Draw the reward of an episode and of a reference; return handles by label."""
    steps = episode["step"]
    reward = episode["reward"]
    axes.plot(steps, reward, color="black", linewidth=1.5)
    axes.set(xlabel="step (0.1 s)", xlim=(-0.5, len(steps) - 0.5))
    axes.set_title(f"mean reward {reward.mean():.2f}", loc="right", fontsize="small")
    if reference is None:
        return {}
    (line,) = axes.plot(reference["step"], reference["reward"], ":", color="black")
    name = short(reference["controller"].iloc[0])
    return {f"reward of {name}": line}


def _draw_models(axes: Axes, episode: pd.DataFrame) -> dict[str, Artist]:
    """Draw the models in use as a background; return handles by label."""
    handles: dict[str, Artist] = {}
    for step, model in zip(episode["step"], episode["model"], strict=True):
        handles[f"{model} in use"] = axes.axvspan(
            step - 0.5,
            step + 0.5,
            color=color_of(model),
            alpha=0.25,
            linewidth=0,
            zorder=0,
        )
    return handles
