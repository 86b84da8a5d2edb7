"""Show how drivers fare on stock roads and in recorded traffic.

Figures of a driver are those of `ms-highway bench road --json`; figures of earlier versions may lack some.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from scipy.stats import binomtest

from ms_highway.experiments.summary import CONFIDENCE
from ms_highway.planning.human_models import cheapest_first
from ms_highway.road.constants import MODELS
from ms_highway.visualization.colors import styled
from ms_highway.visualization.tables import grid, texts

Drivers = Mapping[str, Mapping[str, Any]]
"""Figures in a scene, by driver."""

FORMS = {
    "driver": "{driver}",
    "label": "{label}",
    "success (90 % interval)": "{success:.0f} % ({low:.0f}, {high:.0f})",
    "collisions (at fault)": "{collisions} ({at_fault})",
    "off road": "{off_road:.0f} %",
    "s to goal": "{goal_seconds:.1f}",
    "reward per step": "{reward_per_step:.3f}",
    "m/s": "{mean_speed:.1f}",
    "m/s² at most": "{max_acceleration:.1f}",
    "jerk, m/s³": "{jerk:.1f}",
    "": "{shares}",
    "ms p50, p99": "{p50_ms:.1f}, {p99_ms:.1f}",
    "late": "{late:.0f} %",
    "traffic": "{traffic}",
    "episodes": "{number} from {first} on",
}
"""Headings of a driver's texts, and how they are made of its figures."""


def success_interval(figures: Mapping[str, Any]) -> tuple[float, float]:
    """Return the interval of the share of successful episodes, by Wilson's score."""
    episodes = figures["episodes"]
    return binomtest(round(figures["success"] * episodes), episodes).proportion_ci(CONFIDENCE, "wilson")


def driver_table(title: str, drivers: Drivers) -> pd.DataFrame:
    """Return a table of the drivers in a scene; the title says which traffic and how many episodes."""
    return grid(title, driver_texts(drivers).drop(columns=["traffic", "episodes"]))


def driver_texts(drivers: Drivers) -> pd.DataFrame:
    """Return a row of texts for each driver, without columns that are empty in all rows."""
    rungs = cheapest_first([*MODELS, *(rung for one in drivers.values() for rung in one.get("rungs", ()))])
    forms = {heading or f"{' / '.join(rungs)} %": form for heading, form in FORMS.items()}
    rows = []
    for driver, one in drivers.items():
        low, high = success_interval(one)
        first, number = one["seeds"]
        row = {**one, "driver": driver, "first": first, "number": number, "success": 100 * one["success"]}
        row |= {name: 100 * one.get(name, 0.0) or None for name in ("off_road", "late")}
        row |= {"low": 100 * low, "high": 100 * high}
        if own := one.get("rungs"):
            row["shares"] = " / ".join(f"{100 * own.get(rung, 0.0):.0f}" for rung in rungs)
        rows.append(row)
    return texts(forms, rows)


@styled
def success_figure(scenes: Mapping[str, Drivers]) -> Figure:
    """Draw the share of successful episodes of each driver, with intervals: a panel for each scene."""
    counts = [len(drivers) for drivers in scenes.values()]
    figure = Figure(figsize=(8, 1 + 0.5 * len(counts) + 0.2 * sum(counts)))
    panels = figure.subplots(len(counts), sharex=True, squeeze=False, height_ratios=counts)[:, 0]
    for axes, (scene, drivers) in zip(panels, scenes.items(), strict=True):
        percent = 100 * np.array([one["success"] for one in drivers.values()])
        ends = 100 * np.array([success_interval(one) for one in drivers.values()])
        axes.errorbar(percent, list(drivers), xerr=np.abs(ends.T - percent), fmt="o", capsize=2)
        axes.set_title(scene, loc="left")
        axes.invert_yaxis()
    panels[-1].set(xlim=(-2, 102), xlabel="% of episodes that succeed, with 90 % intervals")
    return figure
