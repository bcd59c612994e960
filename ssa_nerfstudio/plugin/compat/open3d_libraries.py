"""open3d's wheels need libusb without including it; on a slim system nerfstudio then cannot read point clouds.

`preload` serves commands that import the plugin before open3d. `ns-export` imports open3d first, which is why `make
setup` runs this module: it copies the library beside open3d. May go when open3d's wheels bring it.
"""

from __future__ import annotations

import ctypes
import importlib.util
import shutil
import sys
from pathlib import Path

LIBUSB = "libusb-1.0.so.0"


def preload() -> None:
    """Load libusb, from the system or the wheel `libusb-package`, so that open3d finds it when it is imported."""
    library = _from_wheel()
    if sys.platform != "linux" or library is None:
        return
    try:
        ctypes.CDLL(LIBUSB, mode=ctypes.RTLD_GLOBAL)
    except OSError:
        ctypes.CDLL(str(library), mode=ctypes.RTLD_GLOBAL)


def install() -> Path | None:
    """Copy libusb beside open3d's own libraries, which are searched first, where the system has none.

    Returns:
        The copy, or None where nothing was needed.
    """
    library, open3d = _from_wheel(), importlib.util.find_spec("open3d")
    if sys.platform != "linux" or library is None or open3d is None or open3d.origin is None:
        return None
    try:
        ctypes.CDLL(LIBUSB)
    except OSError:
        return Path(shutil.copy(library, Path(open3d.origin).parent / LIBUSB))
    return None


def _from_wheel() -> Path | None:
    spec = importlib.util.find_spec("libusb_package")
    if spec is None or spec.origin is None:
        return None
    library = Path(spec.origin).parent / "libusb-1.0.so"
    return library if library.exists() else None


if __name__ == "__main__":
    install()
