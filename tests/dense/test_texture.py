"""Textures: a picture on a surface is found again, the best view decides, and what a view cannot see it does not paint."""

import numpy as np
import pytest
from boxroom import look_along

from slamcli.dense import texture
from slamcli.dense.texture import Painter
from slamcli.dense.tsdf import Mesh
from slamcli.geometry import se3
from slamcli.geometry.camera import Camera

CAMERA = Camera(160, 120, 130.0, 130.0, 79.5, 59.5)
SIDE = 64  # [texels]
DOWN = look_along([0.0, 0.0, 1.5], 0.0, np.pi / 2 - 1e-6)


def sheet(n=6, half=0.6):
    """A level square around the origin, with vertices of one grey, and the plan of it as its texture's layout."""
    x, y = (v.ravel() for v in np.meshgrid(np.linspace(-half, half, n + 1), np.linspace(-half, half, n + 1)))
    a = (np.arange(n)[:, None] * (n + 1) + np.arange(n)).ravel()
    triangle = np.concatenate([np.stack([a, a + 1, a + n + 2], 1), np.stack([a, a + n + 2, a + n + 1], 1)]).astype(np.int32)
    xyz = np.stack([x, y, 0 * x], 1).astype(np.float32)
    up = np.tile(np.float32([0, 0, 1]), (len(xyz), 1))
    mesh = Mesh(xyz, np.full((len(xyz), 3), 90, np.uint8), up, triangle)
    return mesh, (xyz[triangle][..., :2] / (2 * half) + 0.5).astype(np.float32)


def colours(x, y):
    return np.stack([128 + 100 * np.sin(9 * x), 128 + 100 * np.cos(7 * y), 128 + 60 * np.sin(5 * (x + y))], axis=-1)


def view(T, camera=CAMERA, paint=colours):
    """What a camera sees of the level plane z = 0: colour and depth, with the lens's distortion."""
    rays = np.concatenate([camera.rays, np.ones((camera.height, camera.width, 1))], axis=2) @ T[:3, :3].T
    depth = -T[2, 3] / rays[..., 2]
    at = T[:3, 3] + depth[..., None] * rays
    rgb = np.clip(np.rint(paint(at[..., 0], at[..., 1])), 0, 255).astype(np.uint8)
    return rgb, np.where(depth > 0, depth, np.nan).astype(np.float32)


def plain(colour):
    return lambda x, y: np.broadcast_to(np.float64(colour), (*x.shape, 3))


def painted(*views, camera=CAMERA):
    mesh, uv = sheet()
    painter = Painter(mesh, uv, camera, size=SIDE)
    for rgb, depth, T, quality in views:
        painter.add(rgb, depth, T, quality=quality)
    return painter


@pytest.mark.parametrize("camera", [CAMERA, Camera(160, 120, 130.0, 130.0, 79.5, 59.5, k1=-0.2, k2=0.05)])
def test_a_picture_on_a_surface_is_found_again_from_above_and_aslant(camera):
    for T in (DOWN, look_along([-1.2, 0.1, 1.4], 0.0, 0.85)):
        painter = painted((*view(T, camera), T, 1.0), camera=camera)
        x, y = ((np.arange(SIDE) + 0.5) / SIDE - 0.5) * 1.2, ((np.arange(SIDE) + 0.5) / SIDE - 0.5) * 1.2
        expected = colours(*np.meshgrid(x, y))
        off = np.abs(painter.textured().picture - expected)[4:-4, 4:-4]
        assert painter.covered() > 0.85 and 0.0 < off.mean() < 2.0 and np.percentile(off, 99) < 8


def test_the_better_view_decides_and_where_it_ends_the_other_goes_on():
    near, far = look_along([0.3, 0.0, 0.7], 0.0, np.pi / 2 - 1e-6), look_along([0.0, 0.0, 2.0], 0.0, np.pi / 2 - 1e-6)
    made = painted((*view(near, paint=plain([250, 0, 0])), near, 1.0), (*view(far, paint=plain([0, 0, 250])), far, 1.0))
    picture = made.textured().picture.astype(int)
    below = picture[32, int((0.3 / 1.2 + 0.5) * SIDE)]
    assert below[0] > 240 and below[2] < 10 and picture[32, 2].tolist() == [0, 0, 250]
    row = picture[32, :, 0]
    assert np.abs(np.diff(row)).max() < 130 and (np.diff(row[row.argmin() : row.argmax()]) >= 0).all()  # from one to the other in steps
    blurred = painted((*view(DOWN, paint=plain([250, 0, 0])), DOWN, 0.5), (*view(DOWN, paint=plain([0, 0, 250])), DOWN, 1.0))
    np.testing.assert_allclose(blurred.textured().picture[32, 32], np.array([250, 0, 250]) * [1 / 65, 0, 64 / 65], atol=1)


def test_what_stands_in_front_and_what_has_no_depth_is_not_painted():
    rgb, depth = view(DOWN, paint=plain([10, 200, 10]))
    depth[:, :60] = 0.8  # something between camera and sheet
    depth[:, 100:] = np.nan
    picture = painted((rgb, depth, DOWN, 1.0)).textured().picture
    is_painted = (picture == [10, 200, 10]).all(axis=2)
    assert 0.1 < is_painted.mean() < 0.6 and (picture[~is_painted] == 90).all()
    below = se3.inverse(se3.exp(np.array([0, 0, 0, np.pi, 0, 0.0])) @ se3.inverse(DOWN))
    assert painted((rgb, view(DOWN)[1], below, 1.0)).covered() == 0.0  # the other side


def test_the_order_of_views_hardly_matters_and_the_same_views_give_the_same_bytes():
    views = [(*view(T), T, 1.0) for T in (DOWN, look_along([-0.9, 0.1, 1.2], 0.0, 0.85), look_along([0.4, 0.9, 1.1], -1.5, 0.8))]
    pictures = [painted(*order).textured().picture for order in (views, views, views[::-1])]
    assert pictures[0].tobytes() == pictures[1].tobytes() and np.abs(pictures[0].astype(int) - pictures[2]).max() <= 1


def test_charts_do_not_overlap_and_hold_the_whole_surface():
    rng = np.random.default_rng(0)
    mesh, _ = sheet()
    bent = mesh.xyz + np.column_stack([0 * mesh.xyz[:, :2], 0.4 * (mesh.xyz[:, 0] > 0.1)]) + rng.normal(0, 0.01, mesh.xyz.shape)
    mesh = Mesh(bent.astype(np.float32), mesh.rgb, mesh.normal, mesh.triangle)
    uv = texture.unwrap(mesh, size=256)
    assert uv.shape == (len(mesh.triangle), 3, 2) and uv.min() >= 0.0 and uv.max() <= 1.0
    a, b = uv[:, 1] - uv[:, 0], uv[:, 2] - uv[:, 0]
    area = 0.5 * np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]) * 256**2
    owner = np.full((256, 256), -1, np.int32)
    texture._own(uv, owner)
    assert (owner >= 0).sum() == pytest.approx(area.sum(), rel=0.02)
    assert np.abs(np.bincount(owner[owner >= 0], minlength=len(area)) - area).max() < 0.2 * area.max()
    assert texture.unwrap(mesh, size=256).tobytes() == uv.tobytes()


def test_sharpness_falls_with_blur_and_hardly_follows_contrast():
    import cv2

    image = np.random.default_rng(0).integers(0, 200, (60, 80)).astype(np.uint8)
    image = cv2.GaussianBlur(cv2.resize(image, (320, 240)), (0, 0), 1.0)
    found = [texture.sharpness(cv2.GaussianBlur(image, (0, 0), sigma)) for sigma in (0.3, 2.0, 4.0)]
    assert found[0] > 1.3 * found[1] and found[1] > found[2] > 0.0
    assert texture.sharpness((image * 0.6).astype(np.uint8)) == pytest.approx(found[0], rel=0.15)
    assert texture.sharpness(np.zeros((10, 10), np.uint8)) == 0.0


def test_texels_and_paint_match_their_slow_twins():
    rng = np.random.default_rng(2)
    mesh, uv = sheet(n=2)
    uv = np.ascontiguousarray(uv @ np.float32([[0.9, 0.3], [-0.25, 0.8]]) * np.float32(0.7) + np.float32([0.2, 0.02]))
    painter = Painter(mesh, uv, CAMERA, size=24)
    T, rgb = look_along([-0.7, 0.2, 0.9], 0.2, 0.8), rng.integers(0, 255, (120, 160, 3)).astype(np.uint8)
    depth = view(T)[1]
    depth[:, 70:90] -= 0.2
    painter.add(rgb, depth, T, quality=0.9)
    T_cw, n = np.linalg.inv(T), 0
    for m, corners in enumerate(uv * 24.0):
        for row in range(painter._surface.first[m], painter._surface.first[m + 1]):
            at = np.array([painter._texel[row] % 24 + 0.5, painter._texel[row] // 24 + 0.5])
            share = np.linalg.solve(np.vstack([corners.T, np.ones(3)]), [*at, 1.0])
            assert share.min() > -1e-4
            x = share @ mesh.xyz[mesh.triangle[m]]
            x_c = T_cw[:3, :3] @ x + T_cw[:3, 3]
            u, v = 130.0 * x_c[:2] / x_c[2] + [79.5, 59.5]
            border = min(u, 159 - u, v, 119 - v)
            weight, colour = 0.0, np.zeros(3)
            if border >= 1.0:
                i, j = int(v + 0.5), int(u + 0.5)
                around = depth[max(i - 2, 0) : i + 3, max(j - 2, 0) : j + 3]
                limit = texture.TOLERANCE + texture.TOLERANCE_GROWTH * x_c[2] ** 2
                cosine = (T[:3, 3] - x)[2] / np.linalg.norm(T[:3, 3] - x)
                if abs(depth[i, j] - x_c[2]) <= limit and around.min() >= x_c[2] - limit and cosine >= texture.LEAST_COSINE:
                    weight = (0.9 * cosine / np.linalg.norm(T[:3, 3] - x) * min(border / (texture.FEATHER * 120), 1.0)) ** 6
                    i, j, b, a = int(v), int(u), u - int(u), v - int(v)
                    square = rgb[i : i + 2, j : j + 2].astype(float)
                    colour = np.einsum("i,j,ijk->k", [1 - a, a], [1 - b, b], square) * weight
            np.testing.assert_allclose(painter._paint.weight[row], weight, rtol=2e-3, atol=1e-6)
            np.testing.assert_allclose(painter._paint.total[row], colour, rtol=2e-2, atol=0.05)
            n += weight > 0
    assert 40 < n < len(painter._texel)
