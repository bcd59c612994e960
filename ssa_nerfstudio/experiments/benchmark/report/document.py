"""Tables, text and pictures as Markdown and as one HTML page."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from ssa_nerfstudio.data.writing import write_text
from ssa_nerfstudio.workflow.html_page import render_page

_TEMPLATES = Path(__file__).parents[2] / "templates"


@dataclass
class Table:
    """A table; cells are texts in which **bold** and `code` are marked as in Markdown."""

    title: str
    headings: list[str]
    rows: list[list[str]]
    note: str = ""


@dataclass
class Picture:
    """A picture beside the document."""

    path: Path
    caption: str


@dataclass
class Section:
    """A heading, text, and what follows."""

    title: str
    text: list[str] = field(default_factory=list)
    contents: list[Table | Picture] = field(default_factory=list)


@dataclass
class Document:
    """A report."""

    title: str
    sections: list[Section]

    def write(self, folder: Path, name: str) -> list[Path]:
        """Writes NAME.md and NAME.html, pictures linked in the one and embedded in the other; the two files."""
        folder.mkdir(parents=True, exist_ok=True)
        paths = [folder / f"{name}.md", folder / f"{name}.html"]
        for path in paths:
            text = render_page(
                _TEMPLATES / f"benchmark{path.suffix}", self.title, sections=self.sections, folder=folder
            )
            write_text(path, text)
        return paths
