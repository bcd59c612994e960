"""The script that tells how far float32 is from the reference runs, and tells of a body that is wrong."""

from __future__ import annotations

import compare_bodies
import pytest
import torch


@pytest.fixture(autouse=True)
def few_cases(monkeypatch):
    monkeypatch.setattr(compare_bodies.cases.RASTERIZER, "cases", compare_bodies.cases.RASTERIZER.cases[:2])
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    yield
    compare_bodies.cases.SINGLE_PRECISION.clear()


def test_cases_that_agree_are_counted(capsys):
    compare_bodies.main()
    assert "2 of 2 cases are within 1e-04." in capsys.readouterr().out


def test_a_body_that_is_wrong_is_named_with_its_output(capsys, monkeypatch):
    original = compare_bodies.cases.rasterizer

    def wrong(*arguments):
        def draw(**options):
            image, alpha, info = original(*arguments)(**options)
            return 1.01 * image, alpha, info

        return draw

    monkeypatch.setattr(compare_bodies.cases, "rasterizer", wrong)
    compare_bodies.main()
    printed = capsys.readouterr().out
    assert "0 of 2 cases" in printed
    assert "1.0e-02 (" in printed
