"""The configuration: one frozen dataclass per section; every option carries its help and its bounds."""

from dataclasses import dataclass, field
from typing import Any


def option(
    default: Any,
    help: str,
    *,
    ge: Any = None,
    gt: Any = None,
    le: Any = None,
    lt: Any = None,
    choices: tuple = (),
    is_file: bool = False,
) -> Any:
    """Declare an option: default, help with unit in [brackets], bounds, or the values allowed.

    `is_file` marks the name of an input file ("" = none): it is kept as an absolute path, and the file's content counts as an input
    of every stage that declares the section.
    """
    bounds = {name: value for name, value in (("ge", ge), ("gt", gt), ("le", le), ("lt", lt)) if value is not None}
    return field(default=default, metadata={"help": help, "bounds": bounds, "choices": tuple(choices), "is_file": is_file})


@dataclass(frozen=True)
class RunConfig:
    """How a run is carried out. No stage declares it."""

    workers: int = option(2, "threads that decode and extract", ge=1, le=64)


@dataclass(frozen=True)
class RecordingConfig:
    """Which part of the recording is used, and what stands in for what it lacks. No stage declares it: it changes the recording."""

    start: float = option(0.0, "time after the first frame at which to begin [s]", ge=0, le=1_000_000)
    end: float = option(0.0, "time after the first frame at which to stop; 0 = never [s]", ge=0, le=1_000_000)
    every: int = option(1, "use every n-th frame", ge=1, le=100_000)
    fps: float = option(0.0, "frame rate of a recording without stamps; 0 = 30 [Hz]", ge=0, le=1000)
    known_camera: str = option("", 'known camera whose nominal intrinsics are used, such as "d435"; "" = the recording\'s own')
    find_depth_camera: bool = option(True, "where depth is plainly not registered, find its camera and register it")
    depth_camera: str = option("", 'depth camera, "fx fy cx cy x y z rx ry rz" [px, m, rad]')
    full_size: bool = option(False, "use pictures of more than a megapixel at full size, not at about 640 px")


@dataclass(frozen=True)
class SensorConfig:
    """The depth camera's noise and reach: what a measurement is worth, to every stage from track on."""

    reading_noise_base: float = option(0.0012, "sigma of one depth reading at 0.4 m, the sensor's alone [m]", ge=1e-6, le=1)
    reading_noise_quadratic: float = option(0.0019, "growth of a reading's sigma with (z - 0.4 m)^2 [1/m]", ge=0, le=1)
    depth_noise_base: float = option(0.008, "depth sigma at 0.4 m, with the errors of calibration and poses [m]", ge=1e-6, le=1)
    depth_noise_quadratic: float = option(0.008, "growth of the depth sigma with (z - 0.4 m)^2 [1/m]", ge=0, le=1)
    pixel_noise: float = option(1.0, "sigma of a key point at octave 0 [px]; grows with the octave's scale", ge=0.01, le=100)
    depth_min: float = option(0.3, "nearer readings are ignored [m]", ge=0, le=100)
    depth_max: float = option(8.0, "farther readings are ignored; a new value moves the ranges of later stages along [m]", ge=0.01, le=100)


@dataclass(frozen=True)
class ExtractConfig:
    """Evenly spread ORB features."""

    features: int = option(1000, "key points wanted per frame", ge=50, le=20000)
    levels: int = option(
        8,
        "pyramid levels",
        ge=1,
        le=12,
    )
    scale: float = option(1.2, "scale between pyramid levels", gt=1.0, le=2.0)
    cell: int = option(
        30,
        "side of the cells in which corners are sought [px of the level]",
        ge=8,
        le=200,
    )
    smooth: bool = option(True, "seek corners in a copy blurred by 1 px, against sensor noise")
    fast_threshold: int = option(
        8,
        "FAST threshold of a corner, in the blurred copy if there is one [grey levels]",
        ge=1,
        le=255,
    )
    fast_threshold_low: int = option(
        5,
        "FAST threshold in cells that fast_threshold leaves empty [grey levels]",
        ge=1,
        le=255,
    )
    pool: float = option(
        1.3,
        "strongest corners kept for each key point wanted, before spreading; 0 = all",
        ge=0,
        le=100,
    )
    weak: float = option(
        0.13,
        "greatest share of corners from cells without a strong one, where others suffice",
        ge=0,
        le=1,
    )
    rank_by: str = option(
        "fast",
        "corners are ranked by their FAST score or the sum of differences, [Z] (1)",
        choices=("fast", "sum"),
    )
    subpixel: bool = option(
        True,
        "place key points at the summit of the FAST score, not at whole pixels",
    )
    depth_window: int = option(1, "side of the window whose median is a key point's depth [px]", choices=(1, 3, 5))
    depth_jump: float = option(
        0.03,
        "no depth beside an outline nearer by more than this share; 0 = off",
        ge=0,
        le=1,
    )
    flow: bool = option(
        False,
        "also follow key points by optical flow, for frames whose descriptors find few matches",
    )


@dataclass(frozen=True)
class MatchConfig:
    """Visual words, and matches between neighbouring frames."""

    method: str = option(
        "words",
        "compare features under one vocabulary node, or all with all",
        choices=("words", "brute"),
    )
    vocabulary: str = option("", "vocabulary file; empty = the shipped one", is_file=True)
    node_level: int = option(1, "levels below the root at which features are compared under the same node", ge=0, le=12)
    node_margin: int = option(
        4,
        "a second node counts too, if at most this much farther; -1 = never [bits]",
        ge=-1,
        le=256,
    )
    window: int = option(1, "how many frames before it each frame is matched with", ge=1, le=30)
    max_distance: int = option(64, "descriptors farther apart are no match [bits]", ge=0, le=256)
    ratio: float = option(0.8, "the nearest must be closer than this share of the second nearest's distance", gt=0, le=1)
    check_rotation: bool = option(True, "keep only matches whose rotation agrees with that of most others")
    flow_below: int = option(100, "with fewer matches, those of optical flow are added, if extract.flow is on", ge=0, le=100_000)
    flow_radius: float = option(2.0, "distance from a key point within which its partner's flow must end [px]", ge=0.01, le=1000)


@dataclass(frozen=True)
class TrackConfig:
    """Tracking and the windowed bundle adjustment."""

    min_inliers: int = option(15, "fewer inliers: the frame is lost", ge=4, le=20_000)
    start_features: int = option(100, "features with depth that the first key frame needs", ge=4, le=20_000)
    ransac_rounds: int = option(100, "P3P samples drawn per frame; M of [Z] 1.2", ge=1, le=100_000)
    ransac_threshold_px: float = option(4.0, "reprojection error of an inlier to P3P [px]; [Z] 1.2", ge=0.01, le=1000)
    search_radius_px: float = option(5.0, "window of the local map's search at octave 0 [px]", ge=0.01, le=1000)
    search_max_distance: int = option(80, "descriptors that differ more do not match [bits]", ge=1, le=256)
    search_ratio: float = option(0.8, "best against second best distance of the same octave", gt=0, le=1)
    local_key_frames: int = option(20, "key frames whose landmarks are looked for in a frame", ge=1, le=1000)
    relocalize_candidates: int = option(5, "key frames tried after loss, best word score first", ge=1, le=1000)
    relocalize_inliers: int = option(45, "landmarks that must agree to recognize a place after loss", ge=4, le=20_000)
    segment_after: int = option(10, "frames lost in a row at which a new map segment begins; 0 = never", ge=0, le=1_000_000)
    key_frame_share: float = option(0.6, "key frame where less than this share of its reference's landmarks or depth is left", gt=0, le=1)
    key_frame_gap: int = option(8, "frames after which another key frame is made, unless the place is crowded", ge=1, le=1_000_000)
    key_frame_crowd: int = option(12, "key frames within 0.1 m, 6 degrees that prevent another, unless much is new", ge=1, le=1_000_000)
    depth_icp_below: int = option(150, "with fewer landmarks, a frame is aligned by its depth image; 0 = without any", ge=0, le=100_000)
    depth_icp_hold: float = option(1.0, "how long motion continues in directions that depth leaves open, as along a wall [s]", ge=0, le=10)
    moving_objects: bool = option(True, "find what moves, such as people; poses and maps rest on what stands still")
    rests: bool = option(True, "find where the camera stands still: one pose, no key frames")
    share_key_frames: int = option(10, "neighbours in which a new key frame's landmarks are looked for", ge=0, le=1000)
    share_max_distance: int = option(50, "descriptors that differ more are not one landmark [bits]", ge=1, le=256)
    window_key_frames: int = option(12, "key frames adjusted with each new one", ge=2, le=200)
    window_iterations: int = option(5, "rounds of the windowed bundle adjustment", ge=1, le=1000)


@dataclass(frozen=True)
class OptimizeConfig:
    """Global bundle adjustment."""

    enabled: bool = option(True, "false: the map passes through")
    iterations: int = option(30, "rounds of global bundle adjustment at most", ge=1, le=1000)
    depth_icp_edges: int = option(
        3,
        "earlier key frames that each key frame's depth image is aligned with; 0 = none",
        ge=0,
        le=50,
    )
    move_depth: bool = option(True, "move depth readings to the colour image's stamp by the camera's own motion")
    readout: bool = option(
        True,
        "find the readout times of colour and depth images, and correct for rolling shutter",
    )
    depth_delay: bool = option(True, "find by how much depth images are older than their stamps, and correct it")
    intrinsics: bool = option(
        False,
        "find focal lengths and principal point, where the calibration is a guess",
    )
    depth_scale: bool = option(
        False,
        "find the offset of inverse depth, as of a constant error of disparity",
    )
    rounds: int = option(2, "rounds of adjusting the map and finding those numbers", ge=1, le=10)
    timing_prior: float = option(0.02, "standard deviation of readout times and delay around 0 [s]", ge=1e-6, le=1)
    focal_prior: float = option(0.02, "standard deviation of the calibration's focal lengths, as a share of them", ge=1e-6, le=1)
    centre_prior: float = option(5.0, "standard deviation of the calibration's principal point [px]", ge=1e-3, le=1000)
    depth_scale_prior: float = option(0.02, "standard deviation of the depth scale, as a share of it", ge=1e-6, le=1)
    inverse_depth_prior: float = option(0.02, "standard deviation of the offset of inverse depth [1/m]", ge=1e-6, le=1)


@dataclass(frozen=True)
class LoopConfig:
    """Loop closing."""

    enabled: bool = option(True, "false: the map passes through")
    rounds: int = option(3, "passes of search, correction and adjustment at most; the next begins only after new closures", ge=1, le=100)
    candidates: int = option(3, "key frames looked at per key frame, best word score first", ge=1, le=1000)
    min_score: float = option(0.32, "similarity of word vectors that always makes a candidate; [Z] 1.3", ge=0, le=1)
    score_share: float = option(0.6, "share of the mean score of a key frame's neighbours that makes a candidate", ge=0, le=1)
    near: float = option(0.7, "key frames that look at spots this near are candidates; 0 = off [m]", ge=0, le=1000)
    min_shared: int = option(15, "key frames that share this many landmarks are joined already", ge=1, le=20_000)
    min_matches: int = option(20, "matches under the same words that a candidate needs", ge=4, le=20_000)
    min_inliers: int = option(45, "landmarks found again that an accepted closure needs; [Z] 1.3", ge=6, le=20_000)
    ransac_rounds: int = option(300, "3-D to 3-D samples per candidate", ge=1, le=100_000)
    ransac_threshold_px: float = option(6.0, "reprojection error of an inlier, both ways [px]", ge=0.01, le=1000)
    search_radius_px: float = option(4.0, "window for the landmarks around a candidate at octave 0 [px]", ge=0.01, le=1000)
    neighbours: int = option(10, "covisible key frames whose landmarks take part in verification and fusion", ge=0, le=1000)
    fuse_max_distance: int = option(50, "descriptors that differ more are not one landmark [bits]", ge=1, le=256)
    edge_shared: int = option(30, "shared landmarks that make an edge of the pose graph", ge=1, le=20_000)
    edges_per_key_frame: int = option(10, "edges of the pose graph per key frame at most, closures and neighbours aside", ge=1, le=1000)
    closure_spacing: int = option(10, "no second closure is sought within this many key frames of one", ge=0, le=1_000_000)
    iterations: int = option(20, "rounds of each global bundle adjustment at most", ge=1, le=1000)
    join_closures: int = option(2, "closures that must agree on how two map segments lie before these are joined", ge=1, le=1000)
    main_segment: int = option(0, "map segment that the maps are made of; 0 = the largest", ge=0, le=1_000_000)
    final_refinement: bool = option(True, "once loops are closed, match every frame again against the final map")
    depth_icp_edges: int = option(
        6,
        "earlier key frames that each depth image is then aligned with; 0 = none",
        ge=0,
        le=50,
    )
    depth_icp_weight: float = option(2.0, "weight of those alignments in the last adjustment; in optimize it is 1", ge=1e-3, le=100)


@dataclass(frozen=True)
class SurfaceConfig:
    """How a depth image is cleaned; densify and octree each have these options."""

    edge: int = option(2, "readings at most this far from a depth jump are dropped [px]", ge=1, le=20)
    window: float = option(2.0, "half width of the smoothing window, per metre of distance [px/m]", ge=0, le=20)
    max_angle_deg: float = option(78.0, "surfaces seen at a larger angle to the normal are dropped [degrees]", gt=0, lt=90)


@dataclass(frozen=True)
class DensifyConfig(SurfaceConfig):
    """The coloured cloud."""

    method: str = option("voxel", "voxel averages, or a surface by Open3D (slower; mesh.ply too)", choices=("voxel", "tsdf"))
    voxel: float = option(0.01, "voxel side of the cloud [m]", ge=1e-3, le=1)
    stride: int = option(2, "every stride-th row and column of a depth image is used", ge=1, le=64)
    depth_max: float = option(4.0, "farther readings are ignored [m]", ge=0.01, le=100)
    even_colours: bool = option(False, "even out exposure, white balance and vignetting of key frames; reads images twice")
    min_points: int = option(1, "voxels with fewer readings are dropped", ge=1, le=1_000_000)
    neighbours: int = option(6, "stray points are found by their mean distance to this many neighbours; 0 keeps all", ge=0, le=100)
    max_deviation: float = option(
        2.0, "points whose mean distance is this many standard deviations above average are dropped", ge=0.01, le=1000
    )


@dataclass(frozen=True)
class GroundConfig:
    """How the floor is found."""

    method: str = option("robust", "lowest horizontal plane, or the paper's frequent gradients and RANSAC", choices=("robust", "paper"))
    stride: int = option(8, "side of the blocks of pixels that are averaged to one point [px]", ge=1, le=64)
    max_range: float = option(5.0, "farther readings are ignored [m]", ge=0.01, le=100)
    distance: float = option(0.02, "inliers lie within this of the plane, twice the depth noise added [m]", ge=1e-4, le=1)
    min_cosine: float = option(0.94, "cosine of the tilt up to which a surface counts as horizontal", gt=0, lt=1)
    min_patches: int = option(50, "a floor has at least this many blocks in all key frames", ge=3, le=1_000_000)
    min_share: float = option(0.01, "a floor has at least this share of the upward-facing blocks", ge=0, le=1)
    max_below: float = option(0.05, "a floor has at most this share of its blocks below it", ge=0, le=1)
    min_height: float = option(0.05, "the camera is at least this high above the floor [m]", ge=0, le=100)
    middle: float = option(0.6, "paper: share of the image's width and height taken around its middle", gt=0, le=1)
    gradient_bin: float = option(0.01, "paper: bin side of the gradient histogram [m]", ge=1e-3, le=1)
    rounds: int = option(200, "paper: RANSAC rounds", ge=1, le=100000)


@dataclass(frozen=True)
class OctreeConfig(SurfaceConfig):
    """The occupancy octree."""

    resolution: float = option(0.05, "leaf side [m]", ge=1e-3, le=10)
    frames: str = option(
        "auto",
        "frames inserted: key frames, all, or key frames and those where something vanished",
        choices=("auto", "key", "all"),
    )
    stride: int = option(4, "every stride-th row and column of a depth image is used", ge=1, le=64)
    max_range: float = option(3.2, "rays are cut off here: a Kinect's noise reaches a third of a cell [m]", ge=0.01, le=1000)
    hit: float = option(0.7, "probability of a cell in which a ray ends", gt=0.5, lt=1)
    miss: float = option(0.4, "probability of a cell that a ray passes", gt=0, lt=0.5)
    clamp_min: float = option(0.1192, "least probability of a cell", gt=0, lt=0.5)
    clamp_max: float = option(0.971, "greatest probability of a cell; the lower, the sooner a moved object fades", gt=0.5, lt=1)
    parents: str = option("max", "value of an inner node: the largest of its children, or their mean", choices=("max", "mean"))


@dataclass(frozen=True)
class GridConfig:
    """The 2-D grid."""

    resolution: float = option(0.05, "cell side [m]", ge=1e-3, le=10)
    source: str = option("points", "what the grid is made from: depth images, or the octree", choices=("points", "octree"))
    band_low: float = option(0.05, "the robot drives over what is lower [m]", ge=0, le=10)
    max_slope: float = option(8.0, "ramps that are no steeper are floor; 0 = level floor only [degrees]", ge=0, le=45)
    band_high: float = option(0.5, "the robot's height: what is higher is passable [m]", ge=1e-3, le=100)
    drop: float = option(0.08, "an edge: a cell through whose floor something this much deeper was seen [m]", ge=1e-3, le=10)
    spacing: float = option(0.12, "a frame is used when the camera has moved this far since the last [m]", ge=1e-4, le=100)
    spacing_deg: float = option(12.0, "a frame is used when the camera has turned this far since the last [degrees]", gt=0, le=180)
    stride: int = option(2, "every stride-th row and column of a depth image is used", ge=1, le=64)
    min_range: float = option(0.3, "nearer readings are ignored [m]", ge=0, le=100)
    max_range: float = option(4.0, "farther readings are ignored [m]", ge=0.01, le=100)
    extend_down: bool = option(True, "an upright surface that leaves the picture downwards is taken to reach the floor")
    own_body: bool = option(True, "leave out what shows the same near depth in every view: the robot's body")
    mask: str = option("", "picture of depth's size; where it is not black, depth is left out", is_file=True)
    driven: float = option(0.0, "floor this near the camera's path is free, on a robot; 0 = off [m]", ge=0, le=5)
    n_low: int = option(4, "n_l of (20): a cell with fewer points in a view is empty", ge=1, le=1_000_000)
    n_high: int = option(12, "n_h of (20): a cell with more points in a view is occupied", ge=1, le=1_000_000)
    update: str = option("evidence", "how views add up: log-odds, or (22), (23) as printed", choices=("evidence", "paper"))
    p_empty_empty: float = option(0.9, "P(E1|E2) of (22)", gt=0, lt=1)
    p_full_empty: float = option(0.1, "P(F1|E2) of (22)", gt=0, lt=1)
    blend: float = option(0.5, "lambda of (23)", ge=0, le=1)
    p_floor: float = option(0.01, "probabilities are kept this far from 0 and 1", gt=0, lt=0.5)
    m_low: float = option(0.05, "m_l of (24): cells below are free; 0.05 asks for two views", gt=0, lt=1)
    m_high: float = option(0.6, "m_h of (24): occupied above", gt=0, lt=1)


@dataclass(frozen=True)
class RobotConfig:
    """The robot that the grid is for, as plan and export-grid need it; its height and what it climbs stand in grid2d."""

    radius: float = option(0.2, "radius of the circle that the robot fits into [m]", ge=0, le=100)
    mount: str = option("", "the camera on the robot's base as a URDF origin: x,y,z,roll,pitch,yaw [m, rad]")


@dataclass(frozen=True)
class Config:
    """Every section."""

    seed: int = option(0, "seed of every random draw: the same seed gives the same bytes", ge=0, le=2**63 - 1)
    camera: dict[str, float | str] = field(default_factory=dict)  # what of the recording's calibration is overridden: keys of Camera
    run: RunConfig = field(default_factory=RunConfig)
    recording: RecordingConfig = field(default_factory=RecordingConfig)
    sensor: SensorConfig = field(default_factory=SensorConfig)
    extract: ExtractConfig = field(default_factory=ExtractConfig)
    match: MatchConfig = field(default_factory=MatchConfig)
    track: TrackConfig = field(default_factory=TrackConfig)
    optimize: OptimizeConfig = field(default_factory=OptimizeConfig)
    loop: LoopConfig = field(default_factory=LoopConfig)
    densify: DensifyConfig = field(default_factory=DensifyConfig)
    ground: GroundConfig = field(default_factory=GroundConfig)
    octree: OctreeConfig = field(default_factory=OctreeConfig)
    grid2d: GridConfig = field(default_factory=GridConfig)
    robot: RobotConfig = field(default_factory=RobotConfig)
