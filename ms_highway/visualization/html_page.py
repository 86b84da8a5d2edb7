"""Draw one page that shows results of all kinds, in one file that needs nothing else."""

import base64
import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import pandas as pd
from jinja2 import Environment, PackageLoader, StrictUndefined
from matplotlib.figure import Figure
from PIL import Image

from ms_highway.envs.graphics import model_meaning
from ms_highway.experiments.analysis.findings import answer, in_order
from ms_highway.experiments.analysis.selection import Selection, select_of_several
from ms_highway.experiments.directory import Made
from ms_highway.experiments.records import models_of, share_column
from ms_highway.experiments.results import Results
from ms_highway.game.scenario import title
from ms_highway.metareasoning.rule import PUBLISHED_COSTS, SHIPPED_COSTS
from ms_highway.planning.human_models import PAPER_MODELS
from ms_highway.runtime.progress import Progress, silent
from ms_highway.visualization import video
from ms_highway.visualization.figures import CAPTIONS, figures
from ms_highway.visualization.overview import overview
from ms_highway.visualization.section import Section
from ms_highway.visualization.video import side_by_side

DPI = 160
COLORS = 256  # of a figure
POSTER = 0.4  # of the video, from which the picture is taken that stands for it
SEMANTICS = {
    "paper": "the paper's dynamics and a damped theory of mind",
    "released": "the dynamics and the theory of mind of the paper's released code",
}


class Shown(NamedTuple):
    """A picture or video: its content as a data URI, and its caption; of a video, its poster and its size [px]."""

    source: str
    caption: str
    poster: str = ""
    size: tuple[int, int] = (1, 1)


def page(
    several: Sequence[Results], further: Sequence[Section], videos: bool = True, progress: Progress = silent
) -> str:
    """Return the page, as HTML: a section for each scenario, of the first comparison that has it, and further ones.

    Args:
        several: comparisons, which the tables have beside each other.
        further: sections of other results.
        videos: whether films are made.
        progress: called with a message before everything that takes time.

    Raises:
        ImportError: for videos without the packages of the extra ``video``.
        ValueError: if two comparisons are the same, or episodes cannot be run again under the settings of the results.
    """
    table = overview(several, explained=True) if several else pd.DataFrame()
    sections, selections = [], select_of_several(several)
    for scenario in in_order(selections):
        progress(f"drawing {scenario}" + " and filming it" * videos)
        selection, results = selections[scenario], next(one for one in several if scenario in one.scenarios)
        drawn = figures(results.records, results.summaries, scenario, selection)
        own = table.query("scenario == @scenario").drop(columns="scenario")
        main = own["controller"].isin(selection.main)
        sections.append(
            {
                "name": scenario,
                "title": title(scenario),
                "answer": answer(results.records, results.summaries, scenario),
                "rows": own[main].to_numpy().tolist(),
                "others": own[~main].to_numpy().tolist(),
                "figures": {name: _picture(figure, CAPTIONS[name]) for name, figure in drawn.items()},
                "videos": [_film(results, scenario, selection)] if videos else [],
            }
        )
    parts = [one.summaries for one in several] or [pd.DataFrame(columns=["episodes", "kind"])]
    summaries = pd.concat(parts)
    used = [name for name in models_of(summaries, share_column) if (summaries[share_column(name)] > 0).any()]
    semantics = [one.settings["semantics"] for one in several]
    environment = Environment(
        loader=PackageLoader("ms_highway", "data"), autoescape=True, undefined=StrictUndefined, trim_blocks=True
    )
    return environment.get_template("report.html.jinja").render(
        sections=sections,
        headings=list(table),
        episodes=sorted(set(summaries["episodes"])),
        models={name: model_meaning(name) or "a model that was added" for name in used},
        kinds=set(summaries["kind"]),
        semantics={name: meaning for name, meaning in SEMANTICS.items() if name in semantics},
        further=list(map(_section, further)),
        made=list(map(_made, [*(one.made for one in several), *(one.made for one in further if one.made)])),
        costs=[_milliseconds(costs) for costs in (PUBLISHED_COSTS, SHIPPED_COSTS)],
        missing=sum(one.missing for one in several),
    )


def _section(section: Section) -> dict[str, Any]:
    """Return a further section as the template takes it."""
    texts = [
        {
            "title": table.title,
            "headings": [column.header for column in table.columns],
            "rows": list(zip(*(column.cells for column in table.columns), strict=True)),
        }
        for table in section.tables
    ]
    return section._asdict() | {
        "tables": texts,
        "figures": {name: _picture(*one) for name, one in section.figures.items()},
    }


def _milliseconds(costs: Mapping[str, float]) -> str:
    """Return times of the paper's models [s] as text in milliseconds."""
    *most, last = (f"{1e3 * costs[name]:g}" for name in PAPER_MODELS)
    return f"{', '.join(most)} and {last}"


def _made(made: Made) -> dict[str, Any]:
    """Return what made some results, in texts."""
    texts = {name: _text(value) for name, value in made.settings.items() if name != "asked" and value != {}}
    runs = [{**run, **{key: _text(run[key]) for key in ("versions", "machine")}} for run in made.runs]
    return {"directory": str(made.directory), "settings": texts, "runs": runs}


def _film(results: Results, scenario: str, selection: Selection) -> Shown:
    """Film an episode of the selected controllers from the same start."""
    controllers, seed, picture = selection.filmed, selection.film_seed, io.BytesIO()
    films = [video.film(scenario, name, seed, **results.config(scenario)) for name in controllers]
    pictures = side_by_side(films)
    content = video.encoded(pictures, ".mp4", films[0].frames_per_second)
    Image.fromarray(pictures[int(POSTER * len(pictures))]).save(picture, "PNG", optimize=True)
    places = " above, ".join(controllers) + (" below" if len(controllers) > 1 else "")
    caption = f"Episode {seed}, at true speed: {places}. Times are as measured while filming; other episodes differ."
    height, width, _ = pictures[0].shape
    return Shown(_data("video/mp4", content), caption, _data("image/png", picture.getvalue()), (width, height))


def _picture(figure: Figure | Path, caption: str) -> Shown:
    if isinstance(figure, Path):
        return Shown(_data("image/gif", figure.read_bytes()), caption)
    drawn, content = io.BytesIO(), io.BytesIO()
    figure.savefig(drawn, format="png", dpi=DPI)
    colors = Image.open(drawn).convert("RGB").quantize(COLORS, dither=Image.Dither.NONE)  # a third of the size
    colors.save(content, "PNG", optimize=True)
    return Shown(_data("image/png", content.getvalue()), caption)


def _data(kind: str, content: bytes) -> str:
    return f"data:{kind};base64,{base64.b64encode(content).decode()}"


def _text(value: Any) -> str:
    """Return a value as text; of a mapping, its parts."""
    if isinstance(value, dict):
        return ", ".join(f"{name} {_text(part)}" for name, part in value.items())
    return f"{value:.4g}" if isinstance(value, float) else str(value)
