"""One page that shows all of a comparison, in one file that needs nothing else."""

import base64
import io
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from matplotlib.figure import Figure
from PIL import Image

from ms_highway.envs.graphics import MODEL_MEANINGS
from ms_highway.experiments.findings import answer, in_order, worth_seeing
from ms_highway.experiments.records import common_seeds, share_column
from ms_highway.experiments.results import Results
from ms_highway.experiments.safety import Safety, safety_cells, safety_told
from ms_highway.game.scenario import title
from ms_highway.planning.human_models import MODELS
from ms_highway.visualization import video
from ms_highway.visualization.figures import CAPTIONS, few, figures
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
        answer: what was found, see `ms_highway.experiments.findings.answer`.
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


def draw(several: Sequence[Results], videos: bool = True) -> Iterator[str | list[Section]]:
    """Everything that takes time to draw; yields what it is doing, then a section per scenario.

    Args:
        several: comparisons, of which the first one is shown, and the others beside it in tables.
        videos: whether films are made.

    Raises:
        ImportError: for videos without the packages of the extra ``video``.
        ValueError: if two comparisons are the same, or episodes cannot be run again under the settings of the results.
    """
    results, table, sections = several[0], overview(several), []
    for scenario in in_order(results.scenarios):
        yield f"drawing {scenario}"
        drawn = figures(results.records, results.summaries, scenario)
        shown = {name: Shown(_png(figure), CAPTIONS.get(name, name)) for name, figure in drawn.items()}
        films = []
        if videos:
            yield f"filming {scenario}"
            films.append(_film(results, scenario))
        own = table[table["scenario"] == scenario].drop(columns="scenario")
        chosen = own["controller"].isin(few(results.summaries, scenario)["controller"])
        rows, others = (part.to_numpy().tolist() for part in (own[chosen], own[~chosen]))
        told = answer(results.records, results.summaries, scenario)
        sections.append(Section(scenario, told, rows, others, shown, films))
    yield sections


def render(several: Sequence[Results], sections: list[Section], safeties: Sequence[Safety] = ()) -> str:
    """The page, as HTML, of what `draw` has drawn of the same comparisons, and of collisions that were counted."""
    results = several[0]
    shares = {name: results.summaries.get(share_column(name)) for name in MODELS}
    used = [name for name, share in shares.items() if share is not None and share.max() > 0]
    environment = Environment(
        loader=PackageLoader("ms_highway", "data"), autoescape=True, undefined=StrictUndefined, trim_blocks=True
    )
    return environment.get_template("report.html.jinja").render(
        sections=sections,
        headings=list(overview(several)),
        safeties=[_counted(safety) for safety in safeties],
        episodes=sorted(set(results.summaries["episodes"])),
        models={name: MODEL_MEANINGS.get(name, "a model of one's own") for name in used},
        kinds=set(results.summaries["kind"]),
        semantics={
            name: SEMANTICS[name] for name in SEMANTICS if name in [one.settings["semantics"] for one in several]
        },
        made=[*map(_made, several), *map(_made, safeties)],
        missing=sum(one.missing for one in several),
    )


def _counted(safety: Safety) -> dict[str, Any]:
    """Collisions that were counted: what they say, and the texts of the table by the scenario's title."""
    cells = safety_cells(safety)
    order = cells.groupby("scenario", sort=False)
    groups = {title(name): order.get_group(name).iloc[:, 1:].to_numpy().tolist() for name in in_order(order.groups)}
    return {"told": " ".join(safety_told(safety)), "headings": list(cells), "groups": groups}


def _made(results: Results | Safety) -> dict[str, Any]:
    """What made some results, in texts."""
    settings = {name: _text(value) for name, value in results.settings.items() if name != "asked" and value != {}}
    runs = [{**run, **{key: _text(run[key]) for key in ("versions", "machine")}} for run in results.runs]
    return {"directory": str(results.directory), "settings": settings, "runs": runs}


def _film(results: Results, scenario: str) -> Shown:
    """The first episode of the controllers that are worth seeing, from the same start."""
    controllers = worth_seeing(results.summaries, scenario)
    seed = int(next(iter(common_seeds(results.records, scenario, controllers)), 0))
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
    """A value as people read it; of a mapping, its parts."""
    if isinstance(value, dict):
        return ", ".join(f"{name} {_text(part)}" for name, part in value.items())
    return f"{value:.4g}" if isinstance(value, float) else str(value)
