"""Walls of a floor plan: lengths and angles of a made-up room come back, and what is no wall is none."""

import numpy as np
import pytest

from slamcli.navigation.walls import Wall, find_walls, joined_behind_furniture

NOISE = 0.008  # [m]


def face(a, b, *, low: float = 0.05, high: float = 1.6, spacing: float = 0.02, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Points on the vertical face from a to b, seen from its left, with noise: (xyz, normal)."""
    a, b, rng = np.array(a, float), np.array(b, float), np.random.default_rng(seed)
    along = (b - a) / np.linalg.norm(b - a)
    n = np.array([-along[1], along[0]])
    s, z = np.meshgrid(np.arange(0, np.linalg.norm(b - a), spacing), np.arange(low, high, spacing))
    xy = a + s.reshape(-1, 1) * along + rng.normal(0, NOISE, (s.size, 1)) * n
    turn = rng.normal(0, 0.05, s.size)
    normal = np.column_stack([n[0] * np.cos(turn) - n[1] * np.sin(turn), n[0] * np.sin(turn) + n[1] * np.cos(turn), 0 * turn])
    return np.column_stack([xy, z.ravel()]), normal


def cloud(*faces) -> tuple[np.ndarray, np.ndarray]:
    return np.concatenate([xyz for xyz, _ in faces]), np.concatenate([normal for _, normal in faces])


def turned(points: np.ndarray, degrees: float) -> np.ndarray:
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return points @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])


def room(width: float, depth: float, *, inset: float = 0.0) -> list:
    """Four walls seen from inside; `inset`: so much beside each corner was not seen."""
    corners = np.array([[0.0, 0.0], [width, 0.0], [width, depth], [0.0, depth]])
    faces = []
    for k in range(4):
        a, b = corners[k], corners[(k + 1) % 4]
        along = (b - a) / np.linalg.norm(b - a)
        faces.append(face(a + inset * along, b - inset * along, seed=k))
    return faces


def angle(wall: Wall) -> float:
    return float(np.degrees(np.arctan2(*(wall.end - wall.start)[::-1])))


@pytest.mark.parametrize("degrees", [0.0, 17.0, 45.0, 133.0])
def test_a_rooms_lengths_and_angles_come_back(degrees: float) -> None:
    xyz, normal = cloud(*room(6.2, 3.7, inset=0.2), face([2.0, 1.0], [3.0, 1.0], high=0.8))
    walls = find_walls(turned(xyz, degrees), turned(normal, degrees), least_height=1.2)
    assert len(walls) == 4, "the low furniture is no wall"
    assert sorted(wall.length for wall in walls) == pytest.approx([3.7, 3.7, 6.2, 6.2], abs=0.01)
    for wall in walls:
        assert abs((angle(wall) - degrees + 45.0) % 90.0 - 45.0) < 0.2
        assert wall.top == pytest.approx(1.57, abs=0.04)
    ends = np.array([end for wall in walls for end in (wall.start, wall.end)])
    apart = np.linalg.norm(ends[:, None] - ends, axis=2) + 9.0 * np.eye(8)
    assert apart.min(axis=1).max() < 1e-9, "every end is a corner that another wall has too"
    middle = turned(np.array([[3.1, 1.85, 0.0]]), degrees)[0, :2]
    assert all((middle - wall.start) @ wall.normal > 1.0 for wall in walls), "normals point into the room"


def test_a_door_parts_a_wall_and_a_niche_does_not() -> None:
    whole, doored = (
        cloud(face([0, 0], [2.0, 0]), face([2.3, 0], [5.0, 0], seed=1)),
        cloud(face([0, 0], [2.0, 0]), face([2.9, 0], [5.0, 0], seed=1)),
    )
    assert [wall.length for wall in find_walls(*whole, least_height=1.2)] == pytest.approx([5.0], abs=0.03)
    assert sorted(wall.length for wall in find_walls(*doored, least_height=1.2)) == pytest.approx([2.0, 2.1], abs=0.03)


def test_both_faces_of_a_thin_wall_are_found() -> None:
    walls = find_walls(*cloud(face([0, 0], [4.0, 0]), face([4.0, -0.12], [0, -0.12], seed=1)), least_height=1.2)
    assert len(walls) == 2
    assert walls[0].normal @ walls[1].normal == pytest.approx(-1.0, abs=1e-3)
    assert sorted(round(float(wall.start[1]), 1) for wall in walls) == [-0.1, 0.0]


def test_clutter_and_sparse_points_are_no_walls() -> None:
    rng = np.random.default_rng(3)
    xyz, normal = rng.uniform([0, 0, 0], [5, 4, 2], (30000, 3)), rng.normal(size=(30000, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    assert find_walls(xyz, normal, least_height=1.2) == []
    thin = face([0, 0], [4.0, 0], spacing=0.15)
    assert find_walls(*thin, least_height=1.2) == [], "one point in 15 cm each way is no surface"


def test_a_cloud_without_walls_has_none() -> None:
    floor = np.column_stack([np.random.default_rng(0).uniform(0, 4, (5000, 2)), np.zeros(5000)])
    assert find_walls(floor, np.tile([0.0, 0.0, 1.0], (5000, 1)), least_height=1.2) == []
    assert find_walls(np.zeros((0, 3)), np.zeros((0, 3)), least_height=1.2) == []


def test_pieces_of_a_wall_are_one_behind_furniture_and_two_beside_a_door() -> None:
    pieces = find_walls(
        *cloud(face([0, 0], [2.0, 0]), face([3.5, 0], [5.0, 0], seed=1), face([5.0, 0], [5.0, 3.0], seed=2)), least_height=1.2
    )
    assert len(pieces) == 3
    hidden = joined_behind_furniture(pieces, lambda places: np.zeros(len(places), bool))
    assert sorted(wall.length for wall in hidden) == pytest.approx([3.0, 5.0], abs=0.03)
    door = joined_behind_furniture(pieces, lambda places: (places[:, 0] > 2.3) & (places[:, 0] < 3.2))
    assert sorted(wall.length for wall in door) == pytest.approx([1.5, 2.0, 3.0], abs=0.03)
    slit = joined_behind_furniture(pieces, lambda places: (places[:, 0] > 2.3) & (places[:, 0] < 2.5))
    assert len(slit) == 2, "free floor narrower than any door is a gap in the furniture"


def test_pieces_are_joined_past_longer_walls_of_other_lines() -> None:
    pieces = find_walls(
        *cloud(face([0, 0], [2.5, 0]), face([3.5, 0], [5.0, 0], seed=1), face([5.0, 0], [5.0, 2.0], seed=2)), least_height=1.2
    )
    joined = joined_behind_furniture(pieces, lambda places: np.zeros(len(places), bool))
    assert sorted(wall.length for wall in joined) == pytest.approx([2.0, 5.0], abs=0.03)


def test_walls_on_parallel_lines_and_the_two_faces_of_one_stay_apart() -> None:
    walls = find_walls(
        *cloud(face([0, 0], [2.0, 0]), face([2.6, 0.2], [5.0, 0.2], seed=1), face([4.0, -0.02], [2.4, -0.02], seed=2)), least_height=1.2
    )
    assert len(joined_behind_furniture(walls, lambda places: np.zeros(len(places), bool))) == len(walls) == 3


def test_a_corner_behind_furniture_is_found_and_none_beyond_free_floor() -> None:
    pieces = find_walls(*cloud(face([0, 0], [3.5, 0]), face([5.0, 1.2], [5.0, 3.0], seed=1)), least_height=1.2)
    hidden = joined_behind_furniture(pieces, lambda places: np.zeros(len(places), bool))
    assert sorted(wall.length for wall in hidden) == pytest.approx([3.0, 5.0], abs=0.03)
    seen = joined_behind_furniture(pieces, lambda places: np.ones(len(places), bool))
    assert sorted(wall.length for wall in seen) == pytest.approx([1.8, 3.5], abs=0.03)
