"""Films of a cloud: once round it, or along the way that the camera went."""

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from slamcli import files
from slamcli.errors import SlamError
from slamcli.geometry import se3
from slamcli.visualization.render import OVERSAMPLING, Eye, Viewpoint, look_at

FRAMES_PER_SECOND = 30
BEHIND = 0.35  # [m] behind the camera that was: some of what it stood beside comes into view
SMOOTHED = 1.0  # [s] of the film over which the camera's way is averaged
CODEC = "libx264"


def round_the_scene(xyz: np.ndarray, view: Viewpoint, n: int) -> Iterator[Eye]:
    """Yield the eyes of one turn about a cloud (N, 3), all equally far from its middle, from the view's direction on."""
    turn = np.linspace(0.0, 360.0, n, endpoint=False)
    views = [Viewpoint(view.azimuth_deg + a, view.elevation_deg, view.width, view.height, view.field_of_view_deg) for a in turn]
    middle = 0.5 * np.quantile(xyz, [0.002, 0.998], axis=0).sum(axis=0)
    sample = [look_at(xyz, one) for one in views[:: max(1, n // 24)]]
    distance = max(float(np.linalg.norm(eye.centre_l - middle)) for eye in sample)
    for one in views:
        eye = look_at(xyz[:: max(1, len(xyz) // 1000)], one)
        yield Eye(eye.R_cl, middle - distance * eye.R_cl[2], eye.focal, eye.width, eye.height)


def along_the_way(T_lc: np.ndarray, view: Viewpoint, n: int) -> Iterator[Eye]:
    """Yield eyes that follow the camera's poses (F, 4, 4), smoothed, from a little behind it; rows of NaN are left out."""
    T_lc = T_lc[np.isfinite(T_lc[:, 0, 0])]
    if len(T_lc) == 0:
        raise SlamError("no frame has a pose: there is no way to follow")
    at = np.linspace(0.0, len(T_lc) - 1.0, n)
    reach = max(1.0, SMOOTHED * FRAMES_PER_SECOND * len(T_lc) / n)
    weight = np.exp(-0.5 * ((np.arange(len(T_lc)) - at[:, None]) / (0.5 * reach)) ** 2)
    weight /= weight.sum(axis=1, keepdims=True)
    centre = weight @ (T_lc[:, :3, 3] - BEHIND * T_lc[:, :3, 2])
    ahead, down = weight @ T_lc[:, :3, 2], weight @ T_lc[:, :3, 1]
    width, height = view.width * OVERSAMPLING, view.height * OVERSAMPLING
    focal = width / 2 / np.tan(np.radians(view.field_of_view_deg) / 2)
    for c, z, y in zip(centre, ahead, down, strict=True):
        x = np.cross(y, z)
        T = np.eye(4)
        T[:3, :3] = np.stack([x, np.cross(z, x), z], axis=1)
        yield Eye(se3.orthonormalize(T)[:3, :3].T, c, focal, width, height)


def write_video(path: Path, pictures: Iterable[np.ndarray]) -> None:
    """Write pictures (H, W, 3) uint8, sides even, as an H.264 film in MP4, which browsers play.

    Raises SlamError where PyAV is not installed.
    """
    av = _av()
    with files.whole(path) as file, av.open(file, "w", format="mp4") as film:
        stream = None
        for picture in pictures:
            if stream is None:
                stream = film.add_stream(CODEC, rate=FRAMES_PER_SECOND, options={"crf": "20", "threads": "1"})
                stream.height, stream.width, stream.pix_fmt = *picture.shape[:2], "yuv420p"
            film.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
        if stream is not None:
            film.mux(stream.encode(None))


def _av() -> Any:
    try:
        import av
    except ImportError as error:
        raise SlamError("films need one more package: pip install 'slamcli[video]'") from error
    return av
