"""One page that shows all of a comparison, in one file that needs nothing else."""

import base64
import io
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import pandas as pd
from jinja2 import Environment, PackageLoader, StrictUndefined
from matplotlib.figure import Figure
from PIL import Image

from ms_highway import report, video
from ms_highway.envs.graphics import MODEL_MEANINGS
from ms_highway.experiment import paper_controllers
from ms_highway.figures import CAPTIONS, figures
from ms_highway.human_models import MODELS
from ms_highway.results import Results
from ms_highway.side_by_side import side_by_side
from ms_highway.story import common_seeds

__all__ = ["Section", "Shown", "draw", "render", "worth_seeing"]

DPI = 160
POSTER = 0.4  # of the video, from which the picture is taken that stands for it
SEMANTICS = {
    "paper": "the paper's dynamics and a damped theory of mind",
    "released": "the dynamics and the theory of mind of the paper's released code",
}


@dataclass(frozen=True)
class Shown:
    """A picture or video: its content as a data URI, its caption, and for a video the poster's data URI."""

    source: str
    caption: str
    poster: str = ""


@dataclass(frozen=True)
class Section:
    """One scenario's part of the page: texts of the table, figures by name, and videos."""

    scenario: str
    cells: pd.DataFrame
    figures: dict[str, Shown]
    videos: list[Shown]


def worth_seeing(summaries: pd.DataFrame, scenario: str) -> list[str]:
    """The two controllers of a scenario that say most beside each other.

    The fixed model of the highest mean reward, and switching, at the paper's conservative lambda or else at the
    smallest; where either is missing, the first two; the only one where there is one.
    """
    rows = summaries[summaries["scenario"] == scenario].set_index("controller")
    fixed, switching = (rows[rows["kind"] == kind] for kind in ("fixed", "switching"))
    if fixed.empty or switching.empty:
        return list(rows.index[:2])
    usual = paper_controllers(scenario)[-1]
    return [str(fixed["reward"].idxmax()), usual if usual in switching.index else str(switching["price"].idxmin())]


def draw(results: Results, videos: bool = True) -> Iterator[str | list[Section]]:
    """Everything that takes time to draw; yields what it is doing, then a section per scenario.

    Raises:
        ImportError: for videos without the packages of the extra ``video``.
        ValueError: if episodes cannot be run again under the settings of the results.
    """
    sections = []
    for scenario in results.scenarios:
        yield f"drawing {scenario}"
        drawn = figures(results.records, results.summaries, scenario)
        shown = {name: Shown(_png(figure), CAPTIONS.get(name, name)) for name, figure in drawn.items()}
        films = []
        if videos:
            yield f"filming {scenario}"
            films.append(_film(results, scenario))
        sections.append(Section(scenario, _cells(results, scenario), shown, films))
    yield sections


def render(results: Results, sections: list[Section]) -> str:
    """The page, as HTML."""
    shares = results.summaries.filter(like="share_").max()
    shown = set(shares[shares > 0].index)
    environment = Environment(
        loader=PackageLoader("ms_highway", "data"), autoescape=True, undefined=StrictUndefined, trim_blocks=True
    )
    return environment.get_template("report.html.jinja").render(
        sections=sections,
        episodes=sorted(set(results.summaries["episodes"])),
        models={name: MODEL_MEANINGS.get(name, "a model of one's own") for name in MODELS if f"share_{name}" in shown},
        kinds=set(results.summaries["kind"]),
        semantics=SEMANTICS.get(results.settings["semantics"], results.settings["semantics"]),
        settings={name: _text(value) for name, value in results.settings.items() if name != "asked" and value != {}},
        missing=results.missing,
        runs=[{**run, **{key: _text(run[key]) for key in ("versions", "machine")}} for run in results.runs],
    )


def _cells(results: Results, scenario: str) -> pd.DataFrame:
    """The table's texts with what the paper published beside ours, where it did."""
    cells = report.cells(results.summaries, scenario)
    published = [results.published(scenario, name) for name in cells["controller"]]
    if any(published):
        rewards = [f"{numbers.reward:.2f}" if numbers else "" for numbers in published]
        times = [f"{1e3 * numbers.seconds:.0f}" if numbers else "" for numbers in published]
        cells.insert(list(cells).index("90 % interval") + 1, "published reward", rewards)
        cells.insert(list(cells).index("decide ms") + 1, "published ms", times)
    return cells


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
    return Shown(_data("video/mp4", content), caption, _data("image/png", picture.getvalue()))


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
