"""The furnished room: what must hold of every seed, without rendering."""

import json

import numpy as np
import pytest
from boxroom import look_along, render

from slamcli.datasets.simulate import Simulation, build
from slamcli.datasets.simulated import noise
from slamcli.datasets.simulated.scene import Scene, Solid, box, cylinder, with_textured_share
from slamcli.datasets.simulated.texture import flat
from slamcli.geometry import se3

SEEDS = range(12)


def footprint(solid: Solid) -> np.ndarray:
    """Corners of the bounding rectangle, turned by yaw."""
    half = solid.size[:2] / 2
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * half
    c, s = np.cos(solid.yaw), np.sin(solid.yaw)
    return corners @ np.array([[c, s], [-s, c]]) + solid.centre[:2]


def distance(solid: Solid, points: np.ndarray) -> np.ndarray:
    """Plan distance from points (N, 2) to a solid's rectangle."""
    c, s = np.cos(solid.yaw), np.sin(solid.yaw)
    local = np.abs((points - solid.centre[:2]) @ np.array([[c, -s], [s, c]]))
    return np.linalg.norm(np.maximum(local - solid.size[:2] / 2, 0.0), axis=1)


@pytest.mark.parametrize("seed", SEEDS)
def test_every_room_is_furnished_and_can_be_driven(seed: int) -> None:
    scene, motion = build(Simulation(seed=seed, movable=True))
    names = {solid.name for solid in scene.solids}
    assert {"hanging_box", "low_box", "moved_box"} <= names and len(names) == len(scene.solids)
    assert len({name.split("/")[0] for name in names}) >= 9
    centres = motion.colour_T_lc[:, :2, 3]
    for solid in scene.solids:
        corners = footprint(solid)
        assert (corners > scene.low[:2] - 0.02).all() and (corners < scene.high[:2] + 0.02).all()
        assert solid.centre[2] - solid.size[2] / 2 > -1e-9 and solid.centre[2] + solid.size[2] / 2 < scene.high[2] + 1e-9
        assert distance(solid, centres).min() > 0.15, solid.name


@pytest.mark.parametrize("seed", SEEDS)
def test_the_two_boxes_are_where_a_planar_laser_misses_them(seed: int) -> None:
    scene, _ = build(Simulation(seed=seed))
    solids = {solid.name: solid for solid in scene.solids}
    hanging, low = solids["hanging_box"], solids["low_box"]
    assert hanging.centre[2] - hanging.size[2] / 2 == pytest.approx(0.3) and hanging.centre[2] + hanging.size[2] / 2 > 0.5
    assert low.centre[2] - low.size[2] / 2 == pytest.approx(0.0) and low.size[2] < 0.2


def test_seeds_differ_and_a_seed_repeats_itself() -> None:
    described = [json.dumps(build(Simulation(seed=seed))[0].to_dict()) for seed in (1, 1, 2)]
    assert described[0] == described[1] != described[2]


def closed_volume(solid: Solid) -> float:
    """Volume by the divergence theorem over the patches; wrong winding or a gap shows at once."""
    total = 0.0
    for patch in solid.patches():
        normal = -np.cross(patch.a, patch.b)
        normal /= np.linalg.norm(normal)
        p = patch.polygon
        area = sum(np.linalg.norm(np.cross(p[k] - p[0], p[k + 1] - p[0])) / 2 for k in range(1, len(p) - 1))
        np.testing.assert_allclose((p - patch.origin) @ normal, 0.0, atol=1e-9)  # corners and picture share a plane
        assert normal @ np.cross(p[1] - p[0], p[2] - p[0]) > 0  # counter-clockwise seen from outside
        total += (p[0] @ normal) * area / 3
    return total


def test_solids_are_closed_and_face_outwards() -> None:
    raised_box = box("b", (1.0, 2.0, 0.5), (0.4, 0.6, 0.8), {"": flat((1, 1, 1))}, yaw=0.4)
    assert closed_volume(raised_box) == pytest.approx(0.4 * 0.6 * 0.8)
    raised_cylinder = cylinder("c", (1.0, 2.0, 0.5), 0.3, 0.7, {"": flat((1, 1, 1))})
    polygon_area = 0.5 * 20 * 0.3**2 * np.sin(2 * np.pi / 20)
    assert closed_volume(raised_cylinder) == pytest.approx(polygon_area * 0.7)
    assert len(box("b", (0, 0, 0), (1, 1, 1), {"": flat((1, 1, 1))}).patches()) == 5  # standing on the floor: no bottom


def test_the_shell_is_closed_and_faces_inwards() -> None:
    scene, _ = build(Simulation())
    volume = 0.0
    for patch in scene.shell:
        normal = -np.cross(patch.a, patch.b)
        volume -= patch.origin @ normal / 3
    assert volume == pytest.approx(np.prod(scene.high - scene.low))


def test_an_empty_room_holds_nothing() -> None:
    full, empty = (build(Simulation(seed=1, empty=flag))[0] for flag in (False, True))
    assert full.solids and not empty.solids and len(empty.shell) == len(full.shell)


def test_surface_without_reading_is_the_same_in_every_view() -> None:
    camera, T_lc = Simulation(width=160, height=120).camera(), np.array([look_along([1.0, 1.0, 1.0], yaw, 0.3) for yaw in (0.0, 0.3)])
    depth = [render(T, camera) for T in T_lc]
    lost = [noise.without_reading(z, T, camera, share=0.4, seed=3) for z, T in zip(depth, T_lc, strict=True)]
    assert all(0.25 < one.mean() < 0.55 for one in lost)
    xyz = np.concatenate([camera.rays.astype(float), np.ones((120, 160, 1))], axis=-1) * depth[0][..., None]
    x_j = se3.transform(se3.inverse(T_lc[1]) @ T_lc[0], xyz.reshape(-1, 3))
    column, row = np.rint(camera.project(x_j)).astype(int).T
    inside = (x_j[:, 2] > 0.1) & (column >= 0) & (row >= 0) & (column < 160) & (row < 120)
    is_seen = inside.copy()
    is_seen[inside] = np.abs(depth[1][row[inside], column[inside]] - x_j[inside, 2]) < 0.02
    agree = lost[0].ravel()[is_seen] == lost[1][row[is_seen], column[is_seen]]
    assert is_seen.sum() > 5000 and agree.mean() > 0.93  # but at the edges of patches
    assert not noise.without_reading(depth[0], T_lc[0], camera, share=0.0, seed=3).any()


def test_twins_share_their_picture() -> None:
    scene, _ = build(Simulation(alias="posters"))
    shell = {("floor", "ceiling", "south", "north", "west", "east")[k]: patch for k, patch in enumerate(scene.shell)}
    for one, other in (("south", "north"), ("east", "west")):
        assert shell[one].key == shell[other].key and shell[one].painter is shell[other].painter


def test_share_of_textured_objects() -> None:
    patches = build(Simulation())[0].patches()
    for share in (0.0, 0.5, 1.0):
        changed = [a.painter is not b.painter for a, b in zip(patches, with_textured_share(patches, share, 3), strict=True)]
        assert np.mean(changed) == pytest.approx(1 - share, abs=0.35) and (share == 0.5 or np.mean(changed) == 1 - share)


def test_corridor_repeats_itself() -> None:
    scene, motion = build(Simulation(alias="corridor"))
    assert isinstance(scene, Scene) and scene.solids == []
    centres = motion.colour_T_lc[:, :3, 3]
    assert (centres > scene.low + 0.3).all() and (centres < scene.high - 0.3).all()
