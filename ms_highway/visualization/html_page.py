"""Draw one page that shows all of a comparison, in one file that needs nothing else."""

import base64
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import pandas as pd
from jinja2 import Environment, PackageLoader, StrictUndefined
from matplotlib.figure import Figure
from PIL import Image

from ms_highway.envs.graphics import model_meaning
from ms_highway.experiments.analysis.findings import answer, in_order
from ms_highway.experiments.analysis.selection import Selection
from ms_highway.experiments.records import models_of, share_column
from ms_highway.experiments.results import Results
from ms_highway.experiments.safety import Safety, safety_cells, safety_sentences
from ms_highway.game.scenario import title
from ms_highway.runtime.progress import Progress, silent
from ms_highway.visualization import video
from ms_highway.visualization.figures import CAPTIONS, figures
from ms_highway.visualization.overview import overview
from ms_highway.visualization.side_by_side import side_by_side

__all__ = ["Section", "Shown", "draw", "render"]

DPI = 160
POSTER = 0.4  # of the video, from which the picture is taken that stands for it
SEMANTICS = {
    "paper": "the paper's dynamics and a damped theory of mind",
    "released": "the dynamics and the theory of mind of the paper's released code",
}


@dataclass(frozen=True)
class Shown:
    """A picture or video: its content as a data URI, and its caption; of a video, its poster and its size [px]."""

    source: str
    caption: str
    poster: str = ""
    size: tuple[int, int] = (1, 1)


@dataclass(frozen=True)
class Section:
    """One scenario's part of the page.

    Attributes:
        scenario: its name.
        answer: what was found, see `ms_highway.experiments.analysis.findings.answer`.
        rows: texts of the `overview`, from the controller on, of few controllers.
        others: those of the other controllers.
        figures: by name.
        videos: what was filmed.
    """

    scenario: str
    answer: str
    rows: list[list[str]]
    others: list[list[str]]
    figures: dict[str, Shown]
    videos: list[Shown]

    @property
    def title(self) -> str:
        """What people call the scenario."""
        return title(self.scenario)

    @property
    def group(self) -> tuple[str, list[list[str]]]:
        """The rows under their title."""
        return self.title, self.rows


def draw(
    several: Sequence[Results],
    selections: Mapping[str, Selection],
    videos: bool = True,
    progress: Progress = silent,
) -> list[Section]:
    """Draw figures and films; return a section per scenario.

    A section draws the first of the comparisons that has its scenario; the tables have all beside each other.

    Args:
        several: comparisons.
        selections: what to show of each scenario, by its name, see `ms_highway.experiments.analysis.selection`.
        videos: whether films are made.
        progress: called with a message before everything that takes time.

    Raises:
        ImportError: for videos without the packages of the extra ``video``.
        ValueError: if two comparisons are the same, or episodes cannot be run again under the settings of the results.
    """
    table, sections = overview(several), []
    for scenario in in_order(selections):
        progress(f"drawing {scenario}")
        results, selection = next(one for one in several if scenario in one.scenarios), selections[scenario]
        drawn = figures(results.records, results.summaries, scenario, selection)
        shown = {name: Shown(_png(figure), CAPTIONS.get(name, name)) for name, figure in drawn.items()}
        films = []
        if videos:
            progress(f"filming {scenario}")
            films.append(_film(results, scenario, selection))
        own = table[table["scenario"] == scenario].drop(columns="scenario")
        chosen = own["controller"].isin(selection.main)
        rows, others = (part.to_numpy().tolist() for part in (own[chosen], own[~chosen]))
        text = answer(results.records, results.summaries, scenario)
        sections.append(Section(scenario, text, rows, others, shown, films))
    return sections


def render(several: Sequence[Results], sections: list[Section], safeties: Sequence[Safety] = ()) -> str:
    """Return the page, as HTML, of what `draw` has drawn of the same comparisons, and of collision counts."""
    summaries = pd.concat([one.summaries for one in several])
    used = [name for name in models_of(summaries, share_column) if (summaries[share_column(name)] > 0).any()]
    environment = Environment(
        loader=PackageLoader("ms_highway", "data"), autoescape=True, undefined=StrictUndefined, trim_blocks=True
    )
    return environment.get_template("report.html.jinja").render(
        sections=sections,
        headings=list(overview(several)),
        safeties=[_counted(safety, number) for number, safety in enumerate(safeties, 1)],
        episodes=sorted(set(summaries["episodes"])),
        models={name: model_meaning(name) or "a model that was added" for name in used},
        kinds=set(summaries["kind"]),
        semantics={
            name: SEMANTICS[name] for name in SEMANTICS if name in [one.settings["semantics"] for one in several]
        },
        made=[*map(_made, several), *map(_made, safeties)],
        missing=sum(one.missing for one in several),
    )


def _counted(safety: Safety, number: int) -> dict[str, Any]:
    """Return collision counts as the template takes them: sentences, and the texts of the table by scenario."""
    cells = safety_cells(safety)
    order = cells.groupby("scenario", sort=False)
    groups = {title(name): order.get_group(name).iloc[:, 1:].to_numpy().tolist() for name in in_order(order.groups)}
    text = " ".join(safety_sentences(safety))
    heading = {"id": f"safety-{number}", "title": "Safety" if number == 1 else f"Safety, {safety.directory}"}
    return {**heading, "text": text, "headings": list(cells), "groups": groups}


def _made(results: Results | Safety) -> dict[str, Any]:
    """Return what made some results, in texts."""
    settings = {name: _text(value) for name, value in results.settings.items() if name != "asked" and value != {}}
    runs = [{**run, **{key: _text(run[key]) for key in ("versions", "machine")}} for run in results.runs]
    return {"directory": str(results.directory), "settings": settings, "runs": runs}


def _film(results: Results, scenario: str, selection: Selection) -> Shown:
    """Film an episode of the selected controllers from the same start."""
    controllers, seed = selection.filmed, selection.film_seed
    films = [video.film(scenario, name, seed, **results.config(scenario)) for name in controllers]
    pictures = side_by_side(films)
    content = video.encoded(pictures, ".mp4", films[0].frames_per_second)
    picture = io.BytesIO()
    Image.fromarray(pictures[int(POSTER * len(pictures))]).save(picture, "PNG", optimize=True)
    places = " above, ".join(controllers) + (" below" if len(controllers) > 1 else "")
    caption = f"Episode {seed}, at true speed: {places}. Times are as measured while filming; other episodes differ."
    height, width, _ = pictures[0].shape
    return Shown(_data("video/mp4", content), caption, _data("image/png", picture.getvalue()), (width, height))


def _png(figure: Figure) -> str:
    content = io.BytesIO()
    figure.savefig(content, format="png", dpi=DPI)
    return _data("image/png", content.getvalue())


def _data(kind: str, content: bytes) -> str:
    return f"data:{kind};base64,{base64.b64encode(content).decode()}"


def _text(value: Any) -> str:
    """Return a value as text; of a mapping, its parts."""
    if isinstance(value, dict):
        return ", ".join(f"{name} {_text(part)}" for name, part in value.items())
    return f"{value:.4g}" if isinstance(value, float) else str(value)
