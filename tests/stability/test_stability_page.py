"""docs/stability.md lists the cases that there are."""

from __future__ import annotations

from pathlib import Path

from hard_cases import families, listing

PAGE = Path(__file__).parents[2] / "docs" / "stability.md"


def test_there_are_at_least_a_hundred_cases_each_with_a_sentence():
    cases = [case for family in families() for case in family.cases]
    assert len(cases) >= 100
    assert all(len(case.wrong.split()) >= 2 and case.wrong.endswith(".") for case in cases)


def test_the_page_lists_every_case():
    # python tests/stability/hard_cases.py writes what belongs there.
    assert listing().strip() in PAGE.read_text()
