"""densify and octree on a simulated room of which everything is known, with true poses."""

import hashlib
import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace

import boxroom
import numpy as np
import pytest

from slamcli import artifacts
from slamcli.config.options import Config
from slamcli.datasets import open_dataset, silent
from slamcli.datasets.simulate import Simulation, build, simulate
from slamcli.dense import occupancy
from slamcli.formats import cloud, octomap
from slamcli.geometry import se3
from slamcli.schema import FrameTimes, Ground, Map, Moving, Timing, Tracks
from slamcli.slam import depth_views
from slamcli.stages import densify, octree
from slamcli.stages.depth_frames import DepthFrames, depth_poses

SETTINGS = {"seed": 1, "frames": 220, "laps": 2.0, "width": 160, "height": 120, "movable": True}
CFG = Config(
    densify=replace(Config().densify, stride=1, voxel=0.02),
    ground=replace(Config().ground, stride=2),
    octree=replace(Config().octree, stride=1),
)


class Inputs:
    """What the pipeline would give the two stages, from the truth; every fifth frame is a key frame."""

    def __init__(self, recording: Path, runs: Path, frames: slice = slice(None, None, 5)) -> None:
        self.dataset = open_dataset(str(recording))
        truth = self.dataset.ground_truth()
        self.T_wl = se3.inverse(truth.T_wc[0])  # the world is the first camera's frame, as it is after tracking
        T_wc = self.T_wl @ truth.T_wc
        n, none = len(self.dataset), np.zeros(0)
        kf = np.arange(n, dtype=np.int32)[frames]
        self._records = {
            FrameTimes: SimpleNamespace(stamp=self.dataset.stamp, depth_stamp=self.dataset.depth_stamp),
            Map: Map(kf, 0 * kf, T_wc[kf], none.reshape(0, 3), none.astype("i4"), none.astype("i4"), none.astype("i8")),
        }
        ref_kf = (np.arange(n, dtype=np.int32) // (frames.step or 1)).clip(max=len(kf) - 1)
        T_kc = se3.inverse(T_wc[kf])[ref_kf] @ T_wc
        T_kc[frames.stop if frames.stop else n :] = np.nan  # not tracked
        self._records[Tracks] = Tracks(ref_kf, T_kc, none, none)
        self._records[Timing] = Timing(np.array(0.0), np.array(0.0), np.array(0.0), np.zeros((n, 6)))
        self._records[Moving] = Moving()
        self.runs = runs

    def delay_depth(self, seconds: float) -> None:
        """Let the stamps of the depth images be early by this much, and optimize have found it out."""
        self._records[FrameTimes].depth_stamp = self._records[FrameTimes].depth_stamp - seconds
        self._records[Timing] = replace(self._records[Timing], depth_delay=np.array(seconds))

    def camera(self, stage: str = "extract"):
        return self.dataset.camera

    def load(self, cls: type, stage: str):
        return artifacts.load(cls, self.runs / stage) if cls is Ground else self._records[cls]

    def path(self, *names: str) -> Path:
        return self.runs.joinpath(*names)


class Tools:
    workers = 2

    def __init__(self) -> None:
        self.warnings: list[str] = []

    def progress(self, items, label, total=None):
        return items

    def warn(self, message: str) -> None:
        self.warnings.append(message)

    def rng(self) -> np.random.Generator:
        return np.random.default_rng(0)


@dataclass(frozen=True)
class Done:
    inputs: Inputs
    folder: Path
    summary: dict


def run_both(recording: Path, folder: Path, cfg: Config = CFG, frames: slice = slice(None, None, 5)) -> Done:
    inputs, summary = Inputs(recording, folder, frames), {}
    for name, stage in (("densify", densify), ("octree", octree)):
        (folder / name).mkdir(parents=True)
        summary[name] = stage.run(inputs, folder / name, cfg, Tools())
    return Done(inputs, folder, summary)


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return simulate(tmp_path_factory.mktemp("simulated") / "room", progress=silent, **SETTINGS)


@pytest.fixture(scope="module")
def done(recording: Path, tmp_path_factory: pytest.TempPathFactory) -> Done:
    return run_both(recording, tmp_path_factory.mktemp("run"))


@pytest.fixture(scope="module")
def distance() -> Callable[[np.ndarray], np.ndarray]:
    """Distance of points in the scene's frame to its true surfaces."""
    from slamcli.open3d_loader import load_open3d

    o3d = load_open3d()
    scene, _ = build(Simulation(**SETTINGS))
    corners = [
        (patch.polygon[0], patch.polygon[k], patch.polygon[k + 1]) for patch in scene.patches() for k in range(1, len(patch.polygon) - 1)
    ]
    vertex = np.array(corners, dtype=np.float32).reshape(-1, 3)
    surfaces = o3d.t.geometry.RaycastingScene()
    surfaces.add_triangles(o3d.core.Tensor(vertex), o3d.core.Tensor(np.arange(len(vertex), dtype=np.uint32).reshape(-1, 3)))
    return lambda xyz: surfaces.compute_distance(o3d.core.Tensor(np.ascontiguousarray(xyz, dtype=np.float32))).numpy()


def in_scene(done: Done, x_l: np.ndarray) -> np.ndarray:
    """Points of the run's level frame in the scene's."""
    T_lw = artifacts.load(Ground, done.folder / "densify").T_lw
    return se3.transform(se3.inverse(T_lw @ done.inputs.T_wl), np.asarray(x_l, dtype=np.float64))


def moved_box(recording: Path) -> tuple[np.ndarray, np.ndarray]:
    scene = json.loads((recording / "scene.json").read_text())
    box = next(piece for piece in scene["obstacles"] if piece["name"] == "moved_box")
    assert abs(np.sin(2 * box["yaw"])) < 1e-6
    size = np.array(box["size"])
    return np.array(box["centre"]), size[[1, 0, 2]] if abs(np.sin(box["yaw"])) > 0.5 else size


def test_the_cloud_lies_on_the_true_surfaces_and_its_normals_stand_on_them(done: Done, distance, recording: Path) -> None:
    xyz, rgb, normal = cloud.read(done.folder / "densify" / "cloud.ply")
    x = in_scene(done, xyz)
    centre, size = moved_box(recording)
    x, normal_scene = x[outside := (np.abs(x - centre) > 0.55 * size + 0.1).any(axis=1)], normal[outside]
    error = distance(x)
    assert len(x) > 30_000
    # Bounds for 160 x 120 pixels, of which a window covers four times as much as of 640 x 480.
    assert 0.001 < np.sqrt(np.mean(error**2)) < 0.012
    assert np.quantile(error, 0.95) < 0.025
    np.testing.assert_allclose(np.linalg.norm(normal, axis=1), 1.0, atol=1e-3)
    floor = np.abs(x[:, 2]) < 0.03
    assert np.median(normal_scene[floor, 2]) > 0.99
    assert rgb.std(axis=0).min() > 10


def test_the_floor_is_level_and_at_zero(done: Done) -> None:
    ground = artifacts.load(Ground, done.folder / "densify")
    T = ground.T_lw @ done.inputs.T_wl
    assert ground.is_found
    assert T[2, 2] > np.cos(np.radians(0.5))
    assert abs(T[2] @ [4.0, 2.5, 0.0, 1.0]) < 0.02


def test_the_octree_agrees_with_the_images_it_was_made_from(done: Done) -> None:
    tree = octomap.read(done.folder / "octree" / "map.ot")
    T_lw = artifacts.load(Ground, done.folder / "densify").T_lw
    poses = [(frame, T_lw @ T_wk) for frame, T_wk in depth_poses(done.inputs)]
    scans = octree.scans(DepthFrames(done.inputs.dataset, done.inputs.camera()), poses, CFG.sensor, CFG.octree)
    result = occupancy.accuracy(tree, scans, max_range=CFG.octree.max_range)
    assert 0.97 < result.share < 1.0
    assert result.unknown == 0


def test_the_floor_at_the_feet_of_what_moves_is_kept_but_not_what_it_stands_on(done: Done) -> None:
    dataset, camera = done.inputs.dataset, done.inputs.camera()
    T_lw = artifacts.load(Ground, done.folder / "densify").T_lw
    poses = [(frame, T_lw @ T_wk) for frame, T_wk in depth_poses(done.inputs)][::12]
    everything = np.ones((len(dataset), *depth_views.shape(camera)), dtype=bool)
    depths = DepthFrames(dataset, camera, Moving(everything))
    without, kept = (list(depths.look_at(poses, lambda _, depth, __: depth, floor=floor)) for floor in (None, 0.05))
    n_kept = n_under = 0
    for (frame, T_lk), depth, nothing in zip(poses, kept, without, strict=True):
        assert np.isnan(nothing[4:-4, 4:-4]).all()  # the mask ends before the picture does
        true = dataset.depth(frame, camera)
        x = T_lk[:3, :3] @ (true * np.dstack([camera.rays, np.ones_like(true)]).transpose(2, 0, 1)).reshape(3, -1) + T_lk[:3, 3:]
        is_hidden, is_floor = np.isnan(nothing).ravel() & np.isfinite(true).ravel(), np.abs(x[2]) <= 0.05
        place = [tuple(cell) for cell in np.floor(np.nan_to_num(x[:2].T) / 0.05).astype(int).tolist()]
        taken = {place[k] for k in np.flatnonzero(is_hidden & ~is_floor)}
        is_under = np.array([cell in taken for cell in place])
        wanted = is_hidden & is_floor & ~is_under
        np.testing.assert_array_equal(np.isfinite(depth).ravel() & is_hidden, wanted)
        n_kept, n_under = n_kept + wanted.sum(), n_under + (is_hidden & is_floor & is_under).sum()
    assert n_kept > 10_000 and n_under > 20


def test_the_depth_delay_that_optimize_found_is_taken_out_of_the_poses(recording: Path, tmp_path: Path) -> None:
    on_time, delayed = Inputs(recording, tmp_path), Inputs(recording, tmp_path)
    delayed.delay_depth(0.02)
    for (frame, T_wd), (same_frame, T_wd_delayed) in zip(depth_poses(on_time), depth_poses(delayed), strict=True):
        assert frame == same_frame
        np.testing.assert_allclose(T_wd_delayed, T_wd, atol=1e-12)
    delayed._records[Timing] = on_time._records[Timing]
    moved = [np.abs(a - b).max() for (_, a), (_, b) in zip(depth_poses(on_time), depth_poses(delayed), strict=True)]
    assert np.median(moved) > 1e-4


def in_the_box(run: Done, recording: Path) -> tuple[int, int]:
    """Occupied and free cells of the octree where the parcel stood."""
    centre, size = moved_box(recording)
    lower, upper = centre - 0.5 * size, centre + 0.5 * size
    tree = octomap.read(run.folder / "octree" / "map.ot")
    x = in_scene(run, tree.centre)
    inside = ((x > lower) & (x < upper + [0, 0, 0.03])).all(axis=1) & (x[:, 2] > 0.1)
    return int(tree.is_occupied()[inside].sum()), int((~tree.is_occupied()[inside]).sum())


@pytest.mark.parametrize(("frames", "most_left"), [("all", 0.15), ("auto", 0.15), ("key", 0.9)])
def test_an_object_that_is_taken_away_fades_from_the_octree(recording: Path, tmp_path: Path, frames: str, most_left: float) -> None:
    cfg, n = replace(CFG, octree=replace(CFG.octree, frames=frames)), len(open_dataset(str(recording)))
    stood = in_the_box(run_both(recording, tmp_path / "half", cfg, slice(0, n // 2, 5)), recording)
    run = run_both(recording, tmp_path / "whole", cfg, slice(0, n, 5))
    gone = in_the_box(run, recording)
    assert stood[0] > 80
    assert gone[0] < most_left * stood[0]
    assert gone[1] > 100
    if frames == "auto":
        assert n // 5 < run.summary["octree"]["scans"] < n // 2


def test_a_stage_run_again_writes_the_same_bytes(recording: Path, done: Done, tmp_path: Path) -> None:
    again = run_both(recording, tmp_path)
    for name in ("densify/cloud.ply", "octree/map.ot", "octree/map.bt"):
        digests = {hashlib.sha256((run.folder / name).read_bytes()).hexdigest() for run in (done, again)}
        assert len(digests) == 1, name
    assert again.summary == done.summary


def test_the_octrees_file_is_a_small_part_of_the_clouds(done: Done) -> None:
    size = {name: (done.folder / name).stat().st_size for name in ("densify/cloud.ply", "octree/map.ot", "octree/map.bt")}
    assert size["octree/map.bt"] < 0.032 * size["densify/cloud.ply"]
    assert size["octree/map.bt"] < 0.1 * size["octree/map.ot"]


@pytest.mark.shows("densify.method")
def test_a_surface_by_integration_is_as_good(recording: Path, distance, tmp_path: Path) -> None:
    volume = replace(CFG, densify=replace(CFG.densify, method="tsdf", voxel=0.03))
    run = run_both(recording, tmp_path, volume)
    mesh, points = cloud.read(run.folder / "densify" / "mesh.ply")[0], cloud.read(run.folder / "densify" / "cloud.ply")[0]
    assert np.array_equal(mesh, points)
    x = in_scene(run, mesh)
    centre, size = moved_box(recording)
    error = distance(x[(np.abs(x - centre) > 0.55 * size + 0.15).any(axis=1)])
    assert 0.001 < np.sqrt(np.mean(error**2)) < 0.02


class Broken:
    """A recording in which some frames have no depth and one cannot be read."""

    def __init__(self, dataset, without: set[int], unreadable: set[int]) -> None:
        self._dataset, self._without, self._unreadable = dataset, without, unreadable

    def __getattr__(self, name: str):
        return getattr(self._dataset, name)

    def __len__(self) -> int:
        return len(self._dataset)

    def depth(self, i: int, camera):
        from slamcli.errors import BadFrame

        if i in self._unreadable:
            raise BadFrame(f"depth/{i}.png: cut off")
        return None if i in self._without else self._dataset.depth(i)


@pytest.mark.parametrize(("without", "unreadable"), [({0, 5, 6}, {10}), (set(range(220)), set())])
def test_frames_without_depth_are_passed_over_and_bad_ones_told_of(recording: Path, tmp_path: Path, without: set, unreadable: set) -> None:
    inputs, tools = Inputs(recording, tmp_path), Tools()
    inputs.dataset = Broken(inputs.dataset, without, unreadable)
    summary = {}
    for name, stage in (("densify", densify), ("octree", octree)):
        (tmp_path / name).mkdir()
        summary[name] = stage.run(inputs, tmp_path / name, CFG, tools)
    used = len([i for i in range(0, 220, 5) if i not in without | unreadable])
    assert summary["densify"]["used"] == used
    assert (summary["octree"]["scans"] >= used) and (summary["octree"]["scans"] > 0) == (used > 0)
    if used:
        assert tools.warnings == ["depth/10.png: cut off"] * 2
    else:
        assert len(cloud.read(tmp_path / "densify" / "cloud.ply")[0]) == len(octomap.read(tmp_path / "octree" / "map.bt")) == 0
        assert any("cloud is empty" in message for message in tools.warnings)
        assert any("octree is empty" in message for message in tools.warnings)


class BoxRoom(SimpleNamespace):
    """A recording of the analytic room."""

    def __len__(self) -> int:
        return self.n


class Drive(Inputs):
    """Key frames in any number along a drive through the analytic room, each with its depth image."""

    def __init__(self, n: int) -> None:
        steps = np.linspace(0.0, 1.0, n)
        T_lc = [boxroom.look_along([1.0 + 3.0 * s, 1.0 + 2.0 * s, 0.6], 0.2 + 2.0 * s, 0.35) for s in steps]
        self.T_wl = se3.inverse(T_lc[0])
        T_wk, kf, none = self.T_wl @ np.array(T_lc), np.arange(n, dtype=np.int32), np.zeros(0)
        stamp = kf / 30.0
        self._records = {
            FrameTimes: SimpleNamespace(stamp=stamp, depth_stamp=stamp),
            Map: Map(kf, 0 * kf, T_wk, none.reshape(0, 3), none.astype("i4"), none.astype("i4"), none.astype("i8")),
            Tracks: Tracks(kf, np.tile(np.eye(4), (n, 1, 1)), none, none),
            Timing: Timing(np.array(0.0), np.array(0.0), np.array(0.0), np.zeros((n, 6))),
            Moving: Moving(),
        }
        self.dataset = BoxRoom(
            n=n,
            camera=boxroom.KINECT,
            depth=lambda i, camera: boxroom.render(T_lc[i]),
            rgb=lambda i: np.zeros((120, 160, 3), np.uint8),
        )


@pytest.mark.parametrize("n", [1, 2, 41, 400])
def test_the_level_frame_begins_below_the_first_camera_for_any_number_of_key_frames(n: int, tmp_path: Path) -> None:
    summary = densify.run(Drive(n), tmp_path, CFG, Tools())
    assert summary["is_floor_found"] and summary["key_frames"] == n
    T_lc = artifacts.load(Ground, tmp_path).T_lw  # the world is the first camera's frame
    np.testing.assert_allclose(T_lc[[0, 1, 1], [3, 3, 2]], 0.0, atol=1e-9)  # x, y, and the view's part along y
    assert T_lc[0, 2] > 0.9
    assert T_lc[2, 3] == pytest.approx(0.6, abs=0.01)
