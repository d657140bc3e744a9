"""Pictures of clouds, octrees and meshes, drawn by the processor alone: no display, no graphics driver.

Surfaces that face away from the camera are left out. A room is then seen from outside through its near walls, like a doll's house.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from slamcli.errors import SlamError
from slamcli.geometry import voxel
from slamcli.geometry.octree import CENTRE, DEPTH, Octree, expand
from slamcli.jit.kernel import kernel
from slamcli.visualization import height_scale

BACKGROUND = (232, 235, 240)  # off white, against which white walls show
PATH_COLOUR = (214, 39, 40)
OVERSAMPLING = 2  # per side; edges come out smooth
SPLAT = 1.4  # width of a point's square over the points' spacing: closes the gaps on surfaces seen aslant
NEAREST = 0.01  # [m] before the camera, from where on things are drawn
SEAM = 1e-4  # share of a triangle by which it reaches beyond its sides, so that no gap shows between two
FILL = 0.94  # share of the picture that the scene takes
STRAY_SHARE = 0.002  # of the points may lie outside the picture
MAX_CELLS = 20_000_000  # of an octree, once it is split into its finest cells
LIGHT = np.array([0.35, 0.25, 0.9])  # towards the light, level frame
FACES = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]])


@dataclass(frozen=True)
class Viewpoint:
    """Where from and how large; the scene is centred and fills the picture."""

    azimuth_deg: float = 235.0  # of the camera as seen from the scene, from x towards y
    elevation_deg: float = 42.0  # above the floor
    width: int = 1280  # px
    height: int = 960  # px
    field_of_view_deg: float = 40.0  # horizontal


@dataclass(frozen=True)
class Eye:
    """A pinhole camera on the scene, `OVERSAMPLING` times finer than the picture."""

    R_cl: np.ndarray  # (3, 3) level to camera axes: x right, y down, z forward
    centre_l: np.ndarray  # (3,) m
    focal: float  # px
    width: int
    height: int

    def see(self, xyz: np.ndarray) -> np.ndarray:
        """Return x, y [px] and depth [m] of points (N, 3), float32."""
        x_c = (xyz - self.centre_l) @ self.R_cl.T
        z = np.maximum(x_c[:, 2:], 1e-6)
        return np.hstack([x_c[:, :2] / z * self.focal + [self.width / 2, self.height / 2], x_c[:, 2:]]).astype(np.float32)


def draw_cloud(
    xyz: np.ndarray, rgb: np.ndarray, normal: np.ndarray | None, *, spacing: float, view: Viewpoint | Eye, path: np.ndarray | None = None
) -> np.ndarray:
    """Draw points (N, 3) with colours (N, 3) uint8 at some spacing [m]; returns (H, W, 3) uint8.

    normal : (N, 3); points that face away are left out. None draws all.
    path : (M, 3) positions of the camera, drawn as a line that rows of NaN interrupt
    """
    eye = view if isinstance(view, Eye) else look_at(xyz, view)
    if normal is not None:
        faces = ((eye.centre_l - xyz) * normal).sum(axis=1) > 0.0
        xyz, rgb = xyz[faces], rgb[faces]
    image, z_buffer = _canvas(eye)
    _splat(eye.see(xyz), np.ascontiguousarray(rgb), np.float32(SPLAT * spacing * eye.focal), image, z_buffer)
    return _finish(image, z_buffer, eye, path)


def draw_octree(
    tree: Octree, *, view: Viewpoint, threshold: float = 0.0, path: np.ndarray | None = None, with_scale: bool = False
) -> np.ndarray:
    """Draw the occupied cells' faces on free space, coloured by height, with a scale of it if wanted; returns (H, W, 3) uint8."""
    cell, faces = _visible_faces(tree, threshold)
    if not len(cell):
        raise SlamError("the octree has no occupied cell beside a free one: nothing to draw")
    side = tree.resolution
    centre = (cell - CENTRE + 0.5) * side
    eye = look_at(np.concatenate([centre - 0.5 * side, centre + 0.5 * side]), view)
    rgb = _height_colours(centre[:, 2])
    image, z_buffer = _canvas(eye)
    for number, direction in enumerate(FACES):
        middle = centre[faces[:, number]] + 0.5 * side * direction
        towards = ((eye.centre_l - middle) @ direction) > 0.0
        middle, colour = middle[towards], rgb[faces[:, number]][towards]
        shade = 0.62 + 0.38 * max(0.0, float(direction @ LIGHT / np.linalg.norm(LIGHT)))
        u, v = np.roll(direction, 1) * 0.5 * side, np.roll(direction, 2) * 0.5 * side
        corners = np.stack([eye.see(middle + s * u + t * v) for s, t in ((-1, -1), (1, -1), (1, 1), (-1, 1))], axis=1)
        triangles = np.concatenate([corners[:, [0, 1, 2]], corners[:, [0, 2, 3]]])
        colours = np.tile((colour * shade).astype(np.uint8), (2, 1))
        _fill_triangles(np.ascontiguousarray(triangles), colours, image, z_buffer)
    drawn = _finish(image, z_buffer, eye, path)
    if not with_scale:
        return drawn
    low, high = _height_range(centre[:, 2])
    return height_scale.add(drawn, _height_colours(np.linspace(low, high, 256), (low, high)), low=low, high=high)


def octree_heights(tree: Octree) -> tuple[float, float]:
    """Return the heights [m] that the lowest and the highest colour of `draw_octree` stand for."""
    cell, _ = _visible_faces(tree, 0.0)
    return _height_range((cell[:, 2] - CENTRE + 0.5) * tree.resolution)


def draw_mesh(xyz: np.ndarray, triangle: np.ndarray, rgb: np.ndarray, *, view: Viewpoint, path: np.ndarray | None = None) -> np.ndarray:
    """Draw triangles (M, 3) of vertex rows, seen from their front (counter-clockwise) side; returns (H, W, 3) uint8."""
    eye = look_at(xyz, view)
    corner = xyz[triangle].astype(np.float64)
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    towards = ((eye.centre_l - corner[:, 0]) * normal).sum(axis=1) > 0.0
    triangle, normal = triangle[towards], normal[towards]
    unit = normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    shade = 0.8 + 0.2 * np.abs(unit @ LIGHT) / np.linalg.norm(LIGHT)
    colours = (rgb[triangle].mean(axis=1) * shade[:, None]).clip(0, 255).astype(np.uint8)
    image, z_buffer = _canvas(eye)
    _fill_triangles(np.ascontiguousarray(eye.see(xyz)[triangle]), colours, image, z_buffer)
    return _finish(image, z_buffer, eye, path)


def look_at(xyz: np.ndarray, view: Viewpoint) -> Eye:
    """Place the camera so that all but a few stray points just fit into the picture."""
    if not len(xyz):
        raise SlamError("the map is empty: nothing to draw")
    azimuth, elevation = np.radians(view.azimuth_deg), np.radians(view.elevation_deg)
    backward = np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])
    right = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
    R_cl = np.stack([right, np.cross(right, backward), -backward])
    half = np.tan(np.radians(view.field_of_view_deg) / 2) * FILL * np.array([1.0, view.height / view.width])
    sample = np.asarray(xyz[:: max(1, len(xyz) // 100_000)], dtype=np.float64) @ R_cl.T
    middle = 0.5 * (sample.min(axis=0) + sample.max(axis=0))
    for _ in range(4):  # perspective moves the scene in the picture once the distance changes
        x_c = sample - middle
        distance = max(0.1, np.quantile((np.abs(x_c[:, :2]) / half).max(axis=1) - x_c[:, 2], 1.0 - STRAY_SHARE))
        z = np.maximum(x_c[:, 2:] + distance, 0.05)
        low, high = np.quantile(x_c[:, :2] / z, [STRAY_SHARE, 1.0 - STRAY_SHARE], axis=0)
        middle[:2] += 0.5 * (low + high) * distance
    middle = middle @ R_cl
    width, height = view.width * OVERSAMPLING, view.height * OVERSAMPLING
    focal = width / 2 / np.tan(np.radians(view.field_of_view_deg) / 2)
    return Eye(R_cl, middle + backward * distance, focal, width, height)


def _canvas(eye: Eye) -> tuple[np.ndarray, np.ndarray]:
    image = np.empty((eye.height, eye.width, 3), dtype=np.uint8)
    image[:] = BACKGROUND
    return image, np.full((eye.height, eye.width), np.inf, dtype=np.float32)


def _finish(image: np.ndarray, z_buffer: np.ndarray, eye: Eye, path: np.ndarray | None) -> np.ndarray:
    if path is not None and len(path):
        pixel = eye.see(np.asarray(path, dtype=np.float64))
        is_seen = pixel[:, 2] > 0.0  # NaN, where the path is interrupted, compares false
        pieces = np.split(pixel[is_seen, :2], np.cumsum(is_seen)[~is_seen])
        lines = [np.rint(piece).astype(np.int32).reshape(-1, 1, 2) for piece in pieces if len(piece)]
        cv2.polylines(image, lines, False, PATH_COLOUR, thickness=2 * OVERSAMPLING, lineType=cv2.LINE_AA)
    size = (eye.width // OVERSAMPLING, eye.height // OVERSAMPLING)
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA)


def _height_range(z: np.ndarray) -> tuple[float, float]:
    """Return the heights [m] that the ends of the colours stand for; single cells far off do not count."""
    low, high = np.quantile(z, [0.005, 0.995])
    return round(float(low), 6) + 0.0, float(high)  # + 0.0: no -0.0


def _height_colours(z: np.ndarray, between: tuple[float, float] | None = None) -> np.ndarray:
    """Colour heights from blue (low) over green to red (high), as octovis does."""
    low, high = between or _height_range(z)
    level = ((z - low) / max(high - low, 1e-6)).clip(0, 1) * 255
    return cv2.cvtColor(cv2.applyColorMap(level.astype(np.uint8).reshape(-1, 1), cv2.COLORMAP_TURBO), cv2.COLOR_BGR2RGB).reshape(-1, 3)


def _visible_faces(tree: Octree, threshold: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the occupied finest cells (N, 3) and whether each of their six neighbours is known to be free (N, 6)."""
    occupied = tree.is_occupied(threshold)
    n_cells = (1 << 3 * (DEPTH - tree.depth[occupied].astype(np.int64))).sum()
    if n_cells > MAX_CELLS:
        raise SlamError(f"the octree has {n_cells} occupied cells: too many to draw")
    cell = voxel.unmorton(expand(Octree(tree.resolution, tree.key[occupied], tree.depth[occupied], tree.log_odds[occupied])).key)
    faces = np.empty((len(cell), 6), dtype=bool)
    for number, direction in enumerate(FACES):
        row = tree.find(cell + direction)
        faces[:, number] = (row >= 0) & ~occupied[row]
    shown = faces.any(axis=1)
    return cell[shown], faces[shown]


@kernel
def _splat(pixel, rgb, width_at_1m, image, z_buffer):
    """Draw each point as a square facing the camera, nearest wins."""
    rows, columns = z_buffer.shape
    for i in range(len(pixel)):
        z = pixel[i, 2]
        if not z > NEAREST:
            continue
        half = max(0.5, 0.5 * width_at_1m / z)
        u0, u1 = max(0, int(np.ceil(pixel[i, 0] - half))), min(columns - 1, int(np.floor(pixel[i, 0] + half)))
        v0, v1 = max(0, int(np.ceil(pixel[i, 1] - half))), min(rows - 1, int(np.floor(pixel[i, 1] + half)))
        for v in range(v0, v1 + 1):
            for u in range(u0, u1 + 1):
                if z < z_buffer[v, u]:
                    z_buffer[v, u] = z
                    image[v, u, 0], image[v, u, 1], image[v, u, 2] = rgb[i, 0], rgb[i, 1], rgb[i, 2]


@kernel
def _fill_triangles(corner, rgb, image, z_buffer):
    """Fill triangles (N, 3, [x, y, depth]) of one colour each, nearest wins; inverse depth is linear in the picture."""
    rows, columns = z_buffer.shape
    for i in range(len(corner)):
        ax, ay, az = corner[i, 0, 0], corner[i, 0, 1], corner[i, 0, 2]
        bx, by, bz = corner[i, 1, 0], corner[i, 1, 1], corner[i, 1, 2]
        cx, cy, cz = corner[i, 2, 0], corner[i, 2, 1], corner[i, 2, 2]
        area = (bx - ax) * (cy - ay) - (cx - ax) * (by - ay)
        if area == 0.0 or not min(az, min(bz, cz)) > NEAREST:
            continue
        u0, u1 = max(0, int(np.ceil(min(ax, min(bx, cx))))), min(columns - 1, int(np.floor(max(ax, max(bx, cx)))))
        v0, v1 = max(0, int(np.ceil(min(ay, min(by, cy))))), min(rows - 1, int(np.floor(max(ay, max(by, cy)))))
        for v in range(v0, v1 + 1):
            for u in range(u0, u1 + 1):
                wa = ((bx - u) * (cy - v) - (cx - u) * (by - v)) / area
                wb = ((cx - u) * (ay - v) - (ax - u) * (cy - v)) / area
                wc = 1.0 - wa - wb
                if wa < -SEAM or wb < -SEAM or wc < -SEAM:
                    continue
                z = 1.0 / (wa / az + wb / bz + wc / cz)
                if z < z_buffer[v, u]:
                    z_buffer[v, u] = z
                    image[v, u, 0], image[v, u, 1], image[v, u, 2] = rgb[i, 0], rgb[i, 1], rgb[i, 2]
