import numpy as np
import pytest

from slamcli.errors import SlamError
from slamcli.geometry import voxel
from slamcli.geometry.octree import CENTRE, DEPTH, Octree
from slamcli.visualization import render
from slamcli.visualization.render import BACKGROUND, Viewpoint

RED, GREEN, BLUE = (200, 0, 0), (0, 200, 0), (0, 0, 200)
FRONT = Viewpoint(azimuth_deg=-90.0, elevation_deg=0.0, width=160, height=120)  # from -y: x to the right, z up


def colours(image: np.ndarray) -> set[tuple[int, ...]]:
    return {tuple(pixel) for pixel in np.unique(image.reshape(-1, 3), axis=0).tolist()}


def wall(y: float, colour: tuple, facing: float, size: float = 1.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    x, z = (a.ravel() for a in np.meshgrid(np.linspace(-size, size, 101), np.linspace(-size, size, 101)))
    xyz = np.column_stack([x, np.full_like(x, y), z])
    return xyz, np.tile(np.uint8(colour), (len(x), 1)), np.tile([0.0, facing, 0.0], (len(x), 1))


def drawn(*walls: tuple, view: Viewpoint = FRONT) -> np.ndarray:
    xyz, rgb, normal = (np.concatenate(column) for column in zip(*walls, strict=True))
    return render.draw_cloud(xyz, rgb, normal, spacing=0.02, view=view)


def test_a_cloud_fills_the_picture_and_leaves_a_margin() -> None:
    image = drawn(wall(0.0, RED, -1.0))
    assert image.shape == (120, 160, 3) and image.dtype == np.uint8
    rows, columns = np.nonzero((image != BACKGROUND).any(axis=2))
    assert 100 < np.ptp(rows) < 120
    assert abs(rows.mean() - 59.5) < 2 and abs(columns.mean() - 79.5) < 2
    assert tuple(image[60, 80]) == RED


def test_the_nearer_surface_hides_the_farther() -> None:
    assert BLUE not in colours(drawn(wall(0.0, RED, -1.0), wall(1.0, BLUE, -1.0)))
    assert BLUE not in colours(drawn(wall(1.0, BLUE, -1.0), wall(0.0, RED, -1.0)))


def test_surfaces_that_face_away_are_left_out() -> None:
    image = drawn(wall(-1.0, RED, 1.0), wall(1.0, BLUE, -1.0))
    assert RED not in colours(image) and BLUE in colours(image)


def test_up_is_up_and_right_is_right() -> None:
    xyz = np.array([[-1.0, 0, 0], [1.0, 0, 0], [0, 0, 1.0], [0, 0, -1.0]])
    image = render.draw_cloud(xyz, np.uint8([RED, GREEN, BLUE, (90, 90, 0)]), None, spacing=0.1, view=FRONT)
    place = {
        name: np.argwhere((image == colour).all(axis=2)).mean(axis=0) for name, colour in (("left", RED), ("right", GREEN), ("top", BLUE))
    }
    assert place["left"][1] < 40 and place["right"][1] > 120 and place["top"][0] < 40


def boxes(*cells: tuple[tuple[int, int, int], float]) -> Octree:
    key = voxel.morton(np.array([cell for cell, _ in cells]) + CENTRE)
    order = np.argsort(key)
    value = np.float32([value for _, value in cells])
    return Octree(0.1, key[order], np.full(len(key), DEPTH, np.uint8), value[order])


def test_occupied_cells_are_drawn_where_they_bound_on_free_space() -> None:
    tree = boxes(((0, 0, 0), 1.0), ((0, -1, 0), -1.0), ((0, 0, 3), 1.0), ((0, -1, 3), -1.0))
    image = render.draw_octree(tree, view=FRONT)
    drawn_rows = np.flatnonzero((image != BACKGROUND).any(axis=(1, 2)))
    assert np.diff(drawn_rows).max() > 20  # two boxes and a gap
    columns = np.flatnonzero((image[drawn_rows[3]] != BACKGROUND).any(axis=1))
    assert np.ptp(columns) == pytest.approx(len(drawn_rows) / 2, abs=3)  # faces are square
    behind = Viewpoint(azimuth_deg=90.0, elevation_deg=0.0, width=160, height=120)
    assert colours(render.draw_octree(tree, view=behind)) == {BACKGROUND}


def test_a_mesh_is_seen_from_its_front_only() -> None:
    xyz = np.float32([[-1, 0, -1], [1, 0, -1], [1, 0, 1], [-1, 0, 1]])
    triangle = np.int32([[0, 1, 2], [0, 2, 3]])
    rgb = np.tile(np.uint8(RED), (4, 1))
    image = render.draw_mesh(xyz, triangle, rgb, view=FRONT)
    inside = image[30:90, 50:110].reshape(-1, 3)
    assert (inside[:, 0] > 100).all() and (inside[:, 1:] == 0).all()
    assert colours(render.draw_mesh(xyz, triangle[:, ::-1], rgb, view=FRONT)) == {BACKGROUND}


def test_a_path_is_drawn_over_everything() -> None:
    path = np.array([[-1.0, 0.5, 0.0], [1.0, 0.5, 0.0]])
    xyz, rgb, normal = wall(0.0, (20, 20, 20), -1.0)
    image = render.draw_cloud(xyz, rgb, normal, spacing=0.02, view=FRONT, path=path)
    assert render.PATH_COLOUR in colours(image)
    joined = np.count_nonzero((image == np.array(render.PATH_COLOUR)).all(axis=2))
    interrupted = np.insert(np.repeat(path, [2, 2], axis=0), 2, np.nan, axis=0)  # stands still, jumps, stands still
    parted = render.draw_cloud(xyz, rgb, normal, spacing=0.02, view=FRONT, path=interrupted)
    assert 0 < np.count_nonzero((parted == np.array(render.PATH_COLOUR)).all(axis=2)) < 0.2 * joined


def test_pictures_are_the_same_each_time() -> None:
    assert np.array_equal(drawn(wall(0.0, RED, -1.0), wall(0.3, BLUE, -1.0)), drawn(wall(0.0, RED, -1.0), wall(0.3, BLUE, -1.0)))


def test_nothing_to_draw_is_said() -> None:
    nothing = np.zeros((0, 3))
    with pytest.raises(SlamError, match="empty"):
        render.draw_cloud(nothing, nothing.astype(np.uint8), nothing, spacing=0.1, view=FRONT)
    with pytest.raises(SlamError, match="nothing to draw"):
        render.draw_octree(boxes(((0, 0, 0), 1.0)), view=FRONT)
    huge = Octree(0.1, np.array([0]), np.array([3], np.uint8), np.float32([1.0]))
    with pytest.raises(SlamError, match="too many"):
        render.draw_octree(huge, view=FRONT)
