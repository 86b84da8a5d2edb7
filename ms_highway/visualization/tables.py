"""Make tables of texts, which notebooks show as they are and commands print."""

import re
from collections.abc import Iterable, Mapping, Sequence
from string import Formatter

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
    # Two would be a dash.
    "-": "{-}",
}
"""How characters are written in LaTeX that mean something there."""

SUMMARY_COLUMNS = {
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
"""Columns of a summary, see `texts`; the heading of shares names the models."""

DRIVER_COLUMNS = {
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
"""Columns of drivers on roads, likewise."""


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
        known = all(pd.notna(row.get(name)) for name in names)
        return form.format(**row) if known else ""

    lines = []
    for row in rows:
        lines.append({heading: text(form, row) for heading, form in forms.items()})
    table = pd.DataFrame(lines)
    return table.loc[:, (table != "").any()]


def grid(
    title: str,
    rows: pd.DataFrame | Sequence[Mapping],
    names: int = 1,
) -> pd.DataFrame:
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
    """Return a table of `grid` as text.

    Columns beyond a width follow below, beside the same names, and names of more than
    32 characters are shortened. Without a width, every row is one line, and names are
    whole.
    """
    shown = table
    if width is not None:
        shown = table.rename(index=_shortened)
    text = shown.to_string(line_width=width, sparsify=False)
    lines = [line.rstrip() for line in text.splitlines()]
    return "\n".join([table.attrs["title"], *lines, ""])


def _shortened(name: str) -> str:
    """Return a name without its middle if it has more than 32 characters."""
    return name if len(name) <= 32 else f"{name[:15]}…{name[-16:]}"


def latex(table: pd.DataFrame, caption: str, label: str) -> str:
    """Return a table of texts as LaTeX with the package ``booktabs``.

    Args:
        table: the texts; the first column names the row, and the others are
            right-aligned.
        caption: of the table.
        label: by which a text refers to it.
    """

    def escaped(text: str) -> str:
        return "".join(LATEX.get(character, character) for character in text)

    def cell(text: str) -> str:
        # The hyphen of a negative number is a minus sign.
        return re.sub(r"(?<![\w.])\{-\}(?=\d)", "$-$", escaped(text))

    def line(cells: Iterable[str]) -> str:
        return " & ".join(cells) + r" \\"

    rows = []
    for name, *row in table.to_numpy():
        rows.append(line([rf"\texttt{{{escaped(name)}}}", *map(cell, row)]))
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
    """Return a number with two significant digits, or without decimals from 10 on.

    The text of NaN is None.
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

    # Shares of the paper's models, and of others in use.
    models = [
        name
        for name in models_of(summaries, "share")
        if name in PAPER_MODELS or summaries[f"share_{name}"].any()
    ]
    shares = 100 * rows.reindex(columns=[f"share_{name}" for name in models])
    share_texts = shares.map("{:.0f}".format).agg(" / ".join, axis=1)

    rows = rows.assign(
        reward_less_t=rows["reward"] - 1e-3 * rows["counted_ms"],
        counted=rows["counted_ms"].map(two_digits),
        shares=share_texts,
        success_percent=100 * rows.get("success", np.nan),
        late_percent=100 * rows.get("late", np.nan),
    )
    if rows["success_percent"].isna().all():
        rows = rows.assign(cycle_ms_p50=np.nan, late_percent=np.nan)
    if not np.any(rows.get("fallbacks", 0)):
        rows = rows.assign(fallbacks=np.nan)
    return texts(_with_shares(SUMMARY_COLUMNS, models), rows.to_dict("records"))


def _with_shares(forms: Mapping[str, str], models: Iterable[str]) -> dict[str, str]:
    """Return the columns of a table, with the models in the heading of their shares."""
    heading_of_shares = f"{' / '.join(models)} %"
    return {heading or heading_of_shares: form for heading, form in forms.items()}


def table(summaries: pd.DataFrame, scenario: str) -> pd.DataFrame:
    """Return the summary of one scenario, to be printed.

    The title names controllers whose T(M) is not known.
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
    """Return tables of regrets per step in one scenario, one per price.

    They have the best lambda of each kind.

    Args:
        behind: rows of `ms_highway.experiments.frontier.regrets`, with columns
            ``scenario`` and ``price``.
        scenario: its name.
    """
    columns = {
        "controller": "{controller}",
        "reward": "{reward:.2f}",
        "counted ms": "{counted}",
        "meta-reward": "{meta_reward:.3f}",
        "regret": "{regret:.3f}",
        "90 % interval": "{regret_low:.3f}, {regret_high:.3f}",
    }
    tables = []
    of_scenario = behind.query("scenario == @scenario")
    for price, rows in of_scenario.groupby("price", sort=False):
        milliseconds = 1e3 * rows["counted_seconds"]
        ranked = rows.assign(counted=milliseconds.map(two_digits))
        ranked = ranked.sort_values("regret")
        has_lambda = ranked["kind"].isin(priced_types())
        shown = ranked[~(has_lambda & ranked.duplicated("kind"))]
        title = (
            f"{scenario}, a second of planning costs {price:g}; of each kind with a"
            " lambda, the best"
        )
        tables.append(grid(title, texts(columns, shown.to_dict("records"))))
    return tables


def driver_table(title: str, drivers: Mapping[str, Mapping]) -> pd.DataFrame:
    """Return a table of the drivers in a scene of stock roads or recorded traffic.

    Args:
        title: traffic and number of episodes.
        drivers: figures of ``bench road --json`` by driver.
    """
    rows = []
    for driver, own in drivers.items():
        episodes = own["episodes"]
        succeeded = binomtest(round(own["success"] * episodes), episodes)
        low, high = succeeded.proportion_ci(CONFIDENCE, "wilson")
        shares = None
        if own["rungs"]:
            percents = [100 * own["rungs"].get(rung, 0.0) for rung in TRAFFIC_MODELS]
            shares = " / ".join(f"{percent:.0f}" for percent in percents)
        row = {
            **own,
            "driver": driver,
            "success": 100 * own["success"],
            "low": 100 * low,
            "high": 100 * high,
            "shares": shares,
            # Cells of 0 are empty.
            "off_road": 100 * own["off_road"] or None,
            "late": 100 * own["late"] or None,
        }
        rows.append(row)
    return grid(title, texts(_with_shares(DRIVER_COLUMNS, TRAFFIC_MODELS), rows))


def speed_table(scenario: str, measured: Mapping[str, Mapping]) -> pd.DataFrame:
    """Return a table of the figures of ``bench --json`` in a scenario."""
    title = f"{scenario}: medians, on one core"
    columns = {
        "controller": "{controller}",
        "plan us": "{p50:.0f}",
        "p99": "{p99:.0f}",
        "decision us": "{decision_us:.0f}",
        "step us": "{step_us:.0f}",
        "steps /s": "{environment:,.0f}",
    }
    rows = []
    for name, own in measured.items():
        row = {**own, **own["plan_us"], "controller": name}
        if "batch" in own:
            title = (
                f"{scenario}: medians, on one core; steps per second of batches on"
                f" {own['devices']}"
            )
            for size, rate in own["batch"].items():
                columns[f"batch {size}"] = f"{{batch {size}:,.0f}}"
                row[f"batch {size}"] = rate
            columns["MiB"] = "{mib:,.0f}"
            row["mib"] = max(own["memory_mib"].values())
        rows.append(row)
    return grid(title, texts(columns, rows))
