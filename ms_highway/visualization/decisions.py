"""Draw an episode step by step: what was decided and what it was worth, on the models in use."""

from collections.abc import Sequence

import pandas as pd
from matplotlib.figure import Figure

from ms_highway.experiments.records import models_of
from ms_highway.game.scenario import title
from ms_highway.visualization.colors import color_of, styled

SMALL_GAIN = 0.01


@styled
def decisions(episodes: Sequence[pd.DataFrame], reference: pd.DataFrame | None = None) -> Figure:
    """Draw what was decided in an episode, and what it was worth; a column per episode.

    Above, the estimated net gains of switching to each model, on which Algorithm 1 decides: one above zero is taken. A
    learned value of computation counts all that follows, less a margin for doubt; it takes the highest. Gains
    are drawn at the step that is planned next; the scale is linear up to 0.01 and logarithmic beyond. Below, the
    reward per step, on a strip of the models in use.

    Args:
        episodes: of controllers that choose online, see `ms_highway.experiments.records.one_episode`.
        reference: an episode from the same start, whose reward is drawn beside.
    """
    figure = Figure(figsize=(10, 5))
    panels = figure.subplots(2, len(episodes), sharex=True, sharey="row", squeeze=False, height_ratios=[1.2, 1])
    legend = {}
    for (upper, lower), episode in zip(panels.T, episodes, strict=True):
        first, steps = episode.iloc[0], episode["step"]
        upper.set_title(f"{title(first['scenario'])}, {first['controller']}, seed {first['seed']}", fontsize="medium")
        upper.set_yscale("symlog", linthresh=SMALL_GAIN)
        upper.axhline(0, color="black", linewidth=0.8)
        for name in models_of(episode, "gain"):
            gains = episode[f"gain_{name}"]
            (line,) = upper.plot(steps, gains, "o-", color=color_of(name), markersize=4, linewidth=0.8)
            if gains.notna().any():
                legend[f"gain of switching to {name}"] = line
        lower.plot(steps, episode["reward"], color="black", linewidth=1.5)
        lower.set(xlabel="step (0.1 s)", xlim=(-0.5, len(steps) - 0.5))
        lower.set_title(f"mean reward {episode['reward'].mean():.2f}", loc="right", fontsize="small")
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
