"""Images of a run with their poses, and the landmarks seen in them: what COLMAP's and nerfstudio's formats hold."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from slamcli.datasets import Dataset
from slamcli.errors import BadFrame, SlamError
from slamcli.files import write_bytes
from slamcli.formats import nerfstudio
from slamcli.formats.colmap import SparseModel
from slamcli.geometry import se3
from slamcli.geometry.camera import Camera
from slamcli.parallel import ordered_map
from slamcli.schema import Features, Ground, Map, Tracks, check_seen_in, frame_poses
from slamcli.stages.contract import Stored

JPEG_SETTINGS = (cv2.IMWRITE_JPEG_QUALITY, 95)
PNG_SETTINGS = (cv2.IMWRITE_PNG_COMPRESSION, 3)


@dataclass(frozen=True)
class PosedImages:
    """Frames of the main map segment with their poses."""

    frame: np.ndarray  # (I,) increasing
    T_lc: np.ndarray  # (I, 4, 4) colour camera to level frame, at the middle of the exposure
    is_key: np.ndarray  # (I,) bool


def posed_images(run: Stored, *, frames: str) -> PosedImages:
    """List the "key" frames, or "all" that have a pose."""
    map_ = run.load(Map, "loop")
    T_lw = run.load(Ground, "densify").T_lw
    is_main = map_.kf_segment == 0
    T_wc = frame_poses(run.load(Tracks, "loop"), map_)
    T_wc[map_.kf_frame[is_main]] = map_.T_wk[is_main]
    frame = map_.kf_frame[is_main].astype(np.int64) if frames == "key" else np.flatnonzero(np.isfinite(T_wc[:, 0, 0]))
    if len(frame) == 0:
        raise SlamError("no frame of this run has a pose: there is nothing to export")
    return PosedImages(frame, T_lw @ T_wc[frame], np.isin(frame, map_.kf_frame[is_main]))


def sparse_model(run: Stored, camera: Camera, images: PosedImages, names: list[str]) -> SparseModel:
    """Gather the landmarks and where the images show them; only key frames hold observations.

    Landmarks seen in fewer than two of the images are left out: they have no track.
    """
    map_, features = run.load(Map, "loop"), run.load(Features, "extract")
    check_seen_in(map_, features)
    T_lw = run.load(Ground, "densify").T_lw
    frame = map_.kf_frame[map_.obs_kf]
    at = np.clip(np.searchsorted(images.frame, frame), 0, len(images.frame) - 1)
    is_in = images.frame[at] == frame
    lm, at, row = map_.obs_lm[is_in], at[is_in], map_.obs_row[is_in]
    is_tracked = np.bincount(lm, minlength=len(map_.lm_xyz)) >= 2
    keep = is_tracked[lm]
    lm, at, row = lm[keep], at[keep], row[keep]
    point = np.cumsum(is_tracked)[lm] - 1
    xyz = se3.transform(T_lw, map_.lm_xyz[is_tracked])
    T_cl = se3.inverse(images.T_lc)[at]
    x_c = np.einsum("nij,nj->ni", T_cl[:, :3, :3], xyz[point]) + T_cl[:, :3, 3]
    distance = np.linalg.norm(camera.project(x_c) - features.xy[row], axis=1)
    error = np.bincount(point, weights=distance, minlength=len(xyz)) / np.maximum(np.bincount(point, minlength=len(xyz)), 1)
    raw = camera.distort(features.xy[row].astype(np.float64))
    grey = np.full((len(xyz), 3), 128, dtype=np.uint8)
    return SparseModel(camera, names, images.T_lc, xyz, grey, error, point, at.astype(np.int64), raw)


def write_pictures(
    folder: Path, dataset: Dataset, frame: Iterable[int], names: list[str], *, workers: int, look: Callable[[int, np.ndarray], None]
) -> None:
    """Write colour images, as lossless PNG or as JPEG by their names' ending, and show each to `look(row, rgb)` in their order.

    Raises SlamError for an image that cannot be read: a model that names a missing image is refused by the programs that read it.
    """

    def one(item: tuple[int, str]) -> np.ndarray:
        try:
            rgb = dataset.rgb(item[0])
        except BadFrame as error:
            raise SlamError(str(error)) from error
        ending = Path(item[1]).suffix
        _, data = cv2.imencode(ending, rgb[..., ::-1], PNG_SETTINGS if ending == ".png" else JPEG_SETTINGS)
        write_bytes(folder / item[1], data.tobytes())
        return rgb

    for row, rgb in enumerate(ordered_map(one, list(zip(frame, names, strict=True)), workers=workers)):
        look(row, rgb)


def write_depth(folder: Path, dataset: Dataset, camera: Camera, frame: Iterable[int], names: list[str], *, workers: int) -> list[str]:
    """Write depth images for nerfstudio; returns the names, "" where a frame has no depth that can be read."""

    def one(item: tuple[int, str]) -> str:
        try:
            depth = dataset.depth(item[0], camera)
        except BadFrame:
            depth = None
        if depth is None:
            return ""
        _, data = cv2.imencode(".png", nerfstudio.depth_units(depth))
        write_bytes(folder / item[1], data.tobytes())
        return item[1]

    return list(ordered_map(one, list(zip(frame, names, strict=True)), workers=workers))


class PointColours:
    """The mean colour of the pixels that show each point."""

    def __init__(self, model: SparseModel) -> None:
        """Start with no image looked at."""
        self._model = model
        self._sum = np.zeros((len(model.xyz), 3))
        self._count = np.zeros(len(model.xyz), dtype=np.int64)

    def look(self, row: int, rgb: np.ndarray) -> None:
        """Take one image's (H, W, 3) share."""
        mine = self._model.obs_image == row
        column, line = np.rint(self._model.obs_xy[mine]).astype(np.int64).T
        seen = rgb[np.clip(line, 0, rgb.shape[0] - 1), np.clip(column, 0, rgb.shape[1] - 1)]
        np.add.at(self._sum, self._model.obs_point[mine], seen)
        np.add.at(self._count, self._model.obs_point[mine], 1)

    def model(self) -> SparseModel:
        """Return the model in these colours; points that no image showed keep theirs."""
        mean = np.rint(self._sum / np.maximum(self._count, 1)[:, None]).astype(np.uint8)
        return replace(self._model, rgb=np.where(self._count[:, None] > 0, mean, self._model.rgb))
