"""Make tables of texts: data frames that notebooks show as they are and commands print."""

import re
from collections.abc import Iterable, Mapping
from string import Formatter
from typing import Any

import numpy as np
import pandas as pd
from scipy.stats import binomtest

from ms_highway.envs.registry import priced_types
from ms_highway.experiments.comparison import models_of
from ms_highway.experiments.summary import CONFIDENCE
from ms_highway.planning.ladders import PAPER_MODELS
from ms_highway.road.traffic_models import TRAFFIC_MODELS

LATEX = {
    "\\": r"\textbackslash{}",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    **{character: f"\\{character}" for character in "&%$#_{}"},
    "<": r"\textless{}",
    ">": r"\textgreater{}",
    "|": r"\textbar{}",
    "-": "{-}",  # two would be a dash
}
"""How characters are written in LaTeX that mean something there."""

NAME_WIDTH = 32  # characters, to which longer names are shortened in print

SUMMARY = {
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
REGRETS = {
    "controller": "{controller}",
    "reward": "{reward:.2f}",
    "counted ms": "{counted}",
    "meta-reward": "{meta_reward:.3f}",
    "regret": "{regret:.3f}",
    "90 % interval": "{regret_low:.3f}, {regret_high:.3f}",
}
DRIVERS = {
    "driver": "{driver}",
    "label": "{label}",
    "success (90 % interval)": "{success:.0f} % ({low:.0f}, {high:.0f})",
    "collisions (at fault)": "{collisions} ({at_fault})",
    "with any collision": "{any_collisions}",
    "off road": "{off_road:.0f} %",
    "s to goal": "{goal_seconds:.1f}",
    "reward per step": "{reward_per_step:.3f}",
    "m/s": "{mean_speed:.1f}",
    "others m/s": "{others_speed:.1f}",
    "m/s² at most": "{max_acceleration:.1f}",
    "jerk, m/s³": "{jerk:.1f}",
    "": "{shares}",
    "ms p50, p99": "{p50_ms:.1f}, {p99_ms:.1f}",
    "late": "{late:.0f} %",
}
SPEED = {
    "controller": "{controller}",
    "plan us": "{p50:.0f}",
    "p99": "{p99:.0f}",
    "decision us": "{decision_us:.0f}",
    "step us": "{step_us:.0f}",
    "steps /s": "{environment:,.0f}",
}
"""Columns of tables: for every heading, the format of its texts, which takes numbers by
name.
"""


def texts(forms: Mapping[str, str], rows: Iterable[Mapping]) -> pd.DataFrame:
    """Return a table of texts.

    A text is empty if one of its values is missing, None or NaN. Columns without any
    text are left out.

    Args:
        forms: format strings by heading.
        rows: values by name.
    """

    def text(form: str, row: Mapping) -> str:
        names = [name for _, name, _, _ in Formatter().parse(form) if name]
        return (
            form.format(**row) if all(pd.notna(row.get(name)) for name in names) else ""
        )

    table = pd.DataFrame(
        [{heading: text(form, row) for heading, form in forms.items()} for row in rows]
    )
    return table.loc[:, (table != "").any()]


def grid(title: str, rows: Any, names: int = 1) -> pd.DataFrame:
    """Return a table with a title in its ``attrs``.

    Args:
        title: of the table.
        rows: data frame of texts, or a mapping by heading for each row.
        names: number of the first columns that name the row.
    """
    table = pd.DataFrame(rows).fillna("")
    table = table.set_index(list(table.columns[:names]))
    table.attrs["title"] = title
    return table


def printed(table: pd.DataFrame, width: int | None) -> str:
    """Return a table of `grid` as text of a width; columns beyond it follow below,
    beside the same names.

    Long names are shortened. Without a width, every row is one line, and names are
    whole.
    """
    shown = table
    if width is not None:
        shown = table.rename(
            index=lambda name: (
                name if len(name) <= NAME_WIDTH else f"{name[:15]}…{name[-16:]}"
            )
        )
    text = shown.to_string(line_width=width, sparsify=False)
    return "\n".join(
        [table.attrs["title"], *(line.rstrip() for line in text.splitlines()), ""]
    )


def latex(table: pd.DataFrame, caption: str, label: str) -> str:
    """Return a table of texts as LaTeX with the package ``booktabs``; the first column
    names the row.

    Args:
        table: the texts; all numbers are right-aligned.
        caption: of the table.
        label: by which a text refers to it.
    """

    def escaped(text: str) -> str:
        return "".join(LATEX.get(character, character) for character in text)

    def cell(text: str) -> str:
        return re.sub(r"(?<![\w.])\{-\}(?=\d)", "$-$", escaped(text))

    def line(cells: Iterable[str]) -> str:
        return " & ".join(cells) + r" \\"

    rows = [
        line([rf"\texttt{{{escaped(name)}}}", *map(cell, row)])
        for name, *row in table.to_numpy()
    ]
    lines = [
        r"\begin{table}",
        r"\centering",
        rf"\caption{{{escaped(caption)}}}",
        rf"\label{{{label}}}",
        rf"\begin{{tabular}}{{l{'r' * (table.shape[1] - 1)}}}",
        r"\toprule",
        line(map(escaped, table.columns)),
        r"\midrule",
        *rows,
        r"\bottomrule",
        r"\end{tabular}",
        r"\end{table}",
    ]
    return "\n".join([*lines, ""])


def two_digits(value: float) -> str | None:
    """Return a number with two significant digits, or without decimals from 10 on; None
    for NaN.
    """
    if pd.isna(value):
        return None
    return f"{value:.2g}" if abs(value) < 10 else f"{value:.0f}"


def cells(summaries: pd.DataFrame, scenario: str) -> pd.DataFrame:
    """Return the summary of one scenario as texts, a row per controller.

    Planning has two columns: counted at T(M), and measured, if it was. "reward less T"
    is at a price of 1 per second. Fallback steps have a column if there are any;
    cycles, late steps and success have one with several humans.
    """
    rows = summaries.query("scenario == @scenario")
    models = models_of(summaries, "share")
    models = [
        name
        for name in models
        if name in PAPER_MODELS or summaries[f"share_{name}"].any()
    ]
    shares = 100 * rows.reindex(columns=[f"share_{name}" for name in models])
    rows = rows.assign(
        reward_less_t=rows["reward"] - 1e-3 * rows["counted_ms"],
        counted=rows["counted_ms"].map(two_digits),
        shares=shares.map("{:.0f}".format).agg(" / ".join, axis=1),
        success_percent=100 * rows.get("success", np.nan),
        late_percent=100 * rows.get("late", np.nan),
    )
    if rows["success_percent"].isna().all():
        rows = rows.assign(cycle_ms_p50=np.nan, late_percent=np.nan)
    if not np.any(rows.get("fallbacks", 0)):
        rows = rows.assign(fallbacks=np.nan)
    return texts(_with_shares(SUMMARY, models), rows.to_dict("records"))


def _with_shares(forms: Mapping[str, str], models: Iterable[str]) -> dict[str, str]:
    """Return the columns of a table, with the models in the heading of their shares."""
    return {
        heading or f"{' / '.join(models)} %": form for heading, form in forms.items()
    }


def table(summaries: pd.DataFrame, scenario: str) -> pd.DataFrame:
    """Return the summary of one scenario, to be printed; the title names controllers
    whose T(M) is not known.
    """
    title = scenario
    rows = summaries.query(
        "scenario == @scenario and counted_ms.isna() and kind not in ['agent',"
        " 'driver']"
    )
    if len(rows):
        remedy = "put its model on the ladder, or give its seconds by costs"
        title += f"\nT(M) is not known of {', '.join(rows['controller'])}; {remedy}"
    return grid(title, cells(summaries, scenario).replace(" / ", "/", regex=True))


def regret_tables(behind: pd.DataFrame, scenario: str) -> list[pd.DataFrame]:
    """Return tables of regrets per step in one scenario, one per price, with the best
    lambda of each kind.

    Args:
        behind: rows of `ms_highway.experiments.frontier.regrets`, with columns
            ``scenario`` and ``price``.
        scenario: its name.
    """
    tables = []
    for price, rows in behind.query("scenario == @scenario").groupby(
        "price", sort=False
    ):
        ranked = rows.assign(
            counted=(1e3 * rows["counted_seconds"]).map(two_digits)
        ).sort_values("regret")
        shown = ranked[
            ~(ranked["kind"].isin(priced_types()) & ranked.duplicated("kind"))
        ]
        title = (
            f"{scenario}, a second of planning costs {price:g}; of each kind with a"
            " lambda, the best"
        )
        tables.append(grid(title, texts(REGRETS, shown.to_dict("records"))))
    return tables


def driver_table(title: str, drivers: Mapping[str, Mapping]) -> pd.DataFrame:
    """Return a table of the drivers in a scene of stock roads or recorded traffic.

    Args:
        title: traffic and number of episodes.
        drivers: figures of ``bench road --json`` by driver.
    """
    rows = []
    for driver, one in drivers.items():
        succeeded = binomtest(round(one["success"] * one["episodes"]), one["episodes"])
        low, high = succeeded.proportion_ci(CONFIDENCE, "wilson")
        shares = (
            " / ".join(
                f"{100 * one['rungs'].get(rung, 0.0):.0f}" for rung in TRAFFIC_MODELS
            )
            if one["rungs"]
            else None
        )
        percent = {name: 100 * one[name] or None for name in ("off_road", "late")}
        row = {
            **one,
            **percent,
            "driver": driver,
            "success": 100 * one["success"],
            "shares": shares,
        }
        rows.append(row | {"low": 100 * low, "high": 100 * high})
    return grid(title, texts(_with_shares(DRIVERS, TRAFFIC_MODELS), rows))


def speed_table(scenario: str, measured: Mapping[str, Mapping]) -> pd.DataFrame:
    """Return a table of the figures of ``bench --json`` in a scenario, by controller."""
    forms = dict(SPEED)
    title = f"{scenario}: medians, on one core"
    for one in measured.values():
        if "batch" in one:
            forms |= {
                f"batch {size}": f"{{batch {size}:,.0f}}" for size in one["batch"]
            } | {"MiB": "{mib:,.0f}"}
            title = (
                f"{scenario}: medians, on one core; steps per second of batches on"
                f" {one['devices']}"
            )
    rows = []
    for name, one in measured.items():
        batches = {f"batch {size}": rate for size, rate in one.get("batch", {}).items()}
        memory = max(one.get("memory_mib", {}).values(), default=None)
        rows.append(
            {**one, **one["plan_us"], **batches, "controller": name, "mib": memory}
        )
    return grid(title, texts(forms, rows))
