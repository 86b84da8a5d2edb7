"""One episode: what was decided at every step, and what the road looked like when it changed its mind."""

from collections.abc import Sequence

import numpy as np
import pandas as pd
from jaxtyping import UInt8
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import NullLocator, StrMethodFormatter

from ms_highway.envs import ENVIRONMENTS
from ms_highway.experiments.records import gain_column, models_of, switches
from ms_highway.game.scenario import title
from ms_highway.planning.human_models import known_models
from ms_highway.visualization.colors import color_of

__all__ = ["decisions", "storyboard"]

FRAMES_IN_A_ROW = 3
CROP = 0.15, 0.75  # of a frame's width, where the cars are
LINEAR = 0.01  # gain up to which the scale is linear


def decisions(episodes: Sequence[pd.DataFrame], reference: pd.DataFrame | None = None) -> Figure:
    """Draw what was decided in an episode, and what it was worth; a column per episode.

    Above, the estimated net gains of switching to each model, on which Algorithm 1 decides: one above zero is taken. A
    learned value of computation counts all that follows; it takes the highest, with caution where it is in doubt. Gains
    are drawn at the step that is planned next; the scale is linear up to 0.01 and logarithmic beyond. Below, the
    reward per step, on a strip of the models in use.

    Args:
        episodes: of controllers that choose online, see `ms_highway.experiments.records.one_episode`.
        reference: an episode from the same start, whose reward is drawn beside.
    """
    figure = Figure(figsize=(10, 5), layout="constrained")
    panels = figure.subplots(2, len(episodes), sharex=True, sharey="row", squeeze=False, height_ratios=[1.2, 1])
    for (upper, lower), episode in zip(panels.T, episodes, strict=True):
        upper.set_title(_title(episode), fontsize="medium")
        _gains(upper, episode)
        _rewards(lower, episode, reference)
    panels[0, 0].set_ylabel("estimated net gain")
    panels[1, 0].set_ylabel("reward per step")
    handles: list[Line2D | Patch] = [
        Line2D([], [], color=color_of(name), marker="o", linewidth=0, label=f"gain of switching to {name}")
        for name in known_models(name for episode in episodes for name in models_of(episode, gain_column))
        if any(_gains_of(episode, name).notna().any() for episode in episodes)
    ]
    used = set().union(*(episode["model"] for episode in episodes))
    handles += [
        Patch(color=color_of(name), alpha=0.35, label=f"{name} in use") for name in known_models(used) if name in used
    ]
    if reference is not None:
        label = f"reward of {reference['controller'].iloc[0]}"
        handles.append(Line2D([], [], color="black", linestyle=":", label=label))
    figure.legend(handles=handles, loc="outside lower center", ncols=4, frameon=False)
    return figure


def _title(episode: pd.DataFrame) -> str:
    first = episode.iloc[0]
    return f"{title(first['scenario'])}, {first['controller']}, seed {first['seed']}"


def _gains(axes: Axes, episode: pd.DataFrame) -> None:
    axes.set_yscale("symlog", linthresh=LINEAR, linscale=0.7)
    axes.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axes.yaxis.set_minor_locator(NullLocator())
    axes.grid(axis="y", color="white", linewidth=0.8)
    axes.axhline(0, color="black", linewidth=0.8)
    for name in models_of(episode, gain_column):
        gains = _gains_of(episode, name)
        axes.plot(episode["step"], gains, "o", color=color_of(name), markersize=4)
        axes.plot(episode["step"], gains, color=color_of(name), linewidth=0.8, alpha=0.5)
    _strip(axes, episode)


def _gains_of(episode: pd.DataFrame, model: str) -> pd.Series:
    """Estimated gains of switching to a model; none where it was not known yet."""
    return episode.get(gain_column(model), pd.Series(np.nan, episode.index))


def _rewards(axes: Axes, episode: pd.DataFrame, reference: pd.DataFrame | None) -> None:
    axes.plot(episode["step"], episode["reward"], color="black", linewidth=1.5)
    if reference is not None:
        axes.plot(reference["step"], reference["reward"], ":", color="black")
    mean = episode["reward"].mean()
    axes.set_title(f"mean reward {mean:.2f}", loc="right", fontsize="small")
    axes.set_xlabel("step (0.1 s)")
    _strip(axes, episode)


def _strip(axes: Axes, episode: pd.DataFrame) -> None:
    """Draw the background of each step in the colour of its model."""
    for step, model in zip(episode["step"], episode["model"], strict=True):
        axes.axvspan(step - 0.5, step + 0.5, color=color_of(model), alpha=0.25, linewidth=0, zorder=0)
    axes.set_xlim(-0.5, len(episode) - 0.5)
    axes.spines[["top", "right"]].set_visible(False)


def storyboard(episode: pd.DataFrame, pictures: Sequence[UInt8[np.ndarray, "h w 3"]], most: int = 6) -> Figure:
    """Time along an episode, with the road at the steps at which the model changed.

    Args:
        episode: see `ms_highway.experiments.records.one_episode`.
        pictures: the frames of the same episode, see `ms_highway.visualization.video.film`; their panels are cut off.
        most: how many steps are shown at most; where there are more `switches`, the first two, and of the others those
            after which the model stayed longest.
    """
    panel = ENVIRONMENTS[episode["scenario"].iloc[0]].viewer_class.panel_height
    starts = switches(episode)
    lengths = np.diff([*starts, len(episode)])
    lengths[:2] = len(episode)
    shown = sorted(np.array(starts)[np.argsort(-lengths, kind="stable")[:most]].tolist())
    rows = -(-len(shown) // FRAMES_IN_A_ROW)
    figure = Figure(figsize=(12, 1.9 + 1.6 * rows), layout="constrained")
    halves = figure.subfigures(2, 1, squeeze=False, height_ratios=[1.6 * rows, 1.9])
    upper, lower = halves[0, 0], halves[1, 0]
    for number, axes in enumerate(upper.subplots(rows, FRAMES_IN_A_ROW, squeeze=False).ravel()):
        axes.axis("off")
        if number < len(shown):
            step = shown[number]
            picture, record = pictures[step], episode.iloc[step]
            height, width, _ = picture.shape
            axes.imshow(picture[: height - panel, round(CROP[0] * width) : round(CROP[1] * width)])
            axes.set_title(
                f"{number + 1}: step {step}, {record['model']}",
                loc="left",
                fontsize="medium",
                color=color_of(record["model"]),
            )
    axes = lower.subplots()
    milliseconds = 1e3 * (episode["planning_seconds"] + episode["decision_seconds"])
    axes.bar(episode["step"], milliseconds, width=0.9, color=[color_of(model) for model in episode["model"]])
    for number, step in enumerate(shown):
        axes.text(step, 1.04, f"{number + 1}", transform=axes.get_xaxis_transform(), ha="center", weight="bold")
    axes.set(xlabel="step (0.1 s)", ylabel="planning +\ndeciding [ms]", xlim=(-0.5, len(episode) - 0.5))
    axes.spines[["top", "right"]].set_visible(False)
    figure.suptitle(_title(episode))
    return figure
