"""The pages that a reader meets first, and what they contain."""

import subprocess
from pathlib import Path

from markdown_it import MarkdownIt

ROOT = Path(__file__).parents[2]
README = ROOT / "README.md"
RESULTS = ROOT / "notebooks" / "results" / "README.md"
MAP = ROOT / "notebooks" / "MAP.md"


def fences(page: Path, language: str) -> list[str]:
    """The blocks of code in a language."""
    tokens = MarkdownIt().parse(page.read_text())
    return [token.content for token in tokens if token.type == "fence" and token.info == language]


def commands(page: Path) -> list[str]:
    """The lines of a page's shell code that call ``ms-highway``, without what only a shell's loop knows."""
    return [command for text in fences(page, "sh") for command in called(text) if "$" not in command]


def called(text: str) -> list[str]:
    """The lines that call ``ms-highway``."""
    lines = [line.strip() for line in text.replace("\\\n", " ").splitlines()]
    return [line for line in lines if line.startswith("ms-highway ")]


def words(command: str) -> list[str]:
    """The words of a command after its name, expanded as bash does."""
    line = command.partition(" > ")[0]
    told = subprocess.run(["bash", "-c", f"printf '%s\\n' {line}"], capture_output=True, text=True, check=True).stdout
    return told.splitlines()[1:]
