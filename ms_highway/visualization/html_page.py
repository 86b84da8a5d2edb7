"""Make one page that shows a comparison, in one file that needs no other; and its
tables in LaTeX.
"""

import base64
from typing import Any

import pandas as pd
from jinja2 import Environment, PackageLoader, StrictUndefined

from ms_highway.envs.colors import model_meaning
from ms_highway.experiments.comparison import common_seeds, models_of
from ms_highway.experiments.summary import Results, answer, most_informative_pair
from ms_highway.game.scenario import title
from ms_highway.runtime.process import Progress, silent
from ms_highway.visualization import video
from ms_highway.visualization.figures import CAPTIONS, episode_count, figures
from ms_highway.visualization.style import drawn
from ms_highway.visualization.tables import cells, latex

UNSEEN = ("asked", "lengths")  # settings that say nothing about how results were made


def page(
    results: Results,
    videos: bool = True,
    progress: Progress = silent,
    own: bool = False,
) -> str:
    """Return the page of a comparison, as HTML: a section for each scenario, and the
    settings of the results.

    Args:
        results: of the comparison.
        videos: whether films are made.
        progress: called with a message before each scenario.
        own: whether films show controllers that run code from elsewhere, such as files
            of agents.

    Raises:
        ImportError: for videos without the packages of the extra ``video``.
        ValueError: if episodes cannot be run again under the settings of the results.
    """
    sections = []
    summaries = results.summaries
    for scenario in results.scenarios:
        progress(f"drawing {scenario}{' and filming it' if videos else ''}")
        contents = drawn(figures(results.records, summaries, scenario))
        pictures = {
            name: (_data("image/png", content), CAPTIONS[name])
            for name, content in contents.items()
        }
        sections.append(
            {
                "title": title(scenario),
                "answer": answer(results.records, summaries, scenario),
                "table": results_table(results, scenario).to_dict("split"),
                "figures": pictures,
                "film": _film(results, scenario, own) if videos else None,
            }
        )
    used = [
        name
        for name in models_of(summaries, "share")
        if summaries[f"share_{name}"].any()
    ]
    environment = Environment(
        loader=PackageLoader("ms_highway", "data"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
    )
    environment.filters["text"] = _text
    return environment.get_template("report.html.jinja").render(
        sections=sections,
        models={name: model_meaning(name) or "a model that was added" for name in used},
        settings={
            name: value
            for name, value in results.settings.items()
            if name not in UNSEEN and value != {}
        },
        runs=results.runs,
        missing=results.missing,
    )


def results_table(results: Results, scenario: str) -> pd.DataFrame:
    """Return the texts of `cells`, with columns for the paper's figures if they may be
    compared.
    """
    texts = cells(results.summaries, scenario)
    published = [
        results.published(scenario, controller) for controller in texts["controller"]
    ]
    if any(published):
        texts["published"] = [f"{one[0]:.2f}" if one else "" for one in published]
        texts["published ms"] = [
            f"{1e3 * one[1]:.0f}" if one else "" for one in published
        ]
    return texts


def latex_tables(results: Results) -> str:
    """Return the table of each scenario of a comparison as LaTeX, with a caption and a
    label ``tab:SCENARIO``.
    """
    tables = [r"% needs \usepackage{booktabs}"]
    for scenario in results.scenarios:
        rows = results.summaries.query("scenario == @scenario")
        caption = (
            f"{title(scenario)}: means per step, with 90 % intervals over episodes;"
            f" {episode_count(rows)}."
        )
        tables.append(
            latex(results_table(results, scenario), caption, f"tab:{scenario}")
        )
    return "\n".join(tables)


def _film(results: Results, scenario: str, own: bool) -> dict | None:
    """Film the most informative controllers from the first start that they share; sizes
    are in px.

    None if no controller may be filmed.
    """
    controllers = most_informative_pair(results.summaries, scenario, own)
    if not controllers:
        return None
    results.refuse_changed(scenario, controllers)
    seed = next(iter(common_seeds(results.records, scenario, controllers)), 0)
    films = video.film_together(scenario, controllers, seed, **results.config(scenario))
    pictures = video.side_by_side(films)
    height, width, _ = pictures[0].shape
    places = " above, ".join(controllers) + " below" * (len(controllers) > 1)
    return {
        "source": _data(
            "video/mp4", video.encoded(pictures, ".mp4", films[0].frames_per_second)
        ),
        "width": width,
        "height": height,
        "caption": (
            f"Episode {seed}, at true speed: {places}. Times are as measured while"
            " filming; other episodes differ."
        ),
    }


def _data(kind: str, file: bytes) -> str:
    return f"data:{kind};base64,{base64.b64encode(file).decode()}"


def _text(value: Any) -> str:
    """Return a value as text, a mapping part by part."""
    if isinstance(value, dict):
        return ", ".join(f"{name} {_text(part)}" for name, part in value.items())
    return f"{value:.4g}" if isinstance(value, float) else str(value)
