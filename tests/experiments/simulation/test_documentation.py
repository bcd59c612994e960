"""The page on the simulator says what the code does."""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path

import pytest

from ssa_nerfstudio.experiments.configuration import shipped
from ssa_nerfstudio.experiments.effects.catalogue import EFFECTS, effect_class

PAGE = (Path(__file__).parents[3] / "docs/simulate.md").read_text()


def section(effect: str) -> str:
    """What the page says about an effect's parameters."""
    return re.split(r"\n(?:\*\*`|## )", PAGE[re.search(rf"\n.*\*\*`{effect}`\*\*", PAGE).end() :])[0]  # type: ignore[union-attr]


@pytest.mark.parametrize("effect", EFFECTS)
def test_every_parameter_is_on_the_page_with_its_default(effect):
    text = section(effect)
    for field in dataclasses.fields(effect_class(effect)):  # type: ignore[arg-type]
        row = next((line for line in text.splitlines() if f"`{field.name}`" in line), "")
        assert row, f"{effect}.{field.name}"
        if row.count("_color`") <= 1:
            default = field.default
            if isinstance(default, float):
                shown = f"{default:g}"
            else:
                shown = ", ".join(map(str, default)) if isinstance(default, tuple) else str(default)
            assert f"| {shown} |" in row, f"{effect}.{field.name} = {shown}"


def test_every_shipped_configuration_is_on_the_page():
    for name in (*shipped("effects"), *shipped("scenes")):
        assert f"`{name}`" in PAGE
