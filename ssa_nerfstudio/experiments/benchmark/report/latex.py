"""The tables of a report as LaTeX: booktabs, metrics grouped below their methods as in the paper's tables."""

from __future__ import annotations

import re
from collections.abc import Iterable
from itertools import groupby
from pathlib import Path

from ssa_nerfstudio.data.writing import write_text
from ssa_nerfstudio.experiments.benchmark.report.document import Document, Table
from ssa_nerfstudio.experiments.benchmark.report.table_cells import HEADINGS

METRIC = re.compile(f"(?P<method>.+) (?P<metric>{'|'.join(map(re.escape, HEADINGS.values()))})$")
"""A heading that names a method and a metric."""
_SYMBOLS = {
    "\\": r"\textbackslash{}",
    **{symbol: f"\\{symbol}" for symbol in "&%$#_{}"},
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "↑": r"$\uparrow$",
    "↓": r"$\downarrow$",
    "†": r"$^{\dagger}$",
    "±": r"$\pm$",
}


def write_latex(document: Document, path: Path) -> Path:
    """Write the tables of a document one after the other, to be pasted; they need booktabs and graphicx."""
    tables = [item for section in document.sections for item in section.contents if isinstance(item, Table)]
    write_text(path, "% \\usepackage{booktabs,graphicx}\n" + "\n".join(map(latex, tables)))
    return path


def latex(table: Table) -> str:
    """One table over two columns of text, shrunk to their width."""
    parts = [METRIC.match(heading) for heading in table.headings]
    methods = [part["method"] if part else "" for part in parts]
    names = [part["metric"] if part else heading for part, heading in zip(parts, table.headings, strict=True)]
    lines = [r"\begin{table*}[htbp]", r"\centering", rf"\caption{{{inline(f'{table.title}. {table.note}'.strip())}}}"]
    lines += [r"\resizebox{\textwidth}{!}{%", rf"\begin{{tabular}}{{{_columns(methods)}}}", r"\toprule"]
    if any(methods):
        spans = [(method, len([*group])) for method, group in groupby(methods)]
        lines.append(_row([rf"\multicolumn{{{n}}}{{c}}{{{inline(m)}}}" if m else " & " * (n - 1) for m, n in spans]))
        ends = [sum(n for _, n in spans[: k + 1]) for k in range(len(spans))]
        rules = [rf"\cmidrule(lr){{{end - n + 1}-{end}}}" for (m, n), end in zip(spans, ends, strict=True) if m]
        lines.append("".join(rules))
    lines += [_row(map(inline, names)), r"\midrule", *(_row(map(inline, row)) for row in table.rows)]
    return "\n".join([*lines, r"\bottomrule", r"\end{tabular}%", "}", r"\end{table*}", ""])


def inline(text: str) -> str:
    """Text with LaTeX's own characters escaped, and **bold** and `code` as it sets them."""
    escaped = "".join(_SYMBOLS.get(character, character) for character in text)
    bold = re.sub(r"\*\*(.+?)\*\*", r"\\textbf{\1}", escaped)
    return re.sub(r"`(.+?)`", r"\\texttt{\1}", bold)


def _columns(methods: list[str]) -> str:
    """Names to the left, metrics centered with a gap between methods."""
    return " ".join(("c" if method else "l") * len([*group]) for method, group in groupby(methods))


def _row(cells: Iterable[str]) -> str:
    return " & ".join(cells) + r" \\"
