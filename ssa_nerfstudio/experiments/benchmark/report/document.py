"""Tables, text and pictures as Markdown and as one HTML page."""

from __future__ import annotations

import base64
import html
import re
from dataclasses import dataclass, field
from pathlib import Path


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
        body = [f"<h1>{_inline(self.title)}</h1>"]
        for section in self.sections:
            body.append(f"<h2>{_inline(section.title)}</h2>")
            body += [f"<p>{_inline(text)}</p>" for text in section.text]
            for item in section.contents:
                body.append(_html_picture(item) if isinstance(item, Picture) else _html_table(item))
        return _PAGE.format(title=html.escape(self.title), body="\n".join(body))


def _markdown_table(table: Table) -> str:
    lines = [table.headings, ["---"] * len(table.headings), *table.rows]
    text = "\n".join("| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |" for line in lines)
    return "\n\n".join(part for part in (f"### {table.title}", table.note, text) if part)


def _html_table(table: Table) -> str:
    head = "".join(f"<th>{_inline(cell)}</th>" for cell in table.headings)
    rows = "".join("<tr>" + "".join(f"<td>{_inline(cell)}</td>" for cell in row) + "</tr>" for row in table.rows)
    note = f"<p>{_inline(table.note)}</p>" if table.note else ""
    return f"<h3>{_inline(table.title)}</h3>{note}<div class=wide><table><tr>{head}</tr>{rows}</table></div>"


def _html_picture(picture: Picture) -> str:
    kind = {".png": "image/png", ".jpg": "image/jpeg", ".svg": "image/svg+xml"}[picture.path.suffix]
    data = base64.b64encode(picture.path.read_bytes()).decode()
    caption = html.escape(picture.caption)
    source = f"data:{kind};base64,{data}"
    return f'<figure><img alt="{caption}" src="{source}"><figcaption>{caption}</figcaption></figure>'


def _inline(text: str) -> str:
    text = html.escape(text)
    text = re.sub(r"\*\*(.+?)\*\*", r"<b>\1</b>", text)
    return re.sub(r"`(.+?)`", r"<code>\1</code>", text)


_PAGE = """<!doctype html>
<html lang="en"><meta charset="utf-8"><title>{title}</title>
<style>
body {{ font: 15px/1.5 system-ui, sans-serif; max-width: 80rem; margin: 2rem auto; padding: 0 1rem; color: #222 }}
img {{ max-width: 100%; height: auto }} table {{ border-collapse: collapse; font-variant-numeric: tabular-nums }}
td, th {{ padding: .25rem .7rem; border-bottom: 1px solid #ddd; text-align: right; white-space: nowrap }}
th {{ border-bottom: 2px solid #444 }} td:first-child, th:first-child {{ text-align: left }}
.wide {{ overflow-x: auto }} figure {{ margin: 1rem 0 }} figcaption {{ color: #555 }} code {{ font-size: .85em }}
</style>
{body}
</html>
"""
