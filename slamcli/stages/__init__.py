"""The table of stages, from which commands, help, order and staleness follow. Imports nothing heavy: the command line reads it.

CONTRIBUTING.md lists what else a new stage needs.
"""

from dataclasses import dataclass


@dataclass(frozen=True)
class Stage:
    """A row of the pipeline. Its command, help, order and staleness follow from here; its code is `slamcli.stages.<name>.run`."""

    name: str  # also the command and the folder
    needs: tuple[str, ...]  # what it reads: earlier stages, or "dataset"
    config: tuple[str, ...]  # the sections that may change its result; it sees no others
    help: str


STAGES = (
    Stage("extract", ("dataset",), ("camera", "extract"), "Detect evenly spread ORB features and read their depth."),
    Stage("match", ("extract",), ("match",), "Give each feature its visual word and match neighbouring frames."),
    Stage("track", ("extract", "match"), ("sensor", "track"), "Find each frame's pose and build the map of landmarks."),
    Stage(
        "optimize",
        ("extract", "track"),
        ("sensor", "track", "optimize"),
        "Adjust the whole map and the camera's timing, and refine every frame.",
    ),
    Stage(
        "loop",
        ("extract", "match", "track", "optimize"),
        ("sensor", "track", "loop"),
        "Recognize revisited places, close the loops and refine every frame.",
    ),
    Stage(
        "densify",
        ("dataset", "loop"),
        ("sensor", "densify", "ground"),
        "Join the depth images to a coloured cloud and find the floor.",
    ),
    Stage("octree", ("dataset", "loop", "densify"), ("sensor", "octree"), "Build the octree of occupied and free space."),
    Stage("grid2d", ("dataset", "extract", "loop", "densify", "octree"), ("sensor", "grid2d"), "Build the 2-D navigation grid."),
)
NAMES = tuple(stage.name for stage in STAGES)


def basis(name: str) -> set[str]:
    """Name a stage and all that it rests on, directly or not."""
    return {name}.union(*(basis(need) for need in stage_named(name).needs if need in NAMES))


def stage_named(name: str) -> Stage:
    """Look up a row of the table."""
    return STAGES[NAMES.index(name)]
