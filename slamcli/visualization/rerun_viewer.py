"""A run in the Rerun viewer: a time line with images and features, key frames, loops, cloud, octree and grid.

Needs the optional package `rerun-sdk`. Saved to a file, no display is needed.
"""

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from slamcli import files
from slamcli.datasets import Dataset
from slamcli.errors import BadFrame, SlamError
from slamcli.evaluation.run_content import Content, collect
from slamcli.formats import cloud, octomap
from slamcli.geometry import voxel
from slamcli.geometry.octree import CENTRE, DEPTH
from slamcli.hints import hint
from slamcli.runs.run_directory import RunDir
from slamcli.schema import KEY_FRAME, Features, Grid, Moving
from slamcli.visualization import moving_tint

MOST_POINTS = 1_500_000  # of the cloud
MOST_CELLS = 300_000  # of the octree
JPEG_QUALITY = 75
MASKED_BY = ("track", "loop")  # stages that say what moves
OURS, TRUTH, LOOP, KEY, WITH_DEPTH, WITHOUT_DEPTH = (0, 114, 178), (130, 140, 150), (213, 94, 0), (30, 30, 30), (60, 220, 60), (235, 60, 40)
GRID_COLOURS = np.array([[255, 255, 255], [26, 26, 26], [200, 200, 200]], dtype=np.uint8)  # by state: free, occupied, unknown (-1)

Progress = Callable[..., Iterable]


def view(run: RunDir, *, save: Path | None, images: int, progress: Progress) -> None:
    """Show a run in the viewer, or save it to `save` for later.

    images : at most so many frames are shown with their image; 0 = none
    """
    rr = load_rerun()
    content = collect(run)
    recording = rr.RecordingStream("slamcli", recording_id=f"slamcli {run.path.resolve()}")
    if save is None:
        _spawn(recording, _blueprint(bool(content.ape)))
        _log(rr, recording, run, content, images, progress)
        return
    with files.whole(save) as file:
        recording.save(file.name, default_blueprint=_blueprint(bool(content.ape)))
        _log(rr, recording, run, content, images, progress)
        recording.disconnect()  # writes the end of the file


def _log(rr: Any, recording: Any, run: RunDir, content: Content, images: int, progress: Progress) -> None:
    recording.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    _log_paths(rr, recording, content)
    _log_maps(rr, recording, run)
    _log_frames(rr, recording, run, content, images, progress)
    recording.flush()


def load_rerun() -> Any:
    """Import Rerun; SlamError says how to install it."""
    try:
        import rerun
    except ImportError:
        raise SlamError("the viewer needs an optional package; install it with: pip install 'slamcli[view]'") from None
    return rerun


def _spawn(recording: Any, blueprint: Any) -> None:
    try:
        recording.spawn(default_blueprint=blueprint)
    except (RuntimeError, OSError) as error:
        raise SlamError(f"the viewer does not start ({error}); write a file instead with: {hint().save_view()}") from None


def _blueprint(has_truth: bool) -> Any:
    """Lay out the windows: the scene on the left; image and curves on the right."""
    import rerun.blueprint as rrb

    curves = [rrb.TimeSeriesView(origin=f"curves/{name}", name=name) for name in (["error"] if has_truth else []) + ["inliers", "features"]]
    right = rrb.Vertical(rrb.Spatial2DView(origin="world/camera/image", name="image"), rrb.Tabs(*curves), row_shares=[3, 2])
    return rrb.Blueprint(rrb.Horizontal(rrb.Spatial3DView(origin="world", name="scene"), right, column_shares=[3, 2]))


def _log_paths(rr: Any, recording: Any, content: Content) -> None:
    position = content.T_lc[:, :3, 3]
    recording.log("world/trajectory", rr.LineStrips3D(_pieces(position), colors=OURS, radii=rr.Radius.ui_points(1.5)), static=True)
    key = position[(content.state == KEY_FRAME) & content.has_pose]
    recording.log("world/key_frames", rr.Points3D(key, colors=KEY, radii=rr.Radius.ui_points(2.5)), static=True)
    if len(content.x_truth):
        recording.log("world/ground_truth", rr.LineStrips3D([content.x_truth], colors=TRUTH, radii=rr.Radius.ui_points(1.0)), static=True)
    if len(content.loops):
        strips = position[content.loops]
        recording.log("world/loops", rr.LineStrips3D(strips[np.isfinite(strips).all(axis=(1, 2))], colors=LOOP), static=True)


def _pieces(position: np.ndarray) -> list[np.ndarray]:
    """Split positions (F, 3) where frames are lost."""
    rows = np.flatnonzero(np.isfinite(position[:, 0]))
    return [position[piece] for piece in np.split(rows, np.flatnonzero(np.diff(rows) > 1) + 1) if len(piece) > 1]


def _log_maps(rr: Any, recording: Any, run: RunDir) -> None:
    if run.record("densify") is not None:
        xyz, rgb, _ = cloud.read_ply(run.stage_path("densify", "cloud.ply"))
        step = -(-len(xyz) // MOST_POINTS) or 1
        recording.log("world/cloud", rr.Points3D(xyz[::step], colors=None if rgb is None else rgb[::step]), static=True)
    if run.record("octree") is not None:
        centre, half = _occupied_boxes(run)
        recording.log(
            "world/octree", rr.Boxes3D(centers=centre, half_sizes=half, colors=_by_height(centre[:, 2]), fill_mode="solid"), static=True
        )
    if run.record("grid2d") is not None:
        recording.log("world/grid", _grid_mesh(rr, run.load(Grid, "grid2d")), static=True)


def _occupied_boxes(run: RunDir) -> tuple[np.ndarray, np.ndarray]:
    """Return centre (N, 3) and half sides (N, 3) [m] of the octree's occupied leaves."""
    tree = octomap.read(run.stage_path("octree", "map.ot"))
    rows = np.flatnonzero(tree.is_occupied())
    rows = rows[:: -(-len(rows) // MOST_CELLS) or 1]
    side = (1 << (DEPTH - tree.depth[rows].astype(np.int64)))[:, None]
    centre = (voxel.unmorton(tree.key[rows]) - CENTRE + 0.5 * side) * float(tree.resolution)
    return centre, np.broadcast_to(0.5 * side * float(tree.resolution), centre.shape)


def _by_height(z: np.ndarray) -> np.ndarray:
    if not len(z):
        return np.empty((0, 3), dtype=np.uint8)
    low, high = np.quantile(z, [0.01, 0.99])
    level = (255 * ((z - low) / max(high - low, 1e-6)).clip(0, 1)).astype(np.uint8)
    return cv2.cvtColor(cv2.applyColorMap(level.reshape(-1, 1), cv2.COLORMAP_TURBO), cv2.COLOR_BGR2RGB).reshape(-1, 3)


def _grid_mesh(rr: Any, grid: Grid) -> Any:
    """Lay the grid on the floor as a textured rectangle; a texture's first row is its top."""
    rows, columns = grid.state.shape
    x0, y0 = grid.origin
    x1, y1 = grid.origin + np.array([columns, rows]) * float(grid.resolution)
    return rr.Mesh3D(
        vertex_positions=[[x0, y0, 0.0], [x1, y0, 0.0], [x1, y1, 0.0], [x0, y1, 0.0]],
        triangle_indices=[[0, 1, 2], [0, 2, 3]],
        vertex_texcoords=[[0.0, 1.0], [1.0, 1.0], [1.0, 0.0], [0.0, 0.0]],
        albedo_texture=np.ascontiguousarray(GRID_COLOURS[grid.state][::-1]),
    )


def _log_frames(rr: Any, recording: Any, run: RunDir, content: Content, images: int, progress: Progress) -> None:
    """Log every frame's pose and curves, and some frames' images with features."""
    n = len(content.stamp)
    features = run.load(Features, "extract") if run.record("extract") is not None else None
    camera = run.camera("extract" if features is not None else content.stage)
    pinhole = rr.Pinhole(image_from_camera=camera.K, resolution=[camera.width, camera.height], image_plane_distance=0.3)
    recording.log("world/camera/image", pinhole, static=True)
    dataset = _dataset(run) if images > 0 else None
    moving = run.load(Moving, content.stage) if content.stage in MASKED_BY else Moving()
    step = max(1, -(-n // images)) if images > 0 else n
    error = np.full(n, np.nan)
    if ape := content.ape.get(content.stage):
        error[np.searchsorted(content.stamp, ape.stamp)] = ape.error
    for i in progress(range(n), "view", total=n):
        recording.set_time("frame", sequence=i)
        recording.set_time("time", duration=float(content.stamp[i] - content.stamp[0]))
        if content.has_pose[i]:
            T = content.T_lc[i]
            recording.log("world/camera", rr.Transform3D(translation=T[:3, 3], mat3x3=T[:3, :3]))
        else:
            recording.log("world/camera", rr.Clear(recursive=False))
        recording.log("curves/inliers", rr.Scalars(int(content.n_inliers[i])))
        if features is not None:
            recording.log("curves/features", rr.Scalars(int(content.n_features[i])))
        if np.isfinite(error[i]):
            recording.log("curves/error", rr.Scalars(float(error[i])))
        if dataset is not None and i % step == 0:
            _log_image(rr, recording, dataset, features, moving, i)


def _dataset(run: RunDir) -> Dataset | None:
    try:
        return run.dataset()
    except SlamError:  # the recording is gone: everything else can still be shown
        return None


def _log_image(rr: Any, recording: Any, dataset: Dataset, features: Features | None, moving: Moving, i: int) -> None:
    """Log an image with its features, where they are known, what moves in it tinted."""
    try:
        image = cv2.cvtColor(moving_tint.tinted(dataset.rgb(i), moving, i, dataset.camera), cv2.COLOR_RGB2BGR)
    except BadFrame:
        return
    _, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    recording.log("world/camera/image", rr.EncodedImage(contents=data.tobytes(), media_type="image/jpeg"))
    if features is None:
        return
    rows = slice(int(features.offset[i]), int(features.offset[i + 1]))
    has_depth = np.isfinite(features.depth[rows])
    colours = np.where(has_depth[:, None], WITH_DEPTH, WITHOUT_DEPTH).astype(np.uint8)
    raw = dataset.camera.distort(features.xy[rows])
    recording.log("world/camera/image/features", rr.Points2D(raw, colors=colours, radii=rr.Radius.ui_points(2.0)))
