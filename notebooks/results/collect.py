"""Keep what lies in `results/` here, and rewrite the tables that show it.

There are five files, and the tables are those of the pages. Run it in the project's
directory after any of the commands in `notebooks/results/README.md`; runs that do not
lie in `results/` stay as they were kept::

    python notebooks/results/collect.py
"""

import json
import re
from collections.abc import Iterable
from pathlib import Path

import pandas as pd

from ms_highway.benchmarks.road import DEFAULT_DRIVERS, OTHER_SCENES, SCENES
from ms_highway.envs.registry import fixed_order_types
from ms_highway.experiments.frontier import BEST_PER_START
from ms_highway.experiments.summary import Results
from ms_highway.visualization.html_page import results_table

KEPT = Path(__file__).parent
PAGES = KEPT.parents[1] / "README.md", KEPT / "README.md"
LIMITS = ("limit_50", "limit_9", "limit_6")
CROWDS = "dense_merge_v1", "crossing_crowd_v1"
RUNS = (
    "physical",
    "compare",
    "released",
    "curve",
    "worth",
    *CROWDS,
    "frontier",
    *LIMITS,
)
"""Directories in results/."""

OUTCOME = (
    "controller",
    "reward/step",
    "90 % interval",
    "collisions",
)  # cells of a run that stand beside others
TABLES = (
    "summary",
    "regrets",
)  # what some of them hold, and what is kept with a column ``run``
ROADS = "road", "road_commuters"
"""Directories of figures in results/, each file written by ``ms-highway bench road
--json``, and what keeps them.
"""

RECORDED = "recorded"
"""Directory of figures in results/, files ``EGOS_TRAFFIC.json`` of ``bench road
recorded``, and what keeps them.
"""

PHYSICAL = {  # in the project's README
    "merger-v1": ["naive", "tom", "learned:1", "switching:0.1"],
    "give-way-v1": ["naive", "tom", "learned:1", "switching:0.1"],
    "stay-back-v1": ["naive", "turn", "tom", "learned:1", "switching:0.1"],
}
REWARD = "reward per step (90 % interval)"
COLLISIONS = "episodes with a collision"
SHOWN_COLUMNS = [REWARD, "plan ms", COLLISIONS]
SEVERAL_COLUMNS = [
    "scenario",
    "controller",
    REWARD,
    COLLISIONS,
    "success",
    "counted ms",
]
WORTH = {
    scenario: ["naive", "tom", "tom@6+warm", "learned:10"]
    for scenario in ("merger", "give_way")
}
LIMITED = {
    "stay_back": ["turn"],
    "merger": ["tom"],
    "give_way": ["tom", "switching:0.01"],
}

OUTCOMES = "{success:.0%}, {collisions} ({at_fault}) of {episodes}, "
ROAD_DRIVERS = {
    "priced": "priced",
    "idm": "idm",
    "agents/dqn-SCENE-0.zip": "DQN",
    "agents/ppo-SCENE-0.zip": "PPO",
}
RECORDED_DRIVERS = {
    name: name for name in ("priced", "fixed:naive", "fixed:tom", "idm", "human")
}
"""Drivers of roads that the page shows, and the headings of their columns."""


def collect(results: Path) -> None:
    """Take over tables, settings and provenance of every run that lies in a directory
    of results.
    """
    for name in TABLES:
        kept = _texts(KEPT / f"{name}.csv")
        parts = []
        for run in RUNS:
            file = results / run / f"{name}.csv"
            parts.append(
                _texts(file).assign(run=run)
                if file.is_file()
                else kept[kept["run"] == run]
            )
        table = pd.concat(parts)
        table[["run", *table.columns.drop("run")]].to_csv(
            KEPT / f"{name}.csv", index=False
        )
    settings = json.loads((KEPT / "settings.json").read_text())
    for run in RUNS:
        for name in ("settings", "provenance"):
            if (results / run / f"{name}.json").is_file():
                settings.setdefault(run, {})[name] = json.loads(
                    (results / run / f"{name}.json").read_text()
                )
    ordered = {run: settings[run] for run in RUNS if run in settings}
    (KEPT / "settings.json").write_text(json.dumps(ordered, indent=1) + "\n")
    for name in ROADS:
        roads: dict[str, dict[str, dict]] = {}
        for part in sorted((results / name).glob("*.json")):
            for scene, drivers in json.loads(part.read_text()).items():
                roads.setdefault(scene, {}).update(drivers)
        if roads:
            (KEPT / f"{name}.json").write_text(
                json.dumps(in_order(roads), indent=2) + "\n"
            )
    recorded = json.loads((KEPT / f"{RECORDED}.json").read_text())
    for file in sorted((results / RECORDED).glob("*.json")):
        recorded.setdefault(file.stem, {}).update(
            json.loads(file.read_text())[RECORDED]
        )  # keeps retired drivers
    (KEPT / f"{RECORDED}.json").write_text(json.dumps(recorded, indent=2) + "\n")


def comparison(run: str) -> Results:
    """A kept comparison, without its records."""
    made = json.loads((KEPT / "settings.json").read_text())[run]
    return Results(
        pd.DataFrame(), kept_table("summary", run), made["settings"], made["provenance"]
    )


def kept_table(name: str, run: str) -> pd.DataFrame:
    """A run's rows of a kept table."""
    table = pd.read_csv(KEPT / f"{name}.csv")
    own = table[table["run"] == run].drop(columns="run").reset_index(drop=True)
    return own.drop(
        columns=[
            name for name in own if name.startswith("share_") and own[name].isna().all()
        ]
    )


def tables() -> dict[str, str]:
    """The tables of the pages in Markdown, by the name that stands in the comment above
    each.
    """
    physical = overview(physical="")
    limits = overview(
        limit_50=", 0.2 and 50 control limit",
        limit_9=", 0.2 and 9 control limit",
        limit_6=", 0.1 and 6 control limit",
    )
    shown_tables = {
        "physical": rows_of(physical, PHYSICAL, SHOWN_COLUMNS),
        "semantics": brief(
            overview(compare=", paper semantics", released=", released semantics")
        ),
        "worth": rows_of(
            overview(worth=""), WORTH, [REWARD, "reward less T", "plan ms"]
        ),
        "several": pd.concat(
            [overview(**{run: ""})[SEVERAL_COLUMNS] for run in CROWDS]
        ),
        "limits": rows_of(
            limits, LIMITED, [name for name in limits if "collision" in name]
        ),
        "regrets": regret_cells(kept_table("regrets", "frontier")),
        "road": outcomes(
            kept_roads(), OUTCOMES + "{reward_per_step:.3f}", ROAD_DRIVERS
        ),
        "recorded": outcomes(
            kept_figures(RECORDED), OUTCOMES + "{p50_ms:.0f} ms", RECORDED_DRIVERS
        ),
    }
    return {name: markdown(table) for name, table in shown_tables.items()}


def rows_of(
    table: pd.DataFrame, shown: dict[str, list[str]], columns: list[str]
) -> pd.DataFrame:
    """The rows of some scenarios and controllers, with some columns."""
    chosen = [(scenario, name) for scenario, names in shown.items() for name in names]
    return (
        table.set_index(["scenario", "controller"]).loc[chosen, columns].reset_index()
    )


def overview(**names: str) -> pd.DataFrame:
    """Texts, a row per scenario and controller: outcomes of every named run beside each
    other, times of the first.
    """
    several = {name: comparison(run) for run, name in names.items()}
    found = {
        (name, scenario, texts["controller"]): texts
        for name, results in several.items()
        for scenario in results.scenarios
        for texts in results_table(results, scenario).to_dict("records")
    }
    rows = []
    for key in dict.fromkeys(
        (scenario, controller) for _, scenario, controller in found
    ):
        row = dict(zip(("scenario", "controller"), key, strict=True))
        own = [found.get((name, *key), {}) for name in several]
        for name, texts in zip(several, own, strict=True):
            reward = (
                f"{texts['reward/step']} ({texts['90 % interval']})" if texts else ""
            )
            row[f"reward per step (90 % interval){name}"] = reward
            row[f"episodes with a collision{name}"] = texts.get("collisions", "")
        more = {
            heading: text
            for texts in reversed(own)
            for heading, text in texts.items()
            if "published" in heading
        }
        row |= {
            heading: text
            for heading, text in (own[0] | more).items()
            if heading not in OUTCOME
        }
        rows.append(row)
    return table_of(rows)


def brief(table: pd.DataFrame) -> pd.DataFrame:
    """A table without the columns that need an explanation."""
    return table.drop(columns=["counted ms", "published ms"], errors="ignore")


def markdown(table: pd.DataFrame) -> str:
    """A table of texts in Markdown."""
    lines = [list(table), ["---"] * table.shape[1], *table.to_numpy().tolist()]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def regret_cells(behind: pd.DataFrame) -> pd.DataFrame:
    """Texts, a row per scenario and price: what the best orders earn, and how far
    others stay behind them.
    """
    rows = []
    for (scenario, price), own in behind.groupby(["scenario", "price"], sort=False):
        own = own.set_index("controller")
        regret = own["regret"].map("{:.2f}".format)
        rows.append(
            {"scenario": scenario, "price": f"{price:g}"}
            | {"best found": f"{own.loc[BEST_PER_START, 'meta_reward']:.2f}"}
            | {model: regret.get(model, "") for model in ("naive", "turn", "tom")}
            | {
                "best order for all starts": regret[
                    own.loc[own["kind"].isin(fixed_order_types()), "regret"].idxmin()
                ]
            }
            | {
                f"{kind}, best lambda": (
                    f"{regret[best]} ({best.removeprefix(f'{kind}:')})"
                )
                for kind in ("switching", "horizon")
                for best in [own.loc[own["kind"] == kind, "regret"].idxmin()]
            }
            | {"learned": regret[f"learned:{price:g}"]}
        )
    return pd.DataFrame(rows)


def in_order(roads: dict[str, dict[str, dict]]) -> dict[str, dict[str, dict]]:
    """Figures of roads in the command's own order of scenes and drivers, other drivers
    last.
    """
    order = {driver: place for place, driver in enumerate(DEFAULT_DRIVERS)}
    return {
        scene: dict(
            sorted(roads[scene].items(), key=lambda one: order.get(one[0], len(order)))
        )
        for scene in SCENES + OTHER_SCENES
        if scene in roads
    }


def kept_figures(name: str) -> dict[str, dict[str, dict]]:
    """Kept figures by scene and driver."""
    return json.loads((KEPT / f"{name}.json").read_text())


def kept_roads() -> dict[str, dict[str, dict]]:
    """Figures of stock scenes, and of those among commuters."""
    commuters = kept_figures("road_commuters")
    return kept_figures("road") | {
        f"{scene} among commuters": drivers for scene, drivers in commuters.items()
    }


def outcomes(
    scenes: dict[str, dict[str, dict]], form: str, shown: dict[str, str]
) -> pd.DataFrame:
    """Texts, a row per scene, a column per driver."""
    return table_of(
        {"scene": scene.replace("_", ", ")}
        | {
            heading: form.format(**drivers[name])
            for driver, heading in shown.items()
            if (name := driver.replace("SCENE", scene)) in drivers
        }
        for scene, drivers in scenes.items()
    )


def table_of(rows: Iterable[dict[str, str]]) -> pd.DataFrame:
    """A table of rows of texts, which may lack some; names stand first."""
    return pd.DataFrame(list(rows)).fillna("")


def rewrite(page: Path, texts: dict[str, str]) -> None:
    """Put each table below the comment with its name."""
    for name, text in texts.items():
        old = re.compile(rf"(<!-- table: {name} -->\n)(?:\|.*\n)*")
        page.write_text(
            old.sub(lambda match, text=text: f"{match[1]}{text}\n", page.read_text())
        )


def _texts(file: Path) -> pd.DataFrame:
    """A table whose numbers stay as they are written."""
    return pd.read_csv(file, dtype=str, keep_default_na=False)


if __name__ == "__main__":
    collect(Path("results"))
    for page in PAGES:
        rewrite(page, tables())
