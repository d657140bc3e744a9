"""The renderer against geometry worked out by hand."""

import numpy as np
import pytest

from slamcli.datasets.simulated import raycast
from slamcli.datasets.simulated.atlas import bake_light
from slamcli.datasets.simulated.drive import look_along
from slamcli.datasets.simulated.scene import Scene, box, room_shell
from slamcli.datasets.simulated.texture import flat
from slamcli.geometry.camera import Camera

CAMERA = Camera(80, 60, 65.0, 65.0, 39.5, 29.5)
LOW, HIGH = np.zeros(3), np.array([6.0, 4.0, 2.5])
EYE = np.array([[1.0, 2.0, 1.0]])


def checkerboard(side: float):
    def paint(rng: np.random.Generator, width: float, height: float, scale: float) -> np.ndarray:
        y, x = np.mgrid[: round(height * scale), : round(width * scale)] / scale
        return np.repeat((255 * ((x // side + y // side) % 2))[..., None], 3, axis=2).astype(np.uint8)

    return paint


@pytest.fixture(scope="module")
def scene() -> Scene:
    walls = {name: flat((200, 100, 50)) for name in ("south", "north", "west", "east")}
    shell = room_shell(LOW, HIGH, walls, checkerboard(0.01), flat((90, 90, 90)))
    parcel = box("parcel", (3.0, 2.0, 0.5), (0.5, 0.8, 1.0), {"": flat((20, 30, 200))}, is_movable=True)
    return Scene(LOW, HIGH, [parcel], shell, np.array([[3.0, 2.0, 2.5]]), seed=0)


@pytest.fixture(scope="module")
def renderer(scene: Scene) -> raycast.Renderer:
    return raycast.Renderer(scene.patches(), scene, CAMERA, texel=0.005)


def test_depth_is_exact_with_and_without_the_movable_box(renderer: raycast.Renderer) -> None:
    T_lc = look_along(EYE, np.array([0.0]), 0.0, 0.0)[0]
    _, depth, cosine = renderer.render(T_lc)
    without, _ = renderer.depth(T_lc, with_movable=False)
    np.testing.assert_allclose(depth[25:35, 35:45], 2.75 - 1.0, rtol=1e-6)  # the box's front face
    np.testing.assert_allclose(without[25:35, 35:45], 5.0, rtol=1e-6)  # the wall behind it
    rays = np.dstack([CAMERA.rays, np.ones((60, 80))])
    floor = 1.0 / np.maximum(rays[..., 1], 1e-9)
    expected = np.minimum(5.0, floor)  # forward wall or floor; side walls are out of sight there
    inner = np.abs(rays[..., 0] * expected) < 1.9
    ceiling_free = -rays[..., 1] * expected < 1.4
    np.testing.assert_allclose(without[inner & ceiling_free], expected[inner & ceiling_free], rtol=1e-5)
    np.testing.assert_allclose(cosine[25:35, 35:45], 1 / np.linalg.norm(rays[25:35, 35:45], axis=2), rtol=1e-5)


def test_colours_are_where_their_surfaces_are(renderer: raycast.Renderer) -> None:
    T_lc = look_along(EYE, np.array([0.0]), 0.0, 0.0)[0]
    rgb, depth, _ = renderer.render(T_lc)
    box_pixel, wall_pixel = rgb[30, 40], rgb[30, 15]
    np.testing.assert_allclose(box_pixel / box_pixel[2], np.array([20, 30, 200]) / 200, atol=0.02)
    np.testing.assert_allclose(wall_pixel / wall_pixel[0], np.array([200, 100, 50]) / 200, atol=0.02)
    assert depth[30, 15] > depth[30, 40]
    assert not np.allclose(renderer.render(T_lc, with_movable=False)[0][30, 40], box_pixel, atol=5)


def test_fine_patterns_far_away_blend_to_their_mean(renderer: raycast.Renderer) -> None:
    """Squares of 1 cm seen under a flat angle from metres away must not flicker: the filter averages them."""
    T_lc = look_along(EYE, np.array([0.2]), -0.3, 0.0)[0]
    rgb, depth, _ = renderer.render(T_lc, with_movable=False)
    height = 1.0 - depth * (CAMERA.rays[..., 1] * np.cos(0.3) + np.sin(0.3))
    far_floor = (np.abs(height) < 1e-3) & (depth > 2.0)
    assert far_floor.sum() > 200
    neighbours = far_floor[:, 1:] & far_floor[:, :-1]
    step = np.abs(np.diff(rgb[..., 1], axis=1))[neighbours]
    assert step.mean() < 0.06 * rgb[far_floor].mean() and np.percentile(step, 95) < 0.15 * rgb[far_floor].mean()


def test_edges_between_patches_are_blended(renderer: raycast.Renderer) -> None:
    T_lc = look_along(EYE, np.array([0.0]), 0.0, 0.03)[0]  # rolled: the box's edge crosses pixels at every share
    rgb, _, _ = renderer.render(T_lc)
    blue = rgb[20:40, :, 2] / rgb[20:40].sum(axis=2)  # 0.14 on the wall, 0.8 on the box, whatever the light
    between = ((blue > 0.2) & (blue < 0.75)).sum(axis=1)
    assert between.max() <= 3 and between.sum() >= 20


def test_rendering_is_a_pure_function(renderer: raycast.Renderer) -> None:
    T_lc = look_along(EYE, np.array([0.5]), -0.1, 0.02)[0]
    for one, other in zip(renderer.render(T_lc), renderer.render(T_lc), strict=True):
        assert np.array_equal(one, other)


def test_light_falls_from_the_lamp_and_leaves_a_shadow(scene: Scene) -> None:
    patches = scene.patches()
    triangles, _ = raycast._triangles(patches)
    light = bake_light(patches, scene, raycast._raycasting_scene(triangles), 0.1)
    floor = light[0]
    at = {name: floor[round((4.0 - y) / 4.0 * (floor.shape[0] - 1)), round(x / 6.0 * (floor.shape[1] - 1))] for name, (x, y) in
          {"below the box": (3.0, 2.0), "open": (4.2, 2.0), "corner": (0.15, 0.15)}.items()}  # fmt: skip
    assert at["below the box"] < 0.8 * at["open"] and at["corner"] < 0.9 * at["open"]
    assert all(np.isfinite(picture).all() and picture.min() > 0 for picture in light)
