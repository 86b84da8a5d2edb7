"""Draw the figures of a comparison from its records of steps and their summary."""

from collections.abc import Callable, Sequence
from functools import partial

import pandas as pd
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from ms_highway.envs.registry import controller_config, priced_types
from ms_highway.envs.viewer import model_color
from ms_highway.experiments.records import common_seeds, models_of, one_episode
from ms_highway.experiments.summary import choosing_controllers, most_informative_pair
from ms_highway.game.scenario import title
from ms_highway.planning.ladders import cheapest_first
from ms_highway.visualization.style import color_of, controller_colors, styled
from ms_highway.visualization.tradeoff import curve, episode_count, whiskers

MIN_LAMBDAS = 3  # of a curve
MAX_CONTROLLERS = 8  # in bars and timelines
MAX_DECIDING = 2  # controllers whose decisions are drawn beside each other
SMALL_GAIN = 0.01

CAPTIONS = {
    "bars": "Reward and time per step of each controller. Whiskers are the 90 % intervals of the mean over episodes; "
    "the hatched part is the time of deciding about the model.",
    "timeline": "Computation along the episode, as the mean over episodes. Below, which model was in use at every step "
    "of every episode of the controllers that choose it online.",
    "curve": "Reward against computation: on the left, planning as decisions count it, at T(M); on the right, planning "
    "and deciding as measured. Whiskers are the 90 % intervals. Controllers that choose online are labelled by lambda. "
    "Where schedules were compared, a dashed line is the highest reward of fixed orders with at most this computation, "
    "in these episodes. Crosses are controllers that draw their models at random.",
    "decisions": "Decisions in single episodes. Above, the estimated net gain of switching to each model in this step; "
    "a gain above zero is taken. For learned values, it is the gain of all that follows. Below, the reward. The "
    "background is the model in use.",
}
"""What the figures of `figures` show."""


def figures(records: pd.DataFrame, summaries: pd.DataFrame, scenario: str) -> dict[str, Callable[[], Figure]]:
    """Return functions that draw the figures of a scenario, by the names of `CAPTIONS`.

    Reward and computation are a curve of all controllers if a kind has three lambdas, and bars otherwise. Decisions are
    those of two controllers that choose online, beside the best fixed model, from the first start that they share.

    Args:
        records: a row per step, see `ms_highway.experiments.records.columns`.
        summaries: of `ms_highway.experiments.summary.summary`.
        scenario: its name.
    """
    rows = summaries.query("scenario == @scenario")
    main = rows["controller"][:MAX_CONTROLLERS]
    if rows.groupby("kind")["price"].nunique().max() >= MIN_LAMBDAS:
        found: dict[str, Callable[[], Figure]] = {"curve": partial(curve, summaries, scenario)}
    else:
        found = {"bars": partial(bars, rows[rows["controller"].isin(main)], scenario)}
    found["timeline"] = partial(timeline, records[records["controller"].isin(main)], scenario)
    deciding = choosing_controllers(summaries, scenario)[:MAX_DECIDING]
    beside = [name for name in most_informative_pair(summaries, scenario) if name not in deciding][:1]
    seeds = common_seeds(records, scenario, [*deciding, *beside])
    if deciding and seeds:
        episodes = [one_episode(records, scenario, name, seeds[0]) for name in (*deciding, *beside)]
        found["decisions"] = partial(decisions, episodes[: len(deciding)], *episodes[len(deciding) :])
    return found


@styled
def bars(summaries: pd.DataFrame, scenario: str) -> Figure:
    """Draw reward and time per step of each controller, like Fig. 3 of the paper; whiskers are the 90 % intervals."""
    rows = summaries.query("scenario == @scenario")
    names = rows["controller"]
    colors, figure = controller_colors(names), Figure(figsize=(10, 4))
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


@styled
def timeline(records: pd.DataFrame, scenario: str) -> Figure:
    """Draw time per step along the episode, and the model in use, like Fig. 2 of the paper.

    The upper axes show planning plus deciding, as means over episodes. Below, for each controller that chooses online,
    a row per episode shows the model of every step.
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


@styled
def decisions(episodes: Sequence[pd.DataFrame], reference: pd.DataFrame | None = None) -> Figure:
    """Draw the decisions and the reward of episodes, a column per episode.

    Above, the estimated net gains of switching to each model in the step at which they are drawn. Algorithm 1 takes a
    gain above zero. Learned values of computation estimate the gain of all that follows, less a margin for doubt, and
    the highest one is taken. The scale is linear up to 0.01 and logarithmic beyond. Below, the reward per step, on a
    background of the models in use.

    Args:
        episodes: of controllers that choose online, see `ms_highway.experiments.records.one_episode`.
        reference: an episode from the same start, whose reward is drawn for comparison.
    """
    figure = Figure(figsize=(10, 5))
    panels = figure.subplots(2, len(episodes), sharex=True, sharey="row", squeeze=False, height_ratios=[1.2, 1])
    legend = {}
    for (upper, lower), episode in zip(panels.T, episodes, strict=True):
        first, steps, rewards = episode.iloc[0], episode["step"], episode["reward"]
        upper.set_title(f"{title(first['scenario'])}, {first['controller']}, seed {first['seed']}", fontsize="medium")
        upper.set_yscale("symlog", linthresh=SMALL_GAIN)
        upper.axhline(0, color="black", linewidth=0.8)
        for name in models_of(episode.dropna(axis=1, how="all"), "gain"):
            style = {"color": color_of(name), "markersize": 4, "linewidth": 0.8}
            legend[f"gain of switching to {name}"] = upper.plot(steps, episode[f"gain_{name}"], "o-", **style)[0]
        lower.plot(steps, rewards, color="black", linewidth=1.5)
        lower.set(xlabel="step (0.1 s)", xlim=(-0.5, len(steps) - 0.5))
        lower.set_title(f"mean reward {rewards.mean():.2f}", loc="right", fontsize="small")
        if reference is not None:
            (line,) = lower.plot(reference["step"], reference["reward"], ":", color="black")
            legend[f"reward of {reference['controller'].iloc[0]}"] = line
        for axes in (upper, lower):
            for step, model in zip(steps, episode["model"], strict=True):
                span = axes.axvspan(step - 0.5, step + 0.5, color=color_of(model), alpha=0.25, linewidth=0, zorder=0)
                legend[f"{model} in use"] = span
    panels[0, 0].set_ylabel("estimated net gain")
    panels[1, 0].set_ylabel("reward per step")
    figure.legend(legend.values(), legend, loc="outside lower center", ncols=4)
    return figure
