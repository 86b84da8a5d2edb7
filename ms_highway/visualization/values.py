"""Draw what a learned value of computation sees: where it pays to think."""

from collections.abc import Sequence

import numpy as np
from matplotlib.colors import TwoSlopeNorm
from matplotlib.figure import Figure, SubFigure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from ms_highway.experiments.analysis.advantages import Seen, see
from ms_highway.game.scenario import title
from ms_highway.metareasoning.values import SHIPPED_VALUES, load_values
from ms_highway.runtime.progress import Progress, silent
from ms_highway.visualization.colors import color_of, model_colors
from ms_highway.visualization.decisions import draw_steps, steps_key
from ms_highway.visualization.section import Section
from ms_highway.visualization.tables import grid

SMALLEST = 0.1  # reward: the least end of a linear scale of advantages
PRICE = 1.0  # of a second, on pages
CAPTION = (
    "What planning a step with each model is worth more than with the cheapest one, net of its price and of a margin "
    "for doubt: the highest is chosen. Above, along an episode that the values choose for: shades are the margin, the "
    "background is the model in use. "
    "Below, where the human starts elsewhere: the model that is chosen, and what the most expensive one is worth."
)


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
    seen, figure = see(scenario, price, values, seed), Figure(figsize=(10, 8.2), layout="constrained")
    (above,), (below,) = figure.subfigures(2, 1, squeeze=False, height_ratios=[1.1, 1])
    along(above, seen)
    around(below, seen)
    figure.suptitle(f"{title(scenario)}: what the learned value sees, seed {seed}, λ = {price:g}")
    return figure


def along(figure: Figure | SubFigure, seen: Seen) -> None:
    """Draw what planning a step with each model is worth more than with the cheapest one, before every step.

    Lines are what is compared to choose: the highest one is, or the cheapest model where all are below 0. Shades are
    the margin for doubt, between the line and what the networks expect in the mean; in doubt, a more expensive model
    plans. The scale is linear up to 0.1 and logarithmic beyond. Below, the reward after each step; the background is
    the model in use.
    """
    upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=[1.8, 1])
    cheapest, *others = seen.models
    compared, expected = seen.along.compared.T[1:], seen.along.expected.T[1:]
    draw_steps((upper, lower), seen.used, dict(zip(others, compared, strict=True)), seen.rewards, SMALLEST)
    for name, line, mean in zip(others, compared, expected, strict=True):
        upper.fill_between(range(len(line)), mean, line, color=color_of(name), alpha=0.25, linewidth=0)
    upper.set_ylabel("worth more [reward],\nnet of its price")
    upper.set_title("along an episode", loc="left", fontsize="medium")
    lower.set_ylabel("reward per step")
    key = steps_key({name: f"{name} rather than {cheapest}" for name in others}, seen.used)
    figure.legend(handles=key, loc="outside lower center", ncols=5, frameon=False)


def around(figure: Figure | SubFigure, seen: Seen) -> None:
    """Draw the chosen model, and the advantage of the most expensive one over the cheapest, by where the human is.

    The line is where the most expensive model is worth as much as the cheapest one; a model between may be worth more
    than both. The cross is the start itself.
    """
    left, right = figure.subplots(1, 2, sharey=True)
    names, chosen, worth = seen.models, seen.around.chosen, seen.around.compared[..., -1]
    ends = seen.behind[0], seen.behind[-1], seen.faster[0], seen.faster[-1]
    place = {"extent": ends, "origin": "lower", "aspect": "auto", "interpolation": "nearest"}
    left.imshow(chosen, model_colors(names), vmin=-0.5, vmax=len(names) - 0.5, **place)
    left.set_title("at the start: the model that is chosen", loc="left", fontsize="medium")
    end = max(float(np.nanquantile(np.abs(worth), 0.98)), SMALLEST)
    image = right.imshow(worth, "PuOr_r", TwoSlopeNorm(0, -end, end), **place)
    right.set_title(f"worth of {names[-1]} rather than {names[0]}", loc="left", fontsize="medium")
    figure.colorbar(image, ax=right, label="reward, net of its price", extend="both")
    for axes in (left, right):
        if worth.min() < 0 < worth.max():
            axes.contour(seen.behind, seen.faster, worth, levels=[0], colors="black", linewidths=1.2)
        axes.plot(*seen.start, "x", color="black", markersize=8, markeredgewidth=2)
        axes.set_xlabel("human's distance behind the robot [m]")
    left.set_ylabel("human's speed less robot's [m/s]")
    key = [
        *(Patch(color=color_of(name), label=name) for name in names),
        Line2D([], [], color="black", marker="x", linewidth=0, label="the episode's start"),
        Line2D([], [], color="black", linewidth=1.2, label=f"{names[-1]} worth as much as {names[0]}"),
    ]
    figure.legend(handles=key, loc="outside lower center", ncols=len(key), frameon=False)


def values_section(which: str, scenarios: Sequence[str], progress: Progress = silent) -> Section:
    """Return the section of a file of values.

    Args:
        which: ``"shipped"``, or a file of `ms_highway.metareasoning.values`.
        scenarios: names of those that are drawn, by default those that the values were learned in.
        progress: called with a message before everything that takes time.

    Raises:
        ValueError: if the file cannot be read, or holds values of another ladder.
    """
    values = load_values(which)
    facts = {
        "ladder": ", ".join(values.ladder),
        "over the": f"{values.baseline} model",
        "costs, s": ", ".join(f"{seconds:g}" for seconds in values.costs),
        "lambda": " to ".join(f"{price:g}" for price in values.prices),
    }
    facts |= {name: str(value) for name, value in values.provenance.items() if name not in facts}
    figures = {}
    drawn = scenarios or values.provenance.get("scenarios", [])
    for scenario in drawn:
        progress(f"{scenario}: driving an episode by the values")
        figures[scenario] = draw_values(scenario, PRICE, which), CAPTION
    return Section(
        "Values of computation",
        "When is a more expensive model worth its computation?",
        f"Drawn at a price of {PRICE:g} reward per second, along an episode and around its start, in "
        f"{', '.join(map(title, drawn))}.",
        [grid(which, [{"": name, "value": text} for name, text in facts.items()], 2)],
        figures,
    )
