"""Indoor mapping from a colour-and-depth camera: trajectory, cloud, octree and navigation grid.

>>> import slamcli
>>> run = slamcli.run("demo", settings={"track.min_inliers": 20})
>>> run.trajectory().T_wc
"""

from typing import TYPE_CHECKING, Any

from slamcli.errors import BadFrame, SlamError

if TYPE_CHECKING:
    from slamcli.api import Run, open_run, run

__version__ = "0.1.0"
__all__ = ["BadFrame", "Run", "SlamError", "__version__", "open_run", "run"]
LAZY = ("Run", "open_run", "run")  # of slamcli.api: imported at first use, so that `import slamcli` is instant


def __getattr__(name: str) -> Any:
    """Import the part of the API that is asked for."""
    if name in LAZY:
        from importlib import import_module

        return getattr(import_module("slamcli.api"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
