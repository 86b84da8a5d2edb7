"""Show films that commands have made."""

from collections.abc import Sequence
from pathlib import Path

from PIL import Image

from ms_highway.runtime.files import reading
from ms_highway.visualization.section import Section


def films_section(paths: Sequence[Path]) -> Section:
    """Return the section of films.

    Args:
        paths: of GIFs.

    Raises:
        ValueError: if one cannot be read.
    """
    for path in paths:
        with reading(path, "film it again", " as a GIF"), Image.open(path) as film:
            film.verify()
    shown = {path.stem: (path, path.stem) for path in paths}
    return Section("Films", "How does it look?", f"See {len(paths)}, at true speed.", [], shown)
