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
        ValueError: if one cannot be read, or does not move.
    """
    for path in paths:
        with reading(path, "film it again, to a .gif", " as a film"), Image.open(path, formats=["GIF"]) as film:
            if not getattr(film, "is_animated", False):
                raise ValueError("it has one picture only")
            film.seek(1)
    shown = {str(path): (path, f"{path}") for path in paths}
    return Section("Films", "How does it look?", f"See {', '.join(path.stem for path in paths)}, below.", [], shown)
