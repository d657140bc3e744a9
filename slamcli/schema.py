"""The core types. Each is a frozen record of arrays and, saved as a folder of `.npy`, also an artefact's schema.

F frames, M features, P pairs, Q matches, W words, K key frames, L landmarks, O observations, E edges, C closures, R rests.
v x u blocks of a view, H x W cells of the grid, N poses of a trajectory, D recordings.
Missing values: depth and pose NaN, index -1. `offset` columns delimit ragged rows: those of frame i are offset[i]:offset[i+1].
"""

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from slamcli.errors import SlamError
from slamcli.hints import hint

FORMAT = 9  # of everything a run directory holds; raised whenever an array or a seal changes its meaning


LARGEST = 1e9  # of any number that declares no other bound: beyond, squares and grid cells are no numbers
LARGEST_STAMP = 1e19  # [s] either way; what a list may hold in any unit
LARGEST_INFORMATION = 1e30  # [1/m^2, 1/rad^2]
MOST_LEVELS = 16  # of an image pyramid
MOST_NODES = 1 << 22  # of a vocabulary
MOST_ROWS = 16384  # and columns of an image
NOT_RIGID = 1e-3  # how far columns of a rotation may be from orthonormal: files hold them as products that were rounded
LENGTHS = (
    ("stamp", "F"),
    ("word_offset", "F+1"),
    ("octave", "M"),
    ("kf_frame", "K"),
    ("lm_xyz", "L"),
)  # which field tells a length to those of other types


@dataclass(frozen=True)
class Values:
    """What the values of a field may be. It is compared when they are loaded: a run may come from someone else, and kernels believe what they are given."""

    least: float | None = None  # LARGEST either way for real numbers where nothing is said, any for whole ones
    most: float | None = None
    below: str = ""  # symbol of a length: the values number such rows, from 0 where `least` says no less
    delimits: str = ""  # symbol of a length: the values begin with 0, never decrease and end with it
    is_sorted: bool = False  # whether they never decrease
    nan: bool = False  # whether NaN may stand for what is missing; of a (4, 4), else a rigid motion, the first three rows are NaN then


ANY, OR_NAN, NATURAL = Values(), Values(nan=True), Values(least=0)
STAMP_OR_NAN = Values(least=-LARGEST_STAMP, most=LARGEST_STAMP, nan=True)
STAMP = replace(STAMP_OR_NAN, nan=False, is_sorted=True)


def array(
    dtype: str, shape: str, meaning: str, *, values: Values = ANY, may_lack: bool = False, narrow: str = "", widen: bool = False
) -> Any:
    """Declare a field: numpy dtype, symbolic shape such as "M 2" or "F+1" ("" for a scalar), meaning with unit.

    values : what they may be
    may_lack : where the field is not given, it has no rows
    narrow : whole-number dtypes such as "u1 u2", the narrowest first: it is saved, and loaded, as the first of them that holds all values
    widen : it is loaded in the dtype declared, into memory: for arrays that a stage reads whole
    """
    symbols, of = tuple(shape.split()), np.dtype(dtype)
    narrower = tuple(np.dtype(one) for one in narrow.split())
    if of.kind == "f":
        least, most = (-LARGEST if values.least is None else values.least), (LARGEST if values.most is None else values.most)
        values = replace(values, least=least, most=most)
    elif values.below and values.least is None:
        values = replace(values, least=0)
    metadata = {"dtype": of, "narrow": narrower, "widen": widen, "shape": symbols, "meaning": meaning, "values": values}
    if may_lack:
        return field(default_factory=lambda: np.zeros([int(s) if s.isdigit() else 0 for s in symbols], dtype), metadata=metadata)
    return field(metadata=metadata)


@dataclass(frozen=True)
class Features:
    """Key points of every frame, by extract."""

    stamp: np.ndarray = array("f8", "F", "s, of the colour image", values=STAMP)
    depth_stamp: np.ndarray = array("f8", "F", "s, of the depth image paired with it, NaN where there is none", values=STAMP_OR_NAN)
    offset: np.ndarray = array("i8", "F+1", "feature rows of a frame", values=Values(delimits="M"))
    xy: np.ndarray = array("f4", "M 2", "px, undistorted, column then row")
    depth: np.ndarray = array("f4", "M", "m along the optical axis, NaN where there is none; read at the raw pixel", values=OR_NAN)
    slope: np.ndarray = array("f4", "M 2", "1/m/px, growth of inverse depth to the right and downwards, 0 = unknown")
    octave: np.ndarray = array("u1", "M", "pyramid level", values=Values(most=MOST_LEVELS - 1))
    angle: np.ndarray = array("f4", "M", "rad, of the intensity centroid")
    desc: np.ndarray = array("u1", "M 32", "ORB descriptor, 256 bits")
    octave_scale: np.ndarray = array("f8", "", "size ratio of neighbouring pyramid levels", values=Values(least=1, most=2))


@dataclass(frozen=True)
class FrameTimes:
    """When each frame's images were taken, by extract, and again by track, optimize and loop: their poses are read without features."""

    stamp: np.ndarray = array("f8", "F", "s, of the colour image", values=STAMP)
    depth_stamp: np.ndarray = array("f8", "F", "s, of the depth image paired with it, NaN where there is none", values=STAMP_OR_NAN)


@dataclass(frozen=True)
class CoarseDepth:
    """Coarse depth images, by extract: enough to align shapes, on which places without texture are tracked."""

    coarse_shape: np.ndarray = array(
        "i4", "2", "rows and columns of an image; a pixel is the middle of a block of pixels", values=Values(least=0, most=MOST_ROWS)
    )
    coarse_offset: np.ndarray = array("i8", "F+1", "bytes of a frame", values=Values(delimits="C"))
    coarse_code: np.ndarray = array("u1", "C", "images of uint16, 2e-4 m along the optical axis, 0 = none, in RVL code (formats/rvl.py)")


@dataclass(frozen=True)
class Flow:
    """Where key points went by optical flow, by extract where it is asked for."""

    flow_xy: np.ndarray = array(
        "f4", "M 2", "px, undistorted, of each feature in the frame that follows its own, NaN = lost", may_lack=True, values=OR_NAN
    )


@dataclass(frozen=True)
class Words:
    """The visual words of every feature, by match. With the words' weights they make a frame's bag-of-words vector.

    Features that have a node near the root of the vocabulary in common are compared: that above their word, or a second that is hardly farther.
    """

    idf: np.ndarray = array("f4", "W", "inverse document frequency of each word of the vocabulary", values=NATURAL)
    word_offset: np.ndarray = array("i8", "F+1", "feature rows of a frame", values=Values(delimits="M"))
    word: np.ndarray = array("i4", "M", "word of each feature row", narrow="u2", values=Values(below="W"))
    word_node: np.ndarray = array("i4", "W", "node near the root above each word", narrow="u1 u2", values=Values(least=0, most=MOST_NODES))
    second_node: np.ndarray = array(
        "i4", "M", "second node near the root of each feature row, -1 = none", narrow="i1 i2", values=Values(least=-1, most=MOST_NODES)
    )

    def node(self, rows: slice | np.ndarray) -> np.ndarray:
        """Return the first and the second node (N, 2) int32 of feature rows, -1 = no second."""
        second = self.second_node[rows]
        both = np.empty((len(second), 2), dtype=np.int32)
        both[:, 0], both[:, 1] = self.word_node.take(self.word[rows]), second
        return both


@dataclass(frozen=True)
class Matches:
    """Feature matches between neighbouring frames, by match."""

    pair: np.ndarray = array("i4", "P 2", "frames (i, j), j < i, sorted", values=Values(below="F"))
    offset: np.ndarray = array("i8", "P+1", "match rows of a pair", values=Values(delimits="Q"))
    row: np.ndarray = array("i4", "Q 2", "feature index within frame i and within frame j", narrow="u2", values=NATURAL)


LOST, TRACKED, KEY_FRAME, RELOCALIZED, ON_DEPTH = range(5)  # values of Tracks.state


@dataclass(frozen=True)
class Tracks:
    """Each frame's pose relative to a key frame, by track and, refined against the final map, by loop; map updates move the frames along."""

    ref_kf: np.ndarray = array("i4", "F", "row in Map of the key frame a frame hangs on, -1 = lost", values=Values(least=-1, below="K"))
    T_kc: np.ndarray = array("f8", "F 4 4", "frame's camera to that key frame's camera, NaN = lost", values=OR_NAN)
    state: np.ndarray = array(
        "u1", "F", "0 lost, 1 tracked, 2 key frame, 3 relocalized, 4 tracked on the shape that depth shows", values=Values(most=ON_DEPTH)
    )
    n_inliers: np.ndarray = array("i4", "F", "landmarks the pose rests on", values=NATURAL)


@dataclass(frozen=True)
class Map:
    """Key frames, landmarks and the observations that join them, and edges between key frames that shape joins.

    Where tracking was lost for good, a new segment begins. Each has a world of its own, and nothing joins two segments: key frames and
    landmarks of one cannot be compared with those of another. Segment 0 is the one that most frames belong to.
    """

    kf_frame: np.ndarray = array("i4", "K", "frame index, increasing", values=Values(below="F", is_sorted=True))
    kf_segment: np.ndarray = array("i4", "K", "segment a key frame belongs to", values=Values(below="K"))
    T_wk: np.ndarray = array("f8", "K 4 4", "key frame's camera to its segment's world, the camera of its first frame with a pose")
    lm_xyz: np.ndarray = array("f8", "L 3", "m, world")
    obs_lm: np.ndarray = array(
        "i4", "O", "sorted by (landmark, key frame), pairs unique", narrow="u2", widen=True, values=Values(below="L", is_sorted=True)
    )
    obs_kf: np.ndarray = array("i4", "O", "row in kf_frame", narrow="u1 u2", widen=True, values=Values(below="K"))
    obs_row: np.ndarray = array("i8", "O", "row in Features", narrow="u4", widen=True, values=Values(below="M"))
    edge_kf: np.ndarray = array(
        "i4", "E 2", "key frames (i, j), j < i, whose depth images were aligned", may_lack=True, values=Values(below="K")
    )
    edge_T_ij: np.ndarray = array("f8", "E 4 4", "x_i = T_ij @ x_j, as aligned", may_lack=True)
    edge_information: np.ndarray = array(
        "f8",
        "E 6 6",
        "1/m^2, 1/rad^2, of the left twist of T_ij",
        may_lack=True,
        values=Values(least=-LARGEST_INFORMATION, most=LARGEST_INFORMATION),
    )


@dataclass(frozen=True)
class Moving:
    """What moves in each frame's view, by track and, as the final poses show it, by loop: no map shows it and no pose rests on it.

    Rows v and columns u are of square blocks of the undistorted colour image. Without rows nothing moves.
    """

    moving: np.ndarray = array("?", "F v u", "whether what a block shows moves", may_lack=True)


@dataclass(frozen=True)
class Rests:
    """When the camera stood still, by track: the frames of a rest have one pose, and none between the first and the last is tracked."""

    rest_span: np.ndarray = array("i4", "R 2", "first and last frame of a rest, in order", may_lack=True, values=Values(below="F"))


@dataclass(frozen=True)
class Doubt:
    """How far each frame's pose can be trusted, by loop."""

    contradicted: np.ndarray = array("f4", "F", "share of the surface seen that other views look through, NaN = unknown", values=OR_NAN)
    disagreement: np.ndarray = array(
        "f4", "F", "m, between the motion within half a second as track and as loop found it, NaN = unknown", values=OR_NAN
    )
    sigma: np.ndarray = array("f4", "F", "m, standard deviation of the position beside the frames around, NaN = lost", values=OR_NAN)
    drift: np.ndarray = array("f4", "F", "m, the same beside the best held part of the recording, where things move; else 0")
    is_doubtful: np.ndarray = array("?", "F", "whether the run does not trust the pose; so of lost frames, which have none")

    @property
    def n_doubtful(self) -> int:
        """Return how many of the frames that have a pose are doubtful."""
        return int((self.is_doubtful & np.isfinite(self.sigma)).sum())


@dataclass(frozen=True)
class Timing:
    """When the camera measures, found by optimize from the recording itself."""

    readout: np.ndarray = array(
        "f8", "", "s, between the first and the last row of a colour image; 0 = global shutter; the stamp is the middle row's"
    )
    depth_readout: np.ndarray = array(
        "f8",
        "",
        "s, the same of a depth image; NaN = each recording of several has its own timing, which Measured is free of",
        values=OR_NAN,
    )
    depth_delay: np.ndarray = array(
        "f8",
        "",
        "s, by which depth images were taken later than their stamps say; NaN = depth is not moved to the colour stamp",
        values=OR_NAN,
    )
    twist: np.ndarray = array("f8", "F 6", "m/s, rad/s, motion of each frame's camera in its own frame", values=OR_NAN)

    @property
    def is_of_several(self) -> bool:
        """Say whether several recordings were measured, each with a timing of its own."""
        return bool(np.isnan(self.depth_readout))


@dataclass(frozen=True)
class Recordings:
    """Which frames are of which recording, by extract and loop of a run of several, whose frames are numbered through."""

    recording_offset: np.ndarray = array("i8", "D+1", "frames of a recording", values=Values(delimits="F"))
    own_stamp: np.ndarray = array(
        "f8",
        "F",
        "s, of the colour image in its recording; stamps of Features are of one time line for all",
        values=Values(most=LARGEST_STAMP),
    )


@dataclass(frozen=True)
class Measured:
    """What the features of several recordings measured, without rolling shutter and at the colour stamp, by optimize of a run of several."""

    measured_xy: np.ndarray = array("f4", "M 2", "px, undistorted, column then row")
    measured_depth: np.ndarray = array("f4", "M", "m along the optical axis, NaN where there is none", values=OR_NAN)


@dataclass(frozen=True)
class DepthTimes:
    """When depth was measured, by optimize and loop of a run of several recordings, as each has a delay of its own."""

    depth_time: np.ndarray = array(
        "f8", "F", "s, on the time line of Features; NaN = there is no depth, or it is not moved", values=STAMP_OR_NAN
    )


@dataclass(frozen=True)
class Closures:
    """Accepted loop closures, by loop."""

    closure_kf: np.ndarray = array("i4", "C 2", "key frames (i, j), j < i", values=Values(below="K"))
    closure_T_ij: np.ndarray = array("f8", "C 4 4", "x_i = T_ij @ x_j")
    closure_inliers: np.ndarray = array("i4", "C", "features that agree with T_ij", values=NATURAL)
    closure_score: np.ndarray = array("f4", "C", "similarity of the word vectors, [Z] (10)")


@dataclass(frozen=True)
class Ground:
    """The floor and the level frame `l` (z up, floor at z = 0), by densify."""

    T_lw: np.ndarray = array(
        "f8", "4 4", "world to level: origin below the first camera, x its heading; without a floor the first camera is at z = 0"
    )
    plane: np.ndarray = array("f8", "4", "a b c d of a x + b y + c z + d = 0 in the world frame, unit normal pointing up; [L] (17)")
    inlier_rms: np.ndarray = array("f8", "", "m, distance of the inliers to the plane", values=OR_NAN)
    inlier_share: np.ndarray = array("f8", "", "inliers among the candidate ground points", values=OR_NAN)
    is_found: np.ndarray = array("?", "", "whether a floor was found")


@dataclass(frozen=True)
class Grid:
    """The 2-D grid and what it was decided by, from grid2d. Row 0 is the smallest y, column 0 the smallest x."""

    p_occupied: np.ndarray = array("f4", "H W", "P(F), NaN where never seen", values=Values(least=0, most=1, nan=True))
    n_seen: np.ndarray = array("i4", "H W", "frames read that saw the cell", values=NATURAL)
    state: np.ndarray = array("i1", "H W", "1 occupied, 0 free, -1 unknown; [L] (24)", values=Values(least=-1, most=1))
    origin: np.ndarray = array("f8", "2", "m, level frame: x, y of the outer corner of cell (0, 0)")
    resolution: np.ndarray = array("f8", "", "m, side of a cell", values=Values(least=1e-4))


@dataclass(frozen=True)
class Trajectory:
    """Poses over time."""

    stamp: np.ndarray = array("f8", "N", "s, increasing", values=STAMP)
    T_wc: np.ndarray = array("f8", "N 4 4", "camera to world", values=OR_NAN)


def check_matches(matches: Matches, features: Features) -> None:
    """Raise SlamError where matches name a feature that its frame does not have."""
    has_any = matches.offset[1:] > matches.offset[:-1]
    most = np.maximum.reduceat(matches.row, matches.offset[:-1][has_any], axis=0) if has_any.any() else np.zeros((0, 2), np.int32)
    if (most >= np.diff(features.offset)[matches.pair[has_any]]).any():
        raise SlamError(f"matches are not of the features that extract left; make them anew with: {hint().force()}")


def check_seen_in(map_: Map, features: Features) -> None:
    """Raise SlamError where a map does not rest on these features, as one of the two was made anew since, or a landmark on none."""
    is_seen = len(map_.lm_xyz) == 0 or np.bincount(map_.obs_lm, minlength=len(map_.lm_xyz)).all()
    if not is_seen or map_.obs_row.max(initial=-1) >= len(features.octave) or map_.kf_frame.max(initial=-1) >= len(features.stamp):
        raise SlamError(f"the map rests on other features than those that extract left; bring it up to date with: {hint().force()}")


def frame_segments(tracks: Tracks, map_: Map) -> np.ndarray:
    """Return the map segment (F,) of every frame, -1 where lost."""
    return np.where(tracks.ref_kf >= 0, map_.kf_segment[tracks.ref_kf], -1) if len(map_.kf_segment) else np.full_like(tracks.ref_kf, -1)


def frame_poses(tracks: Tracks, map_: Map, segment: int = 0) -> np.ndarray:
    """Return T_wc (F, 4, 4) of every frame of a map segment under its key-frame poses, NaN for the lost and for those of other segments."""
    T_wc = np.full((len(tracks.ref_kf), 4, 4), np.nan)
    is_here = frame_segments(tracks, map_) == segment
    T_wc[is_here] = np.einsum(
        "nij,njk->nik", map_.T_wk[tracks.ref_kf[is_here]], tracks.T_kc[is_here]
    )  # not BLAS, whose digits follow the processor
    return T_wc


def poses_in_segments(tracks: Tracks, map_: Map) -> tuple[np.ndarray, np.ndarray]:
    """Return the map segment (F,) of every frame, -1 where it is lost, and T_wc (F, 4, 4) in the world of that segment, NaN where lost."""
    T_wc, has_pose = np.full((len(tracks.ref_kf), 4, 4), np.nan), tracks.ref_kf >= 0
    T_wc[has_pose] = np.einsum(
        "nij,njk->nik", map_.T_wk[tracks.ref_kf[has_pose]], tracks.T_kc[has_pose]
    )  # not BLAS, whose digits follow the processor
    return frame_segments(tracks, map_), T_wc


def trajectory(stamp: np.ndarray, tracks: Tracks, map_: Map, segment: int = 0) -> Trajectory:
    """Return the poses of the frames of a map segment."""
    T_wc = frame_poses(tracks, map_, segment)
    has_pose = np.isfinite(T_wc[:, 0, 0])
    return Trajectory(stamp=stamp[has_pose], T_wc=T_wc[has_pose])
