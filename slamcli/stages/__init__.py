"""The table of stages, from which commands, help, order and staleness follow. Imports nothing heavy: the command line reads it.

CONTRIBUTING.md lists what else a new stage needs.
"""

from dataclasses import dataclass


@dataclass(frozen=True)
class Stage:
    """A row of the pipeline. Its command, help, order, staleness and what is told of it follow from here; its code is `slamcli.stages.<name>.run`."""

    name: str  # also the command and the folder
    needs: tuple[str, ...]  # what it reads: earlier stages, or "dataset"
    config: tuple[str, ...]  # the sections that may change its result; it sees no others
    help: str
    told: tuple[str, ...] = ()  # counts of its summary that the terminal shows, the rest with -v; docs/glossary.md says what they mean
    has_trajectory: bool = False  # whether it finds or refines the poses of frames: it can be measured and exported
    is_intermediate: bool = False  # whether only later stages read its files: `slamcli clean` deletes them


STAGES = (
    Stage(
        "extract",
        needs=("dataset",),
        config=("camera", "extract"),
        help="Detect evenly spread ORB features and read their depth.",
        told=("features", "frames_without_depth", "bad_images"),
        is_intermediate=True,
    ),
    Stage(
        "match",
        needs=("extract",),
        config=("match",),
        help="Give each feature its visual word and match neighbouring frames.",
        told=("matches_per_pair",),
        is_intermediate=True,
    ),
    Stage(
        "track",
        needs=("extract", "match"),
        config=("sensor", "track"),
        help="Find each frame's pose and build the map of landmarks.",
        told=("key_frames", "landmarks", "lost"),
        has_trajectory=True,
        is_intermediate=True,
    ),
    Stage(
        "optimize",
        needs=("extract", "track"),
        config=("sensor", "track", "optimize"),
        help="Adjust the whole map and the camera's timing, and refine every frame.",
        told=("outliers",),
        has_trajectory=True,
        is_intermediate=True,
    ),
    Stage(
        "loop",
        needs=("extract", "match", "track", "optimize"),
        config=("sensor", "track", "loop"),
        help="Recognize revisited places, close the loops and refine every frame.",
        told=("candidates", "closures", "lost"),
        has_trajectory=True,
    ),
    Stage(
        "densify",
        needs=("dataset", "loop"),
        config=("sensor", "densify", "ground"),
        help="Join the depth images to a coloured cloud and find the floor.",
        told=("points",),
    ),
    Stage(
        "octree",
        needs=("dataset", "loop", "densify"),
        config=("sensor", "octree"),
        help="Build the octree of occupied and free space.",
        told=("occupied_cells", "free_cells"),
    ),
    Stage(
        "grid2d",
        needs=("dataset", "extract", "loop", "densify", "octree"),
        config=("sensor", "grid2d"),
        help="Build the 2-D navigation grid.",
        told=("occupied", "free"),
    ),
)
NAMES = tuple(stage.name for stage in STAGES)
WITH_TRAJECTORY = tuple(stage.name for stage in STAGES if stage.has_trajectory)  # in the order they refine it
INTERMEDIATE = tuple(stage.name for stage in STAGES if stage.is_intermediate)


def basis(name: str) -> set[str]:
    """Name a stage and all that it rests on, directly or not."""
    return {name}.union(*(basis(need) for need in stage_named(name).needs if need in NAMES))


def stage_named(name: str) -> Stage:
    """Look up a row of the table."""
    return STAGES[NAMES.index(name)]
