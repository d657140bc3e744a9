"""The one way to import Open3D: late, as it takes seconds, and on machines that lack libusb.

Open3D's wheel is linked against ``libusb-1.0.so.0``, which a bare machine does not have. The package libusb-package carries a library of
that name; once it is loaded into the process the dynamic linker is satisfied.
"""

import ctypes
import sys
from functools import cache
from types import ModuleType

from slamcli import address_space
from slamcli.errors import SlamError


@cache
def load_open3d() -> ModuleType:
    """Import Open3D, quiet but for errors; raises SlamError with what to install or to allow where that fails."""
    address_space.require()
    if sys.platform.startswith("linux"):
        _preload_libusb()
    try:
        import open3d
    except ImportError as error:
        raise SlamError(f"Open3D cannot be loaded ({error}); try: pip install --force-reinstall open3d libusb-package") from error
    open3d.utility.set_verbosity_level(open3d.utility.VerbosityLevel.Error)
    return open3d


def _preload_libusb() -> None:
    """Load the packaged libusb unless the system has one: the system's own is kept where there is a choice."""
    try:
        ctypes.CDLL("libusb-1.0.so.0", mode=ctypes.RTLD_GLOBAL)
    except OSError:
        try:
            import libusb_package
        except ImportError:  # Open3D may still load; if not, its own error says what is missing
            return
        path = libusb_package.get_library_path()
        if path is not None:
            ctypes.CDLL(str(path), mode=ctypes.RTLD_GLOBAL)
