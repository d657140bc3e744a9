"""Islands and decimation, on spheres whose area is known."""

import numpy as np
import pytest

from slamcli.dense import mesh_cleaning
from slamcli.dense.tsdf import Mesh

trimesh = pytest.importorskip("trimesh")


def sphere(radius: float, centre: list[float], colour: int) -> Mesh:
    ball = trimesh.creation.icosphere(subdivisions=3, radius=radius)
    n = len(ball.vertices)
    normal = (ball.vertices / radius).astype(np.float32)
    return Mesh((ball.vertices + centre).astype(np.float32), np.full((n, 3), colour, np.uint8), normal, ball.faces.astype(np.int32))


def joined(*meshes: Mesh) -> Mesh:
    first = np.cumsum([0, *(len(mesh.xyz) for mesh in meshes[:-1])])
    triangle = np.concatenate([mesh.triangle + k for mesh, k in zip(meshes, first, strict=True)]).astype(np.int32)
    return Mesh(*(np.concatenate([getattr(mesh, name) for mesh in meshes]) for name in ("xyz", "rgb", "normal")), triangle)


def test_areas_are_a_spheres() -> None:
    assert mesh_cleaning.triangle_areas(sphere(0.5, [0, 0, 0], 9)).sum() == pytest.approx(np.pi, rel=0.02)


def test_only_small_parts_are_dropped_and_the_rest_stays_as_it_was() -> None:
    big, small = sphere(0.5, [0, 0, 0], 200), sphere(0.02, [2, 0, 0], 50)  # 3.1 and 0.005 m2
    kept = mesh_cleaning.without_islands(joined(small, big), min_area=0.01)
    assert np.array_equal(kept.xyz, big.xyz) and np.array_equal(kept.triangle, big.triangle) and (kept.rgb == 200).all()
    assert len(mesh_cleaning.without_islands(joined(small, big), min_area=0.001).triangle) == 2 * len(big.triangle)
    assert len(mesh_cleaning.without_islands(joined(small, big), min_area=4.0).triangle) == 0


def test_decimation_keeps_shape_and_colour_and_repeats_itself() -> None:
    whole = sphere(0.5, [1, 2, 3], 120)
    less = mesh_cleaning.decimated(whole, triangles=300)
    assert 200 < len(less.triangle) <= 300
    assert np.abs(np.linalg.norm(less.xyz - [1, 2, 3], axis=1) - 0.5).max() < 0.03
    assert np.abs(less.rgb.astype(int) - 120).max() <= 1
    assert ((less.normal * (less.xyz - [1, 2, 3])).sum(axis=1) > 0.4).all()
    again = mesh_cleaning.decimated(whole, triangles=300)
    assert np.array_equal(less.xyz, again.xyz) and np.array_equal(less.triangle, again.triangle)
    assert mesh_cleaning.decimated(whole, triangles=10**6) is whole
