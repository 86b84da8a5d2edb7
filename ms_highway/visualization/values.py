"""Draw what a learned value of computation sees: where it pays to think."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from matplotlib.colors import ListedColormap, TwoSlopeNorm
from matplotlib.figure import Figure, SubFigure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import NullLocator, StrMethodFormatter

from ms_highway.envs.base import InteractionEnv
from ms_highway.experiments.analysis.advantages import Advantages, Slice, along_episode, slice_of_starts
from ms_highway.experiments.runner import make_environment
from ms_highway.game.scenario import title
from ms_highway.metareasoning.values import SHIPPED_VALUES, load_values
from ms_highway.visualization.colors import color_of

__all__ = ["along", "draw_values", "seen", "where"]

SMALLEST = 0.1  # reward: the least end of a linear scale of advantages


def draw_values(scenario: str, price: float, values: str = SHIPPED_VALUES, seed: int = 0) -> Figure:
    """Drive an episode by learned values at a price, and draw what they see in it and around its start.

    Args:
        scenario: its name.
        price: lambda [reward per second].
        values: ``"shipped"``, or a file of `ms_highway.metareasoning.values`.
        seed: of the episode.

    Raises:
        ValueError: for an unknown scenario, an impossible price, or values of another ladder.
    """
    learned = load_values(values)
    env = make_environment(scenario, f"learned:{price}:{values}", costs=dict(learned.costs)).unwrapped
    assert isinstance(env, InteractionEnv)
    env.reset(seed=seed)
    start = env.car_states
    rule = learned.rule(env.models, env.costs(start), price)
    heading = f"{title(scenario)}: what the learned value sees, seed {seed}"
    return seen(heading, *along_episode(env, rule, seed), slice_of_starts(rule, env.game, start))


def seen(
    heading: str,
    advantages: Advantages,
    models: Sequence[str],
    rewards: Float[np.ndarray, "steps"],
    part: Slice,
) -> Figure:
    """Draw advantages along an episode, `along`, above a slice of the states, `where`, under a heading."""
    figure = Figure(figsize=(10, 8.2), layout="constrained")
    halves = figure.subfigures(2, 1, squeeze=False, height_ratios=[1.1, 1])
    along(halves[0, 0], advantages, models, rewards)
    where(halves[1, 0], part)
    figure.suptitle(f"{heading}, λ = {advantages.price:g}")
    return figure


def along(
    figure: Figure | SubFigure,
    advantages: Advantages,
    models: Sequence[str],
    rewards: Float[np.ndarray, "steps"],
) -> None:
    """Draw what planning a step with each model is worth more than with the cheapest one, before every step.

    Lines are means over the networks; shades reach up by their standard deviation, since a dearer model plans where
    there is doubt. The scale is linear up to 0.1 and logarithmic beyond. Below, the reward after each step; the
    background is the model in use.
    """
    steps = np.arange(len(models))
    upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=[1.8, 1])
    cheapest, *others = advantages.models
    for rung, name in enumerate(others, 1):
        mean, doubt = advantages.mean[:, rung], advantages.deviation[:, rung]
        upper.plot(steps, mean, "o-", color=color_of(name), markersize=3, label=f"{name} rather than {cheapest}")
        upper.fill_between(steps, mean, mean + doubt, color=color_of(name), alpha=0.25, linewidth=0)
    upper.set_yscale("symlog", linthresh=SMALLEST, linscale=0.7)
    upper.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    upper.yaxis.set_minor_locator(NullLocator())
    upper.axhline(0, color="black", linewidth=0.8)
    upper.set_ylabel("worth more [reward],\nnet of its price")
    upper.set_title("along an episode", loc="left", fontsize="medium")
    lower.plot(steps, rewards, color="black", linewidth=1.5, label="reward")
    lower.set(xlabel="step (0.1 s)", ylabel="reward per step", xlim=(-0.5, len(models) - 0.5))
    for axes in (upper, lower):
        for step, model in enumerate(models):
            axes.axvspan(step - 0.5, step + 0.5, color=color_of(model), alpha=0.25, linewidth=0, zorder=0)
        axes.spines[["top", "right"]].set_visible(False)
    used = [
        Patch(color=color_of(name), alpha=0.35, label=f"{name} in use") for name in advantages.models if name in models
    ]
    figure.legend(
        handles=[*upper.lines[:-1], *used],
        loc="outside lower center",
        ncols=5,
        frameon=False,
    )


def where(figure: Figure | SubFigure, part: Slice) -> None:
    """Draw the model that is chosen, and the advantage of the dearest one over the cheapest, by where the human is.

    The line is where the dearest model is worth as much as the cheapest one, by the mean over the networks: where it is
    chosen beyond that, the networks differ. The cross is the start itself.
    """
    left, right = figure.subplots(1, 2, sharey=True)
    advantages, edges = part.advantages, (*part.behind[[0, -1]], *part.faster[[0, -1]])
    names = advantages.models
    left.imshow(
        advantages.chosen,
        cmap=ListedColormap([color_of(name) for name in names]),
        vmin=-0.5,
        vmax=len(names) - 0.5,
        extent=edges,
        origin="lower",
        aspect="auto",
        interpolation="nearest",
    )
    left.set_title("at the start: the model that is chosen", loc="left", fontsize="medium")
    worth = advantages.mean[..., -1]
    end = max(float(np.nanquantile(np.abs(worth), 0.98)), SMALLEST)
    image = right.imshow(
        worth, cmap="PuOr_r", norm=TwoSlopeNorm(0, -end, end), extent=edges, origin="lower", aspect="auto"
    )
    right.set_title(f"worth of {names[-1]} rather than {names[0]}", loc="left", fontsize="medium")
    figure.colorbar(image, ax=right, label="reward, net of its price", extend="both")
    for axes in (left, right):
        if worth.min() < 0 < worth.max():
            axes.contour(part.behind, part.faster, worth, levels=[0], colors="black", linewidths=1.2)
        axes.plot(*part.start, "x", color="black", markersize=8, markeredgewidth=2)
        axes.set_xlabel("human's distance behind the robot [m]")
    left.set_ylabel("human's speed less robot's [m/s]")
    handles: list[Patch | Line2D] = [Patch(color=color_of(name), label=name) for name in names]
    handles.append(Line2D([], [], color="black", marker="x", linewidth=0, label="the episode's start"))
    handles.append(Line2D([], [], color="black", linewidth=1.2, label=f"{names[-1]} worth as much as {names[0]}"))
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles), frameon=False)
