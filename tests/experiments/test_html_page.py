"""HTML pages: text is escaped, pictures are embedded, the templates come with the package."""

from __future__ import annotations

import base64
from types import SimpleNamespace

import pytest

from ssa_nerfstudio.experiments.html_page import render_page


def page(**section) -> str:
    values = {"title": "T", "text": [], "contents": [], **section}
    return render_page("benchmark.html", "a <b>", sections=[SimpleNamespace(**values)])


def test_text_is_escaped_and_marked():
    text = page(title="<i>", text=["**bold** and `x < y` & <script>"])
    assert "<title>a &lt;b&gt;</title>" in text
    assert "<h2>&lt;i&gt;</h2>" in text
    assert "<p><b>bold</b> and <code>x &lt; y</code> &amp; &lt;script&gt;</p>" in text


def test_table_cells_are_escaped_and_marked():
    table = SimpleNamespace(title="T", headings=["a", "b"], rows=[["**1**", "<x>"]], note="")
    text = page(contents=[table])
    assert "<tr><th>a</th><th>b</th></tr>" in text
    assert "<tr><td><b>1</b></td><td>&lt;x&gt;</td></tr>" in text


@pytest.mark.parametrize(("suffix", "kind"), [("png", "image/png"), ("jpg", "image/jpeg"), ("svg", "image/svg+xml")])
def test_pictures_are_embedded(tmp_path, suffix, kind):
    path = tmp_path / f"picture.{suffix}"
    path.write_bytes(b"content")
    text = page(contents=[SimpleNamespace(path=path, caption='"quoted"')])
    encoded = base64.b64encode(b"content").decode()
    assert f'<img alt="&#34;quoted&#34;" src="data:{kind};base64,{encoded}">' in text
    assert str(tmp_path) not in text
