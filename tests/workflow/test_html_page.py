"""HTML pages: text is escaped and marked, pictures are embedded."""

from __future__ import annotations

import base64
from pathlib import Path

import pytest

from ssa_nerfstudio.workflow.html_page import render_page

TEMPLATE = """{% extends "base.html" %}{% from "base.html" import table %}{% block body %}
<p>{{ text | inline }}</p>{{ table(["a", "b"], [[text, "<x>"]]) }}{% if picture %}<img src="{{ picture | embedded }}">
{% endif %}{% endblock %}"""


def page(folder: Path, **values) -> str:
    template = folder / "page.html"
    template.write_text(TEMPLATE)
    return render_page(template, "a <b>", **values)


def test_text_is_escaped_and_marked(tmp_path):
    text = page(tmp_path, text="**bold** and `x < y` & <script>")
    assert "<title>a &lt;b&gt;</title>" in text
    marked = "<b>bold</b> and <code>x &lt; y</code> &amp; &lt;script&gt;"
    assert f"<p>{marked}</p>" in text
    assert "<tr><th>a</th><th>b</th></tr>" in text
    assert f"<tr><td>{marked}</td><td>&lt;x&gt;</td></tr>" in text


def test_a_narrow_window_gets_its_own_width(tmp_path):
    assert '<meta name="viewport" content="width=device-width' in page(tmp_path, text="")


@pytest.mark.parametrize(("suffix", "kind"), [("png", "image/png"), ("jpg", "image/jpeg"), ("svg", "image/svg+xml")])
def test_pictures_are_embedded(tmp_path, suffix, kind):
    path = tmp_path / f"picture.{suffix}"
    path.write_bytes(b"content")
    text = page(tmp_path, text="", picture=path)
    assert f'<img src="data:{kind};base64,{base64.b64encode(b"content").decode()}">' in text
    assert str(tmp_path) not in text
