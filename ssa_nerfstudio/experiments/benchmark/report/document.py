"""Tables, text and pictures as Markdown and as one HTML page."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from ssa_nerfstudio.experiments.html_page import render_page


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
        markdown, page = folder / f"{name}.md", folder / f"{name}.html"
        markdown.write_text(self.markdown(folder), encoding="utf-8")
        page.write_text(self.html(), encoding="utf-8")
        return [markdown, page]

    def markdown(self, folder: Path) -> str:
        """The document as Markdown whose pictures are linked relative to a folder."""
        blocks = [f"# {self.title}"]
        for section in self.sections:
            blocks += [f"## {section.title}", *section.text]
            for item in section.contents:
                if isinstance(item, Picture):
                    blocks.append(f"![{item.caption}]({item.path.relative_to(folder)})\n\n*{item.caption}*")
                else:
                    blocks.append(_markdown_table(item))
        return "\n\n".join(block for block in blocks if block) + "\n"

    def html(self) -> str:
        """The document as one page that needs no other file."""
        return render_page("benchmark.html", self.title, sections=self.sections)


def _markdown_table(table: Table) -> str:
    lines = [table.headings, ["---"] * len(table.headings), *table.rows]
    text = "\n".join("| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |" for line in lines)
    return "\n\n".join(part for part in (f"### {table.title}", table.note, text) if part)
