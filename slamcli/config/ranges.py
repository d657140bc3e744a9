"""One reach of the depth camera from which the ranges of the stages follow, unless they are set themselves."""

import dataclasses
from collections.abc import Container

from slamcli.config.options import Config

FARTHEST = ("densify.depth_max", "ground.max_range", "octree.max_range", "grid2d.max_range")
NEAREST = ("grid2d.min_range",)
USUAL = Config()  # the ranges that suit the default reach


def follow(before: Config, after: Config, given: Container[str]) -> Config:
    """Move ranges along when `sensor.depth_max` or `sensor.depth_min` has changed between two configurations.

    given : full names of the options that are set on purpose with this change; they stay, as do ranges that were no longer where the
        reach before had put them
    """
    for names, key in ((FARTHEST, "depth_max"), (NEAREST, "depth_min")):
        old, new = getattr(before.sensor, key), getattr(after.sensor, key)
        for name in names if new != old else ():
            section, _, option = name.partition(".")
            if name not in given and getattr(getattr(before, section), option) == derived(name, old):
                changed = dataclasses.replace(getattr(after, section), **{option: derived(name, new)})
                after = dataclasses.replace(after, **{section: changed})
    return after


def derived(name: str, reach: float) -> float:
    """Return the range [m] that suits a reach of the sensor [m]: the usual one as far as the sensor sees, more where it sees farther."""
    section, _, option = name.partition(".")
    usual: float = getattr(getattr(USUAL, section), option)
    if name in NEAREST:
        return reach
    return round(min(reach, usual * max(1.0, reach / USUAL.sensor.depth_max)), 6)
