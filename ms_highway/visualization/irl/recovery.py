"""Draw recovered weights: their ratios to the true ones, their likelihood and regret."""

from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import LogFormatter, NullFormatter, NullLocator, StrMethodFormatter

__all__ = ["likelihood_figure", "weights_figure"]

CLOSE = 1.25  # factor within which a weight counts as recovered, shaded
NUMBERS = ("#a9c8ee", "#6c9fdc", "#3371c0", "#12427f")  # colours of numbers of demonstrations, few to many
RESOLUTION = 1e-5  # of regrets, which are small differences in float32
NOT_IDENTIFIABLE = "#a0a0a0"
TICKS = np.array([n * 10.0**power for power in range(-9, 10) for n in (1, 2, 5)])


def weights_figure(rows: pd.DataFrame) -> Figure:
    """Draw the ratios of learned to true weights, with 90 % intervals; one panel per demonstrator.

    Args:
        rows: of `ms_highway.irl.recovery.recover`, with a column ``driver``; weights that are not identifiable are
            drawn hollow.
    """
    drivers, weights = list(dict.fromkeys(rows["driver"])), list(dict.fromkeys(rows["weight"]))
    numbers = sorted(rows["demonstrations"].unique())
    colors = _ramp(len(numbers))
    figure = Figure(figsize=(max(4.2 * len(drivers), 8.5), 4.6), layout="constrained")
    panels = np.atleast_1d(figure.subplots(1, len(drivers)))
    for axes, driver in zip(panels, drivers, strict=True):
        own = rows[rows["driver"] == driver]
        axes.axhspan(1 / CLOSE, CLOSE, color="#cfe8cf", zorder=0)
        axes.axhline(1, color="#4a8f4a", linewidth=0.8, zorder=0)
        for place, (number, color) in enumerate(zip(numbers, colors, strict=True)):
            some = own[own["demonstrations"] == number].set_index("weight").reindex(weights)
            x = np.arange(len(weights)) + 0.7 * ((place + 0.5) / len(numbers) - 0.5)
            middle, low, high = (np.asarray(some[end] / some["true"]) for end in ("learned", "low", "high"))
            told = some["identifiable"].fillna(False).astype(bool).to_numpy()
            for chosen, paint, face in ((told, color, color), (~told, NOT_IDENTIFIABLE, "white")):
                errors = np.stack([middle - low, high - middle])[:, chosen]
                axes.errorbar(
                    x[chosen], middle[chosen], errors, fmt="o", color=paint, mfc=face, markersize=5, capsize=2
                )
        ratios = own["learned"] / own["true"]
        clear = own[own["identifiable"].astype(bool)]
        ends = np.concatenate([[1 / 2, 2], ratios, clear["low"] / clear["true"], clear["high"] / clear["true"]])
        axes.set_yscale("log")
        axes.set(ylim=(ends.min() / 1.3, ends.max() * 1.3), xlim=(-0.5, len(weights) - 0.5), title=str(driver))
        axes.set_xticks(range(len(weights)), [name.replace("_", "\n") for name in weights])
        _plain_ticks(axes)
        for edge in np.arange(len(weights) - 1) + 0.5:
            axes.axvline(edge, color="#dddddd", linewidth=0.8, zorder=0)
        axes.spines[["top", "right"]].set_visible(False)
    panels[0].set_ylabel("learned / true weight")
    handles: list[Any] = [
        Line2D([], [], marker="o", color=color, label=f"{number}")
        for number, color in zip(numbers, colors, strict=True)
    ]
    handles.append(Line2D([], [], marker="o", color=NOT_IDENTIFIABLE, mfc="white", label="not identifiable"))
    handles.append(Patch(color="#cfe8cf", label=f"within a factor of {CLOSE:g}"))
    figure.legend(
        handles=handles,
        loc="outside lower center",
        ncols=len(handles),
        frameon=False,
        title="demonstrations; bars are 90 % intervals",
    )
    return figure


def likelihood_figure(rows: pd.DataFrame) -> Figure:
    """Draw log-likelihood and regret on held-out demonstrations against the number of demonstrations.

    Above, the log-likelihood, dashed that of the true weights; below, the regret of planning, which float32 resolves
    down to 1e-5. A column per driver.
    """
    drivers = list(dict.fromkeys(rows["driver"]))
    figure = Figure(figsize=(max(4.0 * len(drivers), 5), 5.4), layout="constrained")
    panels = figure.subplots(2, len(drivers), sharex=True, squeeze=False)
    for (upper, lower), driver in zip(panels.T, drivers, strict=True):
        own = rows[rows["driver"] == driver].drop_duplicates("demonstrations").sort_values("demonstrations")
        upper.plot(own["demonstrations"], own["log_likelihood"], "o-", color=NUMBERS[-1], label="learned weights")
        upper.axhline(
            own["log_likelihood_true"].iloc[0], color="#4a8f4a", linestyle="--", label="true weights, best temperature"
        )
        lower.plot(own["demonstrations"], 100 * own["regret"].clip(lower=RESOLUTION), "o-", color=NUMBERS[-1])
        lower.set_yscale("log")
        lower.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
        lower.yaxis.set_minor_formatter(LogFormatter())  # for axes without a decade to label
        upper.set_title(str(driver))
        upper.margins(y=0.15)
        lower.margins(y=0.15)
        lower.set_xscale("log")
        lower.set_xticks(own["demonstrations"], [f"{number}" for number in own["demonstrations"]])
        lower.xaxis.set_minor_locator(NullLocator())
        lower.set_xlabel("demonstrations")
        upper.ticklabel_format(axis="y", useOffset=False)
        for axes in (upper, lower):
            axes.spines[["top", "right"]].set_visible(False)
            axes.grid(axis="y", color="#eeeeee")
    panels[0, 0].set_ylabel("held-out log-likelihood\nper window [nat]")
    panels[1, 0].set_ylabel("regret of planning\n[% of what planning gains]")
    figure.legend(*panels[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=2, frameon=False)
    return figure


def _ramp(number: int) -> list[str]:
    """Return so many colours, from few demonstrations to many."""
    positions = np.linspace(0, len(NUMBERS) - 1, number) if number > 1 else np.array([len(NUMBERS) - 1.0])
    channels = np.array([[int(color[at : at + 2], 16) for at in (1, 3, 5)] for color in NUMBERS])
    mixed = np.stack([np.interp(positions, np.arange(len(NUMBERS)), channel) for channel in channels.T], axis=-1)
    return ["#{:02x}{:02x}{:02x}".format(*color.round().astype(int)) for color in mixed]


def _plain_ticks(axes: Axes) -> None:
    """Set ticks at 1, 2 and 5 times powers of ten, or at powers only if there are many; label them as plain numbers."""
    low, high = axes.get_ylim()
    ticks = TICKS[np.searchsorted(TICKS, low) : np.searchsorted(TICKS, high, "right")]
    axes.set_yticks(ticks if len(ticks) < 10 else ticks[np.isclose(np.log10(ticks) % 1, 0)])
    axes.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axes.yaxis.set_minor_formatter(NullFormatter())
