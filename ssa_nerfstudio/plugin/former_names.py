"""Names that config.yml files of earlier revisions contain, which `ns-eval`, `ns-viewer` and others load.

May go with the first release.
"""

from __future__ import annotations

import sys

from ssa_nerfstudio.plugin import model, settings
from ssa_nerfstudio.plugin.training import fused_adam


def provide_former_names() -> None:
    """Let YAML find `plugin.fused_adam` and `plugin.settings.SSASplatfactoModelConfig`, which have moved."""
    sys.modules.setdefault("ssa_nerfstudio.plugin.fused_adam", fused_adam)
    setattr(settings, "SSASplatfactoModelConfig", model.SSASplatfactoModelConfig)  # noqa: B010 - not a name of its own
