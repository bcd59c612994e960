"""What training decides by itself: a line each, printed and logged, so that `ssa run` hears of it, too."""

from __future__ import annotations

import logging

from nerfstudio.utils.rich_utils import CONSOLE

_LOG = logging.getLogger(__name__)


def tell(decision: str, brief: str | None = None) -> None:
    """Print a decision on nerfstudio's console, and log it at level INFO for whoever silences that console.

    Args:
        decision: one line that ends with the option that overrides it.
        brief: the same without what `ssa run` has said before, measured another way; the log record's `brief`.
    """
    CONSOLE.print(decision, markup=False, emoji=False)
    _LOG.info(decision, extra={"brief": brief or decision})
