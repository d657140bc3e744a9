"""What the options of densify, ground and octree do, in the direction that their help promises."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import boxroom
import numpy as np
import pytest
from boxroom import KINECT, READING, kinect_noise, look_along

from slamcli import artifacts
from slamcli.config.options import Config, DensifyConfig, GroundConfig, OctreeConfig, SensorConfig, SurfaceConfig
from slamcli.dense.occupancy import log_odds
from slamcli.depth import oriented_points
from slamcli.formats import cloud, octomap
from slamcli.geometry import se3
from slamcli.navigation import floor_paper, surface_patches
from slamcli.navigation.floor import find_ground
from slamcli.schema import FrameTimes, Ground, Map, Moving, Timing, Tracks
from slamcli.stages import densify, octree

BOX = (((2.2, 1.4, 0.0), (2.8, 2.2, 0.6)),)


class Recording(SimpleNamespace):
    """A few noisy depth images of the analytic room, each brighter than the one before."""

    def __len__(self) -> int:
        return len(self.images)


class Drive:
    """What densify and octree are given: key frames at their true poses."""

    workers = 1

    def __init__(self, runs: Path, n: int = 3) -> None:
        T_lc = np.array([look_along([1.0 + 0.05 * k, 1.5, 0.6], 0.1, 0.35) for k in range(n)])
        T_wk, kf, none = se3.inverse(T_lc[0]) @ T_lc, np.arange(n, dtype=np.int32), np.zeros(0)
        stamp = kf / 30.0
        self.runs, self.warnings = runs, []
        self._records = {
            FrameTimes: SimpleNamespace(stamp=stamp, depth_stamp=stamp),
            Map: Map(kf, 0 * kf, T_wk, none.reshape(0, 3), none.astype("i4"), none.astype("i4"), none.astype("i8")),
            Tracks: Tracks(kf, np.tile(np.eye(4), (n, 1, 1)), none, none),
            Timing: Timing(np.array(0.0), np.array(0.0), np.array(0.0), np.zeros((n, 6))),
            Moving: Moving(),
        }
        rng = np.random.default_rng(0)
        images = [kinect_noise(boxroom.render(T, boxes=BOX), rng) for T in T_lc]
        self.dataset = Recording(
            images=images,
            camera=KINECT,
            depth=lambda i, camera: images[i],
            rgb=lambda i: np.full((120, 160, 3), 80 + 40 * i, np.uint8),
        )

    def camera(self, stage: str = "extract"):
        return KINECT

    def load(self, cls: type, stage: str):
        return artifacts.load(cls, self.runs / stage) if cls is Ground else self._records[cls]

    def progress(self, items, label, total=None):
        return items

    def warn(self, message: str) -> None:
        self.warnings.append(message)

    def rng(self) -> np.random.Generator:
        return np.random.default_rng(0)


def config(**sections) -> Config:
    usual = Config(
        densify=DensifyConfig(stride=2, voxel=0.02),
        ground=GroundConfig(stride=4),
        octree=OctreeConfig(stride=2),
    )
    return replace(usual, **{name: replace(getattr(usual, name), **options) for name, options in sections.items()})


def densified(folder: Path, **options) -> SimpleNamespace:
    """Run densify; returns the points and colours of its cloud."""
    out = folder / "-".join(map(str, options.values())) / "densify"
    out.mkdir(parents=True)
    densify.run(drive := Drive(out.parent), out, config(densify=options), drive)
    xyz, rgb, _ = cloud.read(out / "cloud.ply")
    return SimpleNamespace(xyz=xyz, rgb=rgb, n=len(xyz))


def octreed(folder: Path, n: int = 1, **options):
    """Run octree on n key frames; returns what it wrote."""
    out = folder / "-".join(map(str, options.values())) / "octree"
    (out.parent / "densify").mkdir(parents=True)
    out.mkdir()
    cfg, drive = config(octree=options), Drive(out.parent, n)
    densify.run(drive, out.parent / "densify", cfg, drive)
    octree.run(drive, out, cfg, drive)
    return octomap.read(out / "map.ot")


# how a depth image is cleaned


def cleaned(kind: type[SurfaceConfig], depth: np.ndarray, **options) -> oriented_points.Surface:
    return oriented_points.surface(depth, KINECT, settings=kind(**options), sensor=SensorConfig(), stride=1, spacing=0.0)


@pytest.mark.shows("densify.edge", "octree.edge")
@pytest.mark.parametrize("kind", [DensifyConfig, OctreeConfig])
def test_readings_so_near_an_edge_are_dropped(kind: type[SurfaceConfig]) -> None:
    depth = np.full((120, 160), 3.0, np.float32)
    depth[:, :80] = 1.0
    for edge in (1, 6):
        column = cleaned(kind, depth, edge=edge).pixel % 160
        assert not ((column >= 80 - edge) & (column < 80 + edge)).any() and {79 - edge, 80 + edge} <= set(column.tolist())


@pytest.mark.shows("densify.window", "octree.window")
@pytest.mark.parametrize("kind", [DensifyConfig, OctreeConfig])
def test_a_wider_window_smooths_more(kind: type[SurfaceConfig]) -> None:
    noisy = (3.0 + np.random.default_rng(0).normal(0, 0.012, (120, 160))).astype(np.float32)
    error = [cleaned(kind, noisy, window=window).xyz_c[:, 2].std() for window in (0.0, 2.0)]
    assert 0.001 < error[1] < 0.5 * error[0]


@pytest.mark.shows("densify.max_angle_deg", "octree.max_angle_deg")
@pytest.mark.parametrize("kind", [DensifyConfig, OctreeConfig])
def test_surfaces_seen_more_slantingly_are_dropped(kind: type[SurfaceConfig]) -> None:
    floor = boxroom.render(look_along([4.0, 2.5, 0.6], 0.0, 0.4), boxes=(), room=((-90, -90, 0), (90, 90, 90)))
    for angle in (60.0, 80.0):
        seen = cleaned(kind, floor, max_angle_deg=angle)
        cosine = -(seen.normal_c * seen.xyz_c).sum(axis=1) / np.linalg.norm(seen.xyz_c, axis=1)
        assert np.cos(np.radians(angle + 0.1)) <= cosine.min() < np.cos(np.radians(angle - 4.0))


# densify


@pytest.mark.shows("densify.voxel")
def test_larger_voxels_make_fewer_points(tmp_path: Path) -> None:
    fine, coarse = (densified(tmp_path, voxel=side) for side in (0.02, 0.1))
    assert coarse.n < 0.3 * fine.n


@pytest.mark.shows("densify.stride")
def test_a_stride_leaves_rows_and_columns_out(tmp_path: Path) -> None:
    dense, sparse = (densified(tmp_path, stride=stride) for stride in (1, 4))
    assert sparse.n < 0.4 * dense.n


@pytest.mark.shows("densify.depth_max")
def test_farther_readings_are_ignored_by_densify(tmp_path: Path) -> None:
    reach = [np.linalg.norm(densified(tmp_path, depth_max=most).xyz[:, :2], axis=1).max() for most in (2.0, 4.0)]
    assert reach[0] < 2.4 < reach[1]


@pytest.mark.shows("densify.min_points")
def test_voxels_with_few_readings_are_dropped(tmp_path: Path) -> None:
    every, well_seen = (densified(tmp_path, min_points=n, neighbours=0).n for n in (1, 3))
    assert 0 < well_seen < 0.7 * every


@pytest.mark.shows("densify.neighbours", "densify.max_deviation")
def test_stray_points_are_dropped_the_more_the_less_deviation_is_allowed(tmp_path: Path) -> None:
    every, few_dropped, many_dropped = (
        densified(tmp_path, **options).n for options in ({"neighbours": 0}, {"max_deviation": 3.0}, {"max_deviation": 0.5})
    )
    assert many_dropped < few_dropped < every


@pytest.mark.shows("densify.even_colours")
def test_even_colours_take_the_exposure_out(tmp_path: Path) -> None:
    uneven, even = (densified(tmp_path, even_colours=is_even).rgb.astype(float).std() for is_even in (False, True))
    assert even < 0.3 * uneven


# ground


VIEWS = [look_along([2.5 + 0.1 * i, 3.0, 0.6], 0.3 * i, 0.4) for i in range(6)]
OVER_A_TABLE = [look_along([5.8 + 0.02 * i, 2.0, 1.3], a, 1.2) for i, a in enumerate(np.arange(0.0, 3.0, 0.3))]


def ground(views: list[np.ndarray] = VIEWS, boxes: tuple = boxroom.FURNITURE, **options) -> Ground:
    rng = np.random.default_rng(0)
    frames = [(kinect_noise(boxroom.render(T, boxes=boxes), rng), T) for T in views]
    settings = GroundConfig(**{"stride": 4, **options})
    return find_ground(frames, KINECT, T_wc=views[0], settings=settings, noise=READING, rng=np.random.default_rng(0))


@pytest.mark.shows("ground.stride", "ground.max_range", "ground.min_patches", "ground.min_height", "ground.min_cosine")
@pytest.mark.parametrize(
    "options",
    [
        {"stride": 60},  # two blocks by two are too few
        {"max_range": 0.5},
        {"min_patches": 10**6},
        {"min_height": 0.9},
        {"min_cosine": 1.0 - 1e-9},
    ],
    ids=str,
)
def test_a_floor_that_does_not_meet_a_bound_is_none(options: dict) -> None:
    assert ground().is_found and not ground(**options).is_found


@pytest.mark.shows("ground.distance")
def test_inliers_lie_so_near_the_plane() -> None:
    carpet = (((2.5, 2.0, 0.0), (4.0, 4.0, 0.05)),)
    strict, loose = (ground(boxes=carpet, distance=width) for width in (0.005, 0.1))
    assert 0.0 < strict.inlier_rms < 0.7 * loose.inlier_rms and strict.inlier_share < loose.inlier_share - 0.1


@pytest.mark.shows("ground.min_share")
def test_a_floor_has_its_share_of_what_faces_up() -> None:
    assert ground(OVER_A_TABLE).is_found and not ground(OVER_A_TABLE, min_share=0.45).is_found


@pytest.mark.shows("ground.max_below")
def test_a_table_is_no_floor_unless_much_may_lie_below_it() -> None:
    """The floor around the table is too little to be found itself."""
    strict, lax = (ground(OVER_A_TABLE, min_share=0.45, max_below=share) for share in (0.05, 10.0))
    assert not strict.is_found and lax.is_found and lax.T_lw[2, 3] < -0.6


def on_paper(seed: int = 0, **options):
    rng = np.random.default_rng(0)
    frames = [(kinect_noise(boxroom.render(T), rng), T) for T in VIEWS]
    patches, _ = surface_patches.collect(frames, KINECT, side=4, max_range=5.0, noise=READING)
    settings, up = GroundConfig(**options), np.array([0.0, 0.0, 1.0])
    rows = floor_paper.ground_points(patches, up, settings=settings)
    return rows, floor_paper.paper_plane(patches, up, settings=settings, rng=np.random.default_rng(seed))


@pytest.mark.shows("ground.middle")
def test_the_papers_floor_is_sought_in_the_middle_of_the_image() -> None:
    assert len(on_paper(middle=0.3)[0]) < 0.6 * len(on_paper(middle=1.0)[0])


@pytest.mark.shows("ground.gradient_bin")
def test_finer_bins_of_the_gradient_hold_fewer_points() -> None:
    assert len(on_paper(gradient_bin=0.003)[0]) < 0.6 * len(on_paper(gradient_bin=0.03)[0])


@pytest.mark.shows("ground.rounds")
def test_more_rounds_find_a_plane_of_more_inliers() -> None:
    few, many = (
        min(0 if (plane := on_paper(seed, rounds=n, gradient_bin=0.1)[1]) is None else len(plane.inliers) for seed in range(8))
        for n in (1, 60)
    )
    assert few < 0.95 * many


# octree


@pytest.mark.shows("octree.resolution")
def test_the_leaves_are_as_large_as_asked_for(tmp_path: Path) -> None:
    fine, coarse = (octreed(tmp_path, resolution=side) for side in (0.05, 0.2))
    assert coarse.resolution == 0.2 and len(coarse) < 0.2 * len(fine)


@pytest.mark.shows("octree.stride")
def test_a_stride_leaves_rays_out(tmp_path: Path) -> None:
    dense, sparse = (octreed(tmp_path, stride=stride).is_occupied().sum() for stride in (1, 8))
    assert sparse < 0.5 * dense


@pytest.mark.shows("octree.max_range")
def test_rays_are_cut_off_so_far_away(tmp_path: Path) -> None:
    for most in (1.5, 3.0):
        reach = np.linalg.norm(octreed(tmp_path, max_range=most).centre - [0.0, 0.0, 0.6], axis=1).max()
        assert 0.9 * most < reach < most + 0.1


@pytest.mark.shows("octree.hit", "octree.miss")
def test_one_scan_gives_cells_the_probabilities_of_a_hit_and_a_miss(tmp_path: Path) -> None:
    tree = octreed(tmp_path, hit=0.8, miss=0.35)
    np.testing.assert_allclose(np.unique(tree.log_odds), [log_odds(0.35), log_odds(0.8)], rtol=1e-5)


@pytest.mark.shows("octree.clamp_min", "octree.clamp_max")
def test_the_probability_of_a_cell_stays_within_its_clamps(tmp_path: Path) -> None:
    tree = octreed(tmp_path, n=3, clamp_min=0.38, clamp_max=0.75)
    assert tree.log_odds.min() == pytest.approx(log_odds(0.38), rel=1e-5) and tree.log_odds.max() == pytest.approx(log_odds(0.75), rel=1e-5)


@pytest.mark.shows("octree.parents")
def test_an_inner_node_is_the_largest_or_the_mean_of_its_children(tmp_path: Path) -> None:
    """The root comes first, and all else is below it."""
    root = {}
    for parents in ("max", "mean"):
        leaves = octreed(tmp_path, parents=parents)
        data = (tmp_path / parents / "octree" / "map.ot").read_bytes()
        root[parents] = float(np.frombuffer(data[data.index(b"data\n") + 5 :], dtype=octomap.NODE)["log_odds"][0])
    assert root["max"] == pytest.approx(float(leaves.log_odds.max())) and root["mean"] < root["max"]


@pytest.mark.shows("octree.frames")
def test_key_frames_alone_or_all_frames_are_inserted(tmp_path: Path) -> None:
    inputs = Drive(tmp_path)
    (tmp_path / "densify").mkdir()
    densify.run(inputs, tmp_path / "densify", config(), inputs)
    kfs = np.arange(1, dtype=np.int32)
    map_, tracks = inputs._records[Map], inputs._records[Tracks]
    inputs._records[Map] = replace(map_, kf_frame=kfs, kf_segment=kfs, T_wk=map_.T_wk[:1])
    inputs._records[Tracks] = replace(tracks, ref_kf=np.zeros(3, np.int32), T_kc=map_.T_wk)
    n = [sum(len(poses) for poses in octree.rounds(inputs, None, OctreeConfig(frames=which))) for which in ("key", "all")]
    assert n == [1, 3]
