"""The versions that this package was written for, checked once."""

from __future__ import annotations

import logging
from functools import cache
from importlib.metadata import PackageNotFoundError, version

from packaging.version import Version

WRITTEN_FOR = {
    "nerfstudio": ("1.1.5", "1.1.6"),
    "gsplat": ("1.4.0", "1.4.1"),
    # Private functions in use: `_fused_adam_` and `_foreach_add_` (fused_adam),
    # `_amp_foreach_non_finite_check_and_unscale_` (nonfinite).
    "torch": ("2.6", "2.15"),
}
"""Lowest version of each package, and the first that is not covered: the bounds of pyproject.toml."""
_LOG = logging.getLogger(__name__)


@cache
def check_versions() -> None:
    """Log one warning for all packages whose version the repairs were not written for."""
    others = [found for found in map(_other_version, WRITTEN_FOR) if found]
    if others:
        _LOG.warning(f"{', '.join(others)}; other versions are untested and may fail (pip install ssa-nerfstudio)")


def _other_version(package: str) -> str | None:
    lowest, below = map(Version, WRITTEN_FOR[package])
    try:
        found = Version(version(package))
    except PackageNotFoundError:
        return f"{package} is not installed"
    if lowest <= found < below:
        return None
    return f"{package} {found} is installed, this package was written for {lowest} up to, not including, {below}"
