"""Checks of an effect's fields: each failure names the class, the field, the range and the value."""

from __future__ import annotations


def require(owner: object, **intervals: str) -> None:
    """Checks numeric fields against intervals.

    Args:
        owner: the object whose fields are checked.
        intervals: for each field its interval in the usual notation, such as "(0, 1]"; "inf" is allowed as an end.

    Raises:
        ValueError: a field is outside its interval, or not a number.
    """
    for name, interval in intervals.items():
        low, high = (float(end) for end in interval[1:-1].split(","))
        value = getattr(owner, name)
        above = low < value if interval[0] == "(" else low <= value
        below = value < high if interval[-1] == ")" else value <= high
        if not (above and below):
            raise ValueError(f"{type(owner).__name__}.{name} must be in {interval}, got {value}")


def require_colors(owner: object, *names: str) -> None:
    """Checks that fields are sRGB colors: three numbers in 0..255.

    Raises:
        ValueError: one is not.
    """
    for name in names:
        color = getattr(owner, name)
        if len(color) != 3 or not all(0 <= channel <= 255 for channel in color):
            raise ValueError(f"{type(owner).__name__}.{name} must be three numbers in 0..255, got {color}")
