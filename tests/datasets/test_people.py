"""People in simulated rooms: drawn where they are, masked exactly, and not at all where none is asked for."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from slamcli.datasets import silent
from slamcli.datasets.simulate import DEPTH_SCALE, simulate
from slamcli.datasets.simulated import people
from slamcli.datasets.simulated.drive import Motion, look_along
from slamcli.datasets.simulated.figure_raycast import Crowd
from slamcli.datasets.simulated.figures import BOX, ELLIPSOID, BodyPart, Figure
from slamcli.datasets.simulated.texture import flat
from slamcli.errors import SlamError
from slamcli.geometry.camera import Camera

SMALL = {"frames": 5, "width": 96, "height": 72, "laps": 0.4, "seed": 3, "noise": "none"}
CAMERA = Camera(80, 60, 70.0, 70.0, 39.5, 29.5)


@pytest.fixture(scope="module")
def rooms(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """The same drive with and without people."""
    folder = tmp_path_factory.mktemp("people")
    return simulate(folder / "with", progress=silent, people=3, **SMALL), simulate(folder / "without", progress=silent, **SMALL)


def images(room: Path, kind: str) -> list[np.ndarray]:
    return [cv2.imread(str(path), cv2.IMREAD_UNCHANGED) for path in sorted((room / kind).glob("*.png"))]


def test_what_the_masks_leave_is_the_empty_room_and_what_they_mark_is_before_it(rooms: tuple[Path, Path]) -> None:
    crowded, empty = rooms
    masks = images(crowded, "moving")
    assert max((mask > 0).mean() for mask in masks) > 0.05
    for mask, depth, room in zip(masks, images(crowded, "depth"), images(empty, "depth"), strict=True):
        np.testing.assert_array_equal(depth[mask == 0], room[mask == 0])
        assert (depth[mask > 0] <= room[mask > 0]).all() and (depth[mask > 0] > 0.05 * DEPTH_SCALE).all()
    for mask, rgb, room in zip(masks, images(crowded, "rgb"), images(empty, "rgb"), strict=True):
        far = cv2.dilate(mask, np.ones((7, 7), np.uint8)) == 0
        np.testing.assert_array_equal(rgb[far], room[far])


def test_scene_json_tells_the_shares_of_the_masks(rooms: tuple[Path, Path]) -> None:
    crowded, empty = rooms
    moving = json.loads((crowded / "scene.json").read_text())["moving"]
    assert [one["name"] for one in moving][:3] == ["person_0", "person_1", "person_2"]
    for i, mask in enumerate(images(crowded, "moving")):
        for one in moving:
            assert one["share"][i] == pytest.approx((mask == one["value"]).mean(), abs=1e-4)
    assert not (empty / "moving").exists() and "moving" not in json.loads((empty / "scene.json").read_text())


def test_same_people_same_bytes(rooms: tuple[Path, Path], tmp_path: Path) -> None:
    again = simulate(tmp_path / "again", progress=silent, workers=1, people=3, **SMALL)
    for path in rooms[0].rglob("*.*"):
        assert path.read_bytes() == (again / path.relative_to(rooms[0])).read_bytes()


@pytest.mark.parametrize(("kind", "near"), [(ELLIPSOID, 0.3), (BOX, 0.3)])
def test_a_part_lies_where_geometry_says(kind: int, near: float) -> None:
    """A part of half axes 0.3, 0.2, 0.4 m, two metres ahead along its own x axis."""
    pose = np.eye(4)
    pose[:3, 3] = [2.0, 0.0, 1.0]
    part = BodyPart("part", kind, np.array([near, 0.2, 0.4]), flat((200, 100, 50)))
    figure = Figure("it", "box", [part], lambda stamp: np.tile(pose, (len(stamp), 1, 1, 1)))
    crowd = Crowd([figure], CAMERA, texel=0.01, seed=0)
    T_lc = look_along(np.array([[0.0, 0.0, 1.0]]), np.array([0.0]), 0.0, 0.0)[0]
    wall = np.full((60, 80), 5.0, np.float32)
    drawn = crowd.draw(T_lc, 0.0, np.full((60, 80, 3), 9.0, np.float32), wall, np.ones_like(wall))
    assert drawn.depth[29:31, 39:41] == pytest.approx(2.0 - near, abs=2e-3) and drawn.owner[30, 40] == 1
    rows, columns = np.nonzero(drawn.owner)
    face = 2.0 if kind == ELLIPSOID else 2.0 - near  # where its outline is
    width, height = 2 * 70.0 * 0.2 / face, 2 * 70.0 * 0.4 / face
    assert columns.max() - columns.min() + 1 == pytest.approx(width, abs=2) and rows.max() - rows.min() + 1 == pytest.approx(
        height, abs=2.5
    )
    assert drawn.depth[0, 0] == 5.0 and (drawn.rgb[0, 0] == 9.0).all()
    hue = drawn.rgb[30, 40] / drawn.rgb[30, 40, 0]
    np.testing.assert_allclose(hue, [1.0, 0.5, 0.25], atol=0.02)
    behind = crowd.draw(T_lc, 0.0, np.zeros((60, 80, 3), np.float32), np.full((60, 80), 1.0, np.float32), np.ones_like(wall))
    assert not behind.owner.any() and (behind.depth == 1.0).all()


def motion() -> Motion:
    stamp = np.arange(0.0, 20.0, 0.1)
    xy = np.column_stack([2.0 + 0.5 * stamp, 5.0 + 0.3 * np.sin(stamp)])
    T = look_along(np.column_stack([xy, np.full(len(stamp), 0.8)]), np.full(len(stamp), 0.05), -0.2, 0.0)
    return Motion(stamp, T, stamp, T)


@pytest.mark.parametrize("activity", people.ACTIVITIES)
@pytest.mark.parametrize("drives", [True, False])
def test_people_walk_as_people_can(activity: str, drives: bool) -> None:
    """Feet on the floor, heads up, no step faster than a run, some motion, and mostly before the camera."""
    camera = motion()
    figures = people.populate(camera, np.zeros(3), np.array([20.0, 10.0, 2.6]), people=1, activities=(activity,), drives=drives, seed=4)
    assert len(figures) == (2 if activity == "carry" else 1)
    stamp = np.arange(0.5, 19.5, 0.05)
    T = figures[0].pose(stamp)
    names = [part.name for part in figures[0].parts]
    pelvis, head = T[:, names.index("pelvis"), :3, 3], T[:, names.index("head"), :3, 3]
    foot = T[:, [names.index("left_foot"), names.index("right_foot")], 2, 3]
    speed = np.linalg.norm(np.diff(pelvis[:, :2], axis=0), axis=1) / 0.05
    assert speed.max() < 3.0 and speed.mean() > 0.2
    assert foot.min() > 0.0 and foot.min(axis=1).max() < 0.2
    assert head[:, 2].max() < 1.95 and (head[:, 2] - pelvis[:, 2]).min() > 0.5
    assert (pelvis[:, 2].min() < 0.65) == (activity == "sit")
    np.testing.assert_allclose(
        T[..., :3, :3] @ np.swapaxes(T[..., :3, :3], -1, -2), np.broadcast_to(np.eye(3), T[..., :3, :3].shape), atol=1e-9
    )
    at = np.searchsorted(camera.colour_stamp, stamp) - 1
    ahead = np.einsum("ni,ni->n", pelvis[:, :2] - camera.colour_T_lc[at, :2, 3], camera.colour_T_lc[at, :2, 2])
    assert (ahead > 0.2).mean() > 0.9


def test_a_carried_box_stands_until_it_is_taken_up() -> None:
    figures = people.populate(motion(), np.zeros(3), np.array([20.0, 10.0, 2.6]), people=1, activities=("carry",), drives=True, seed=4)
    place = figures[1].pose(np.array([0.0, 0.5, 1.0, 10.0, 19.0]))[:, 0, :3, 3]
    np.testing.assert_allclose(place[1], place[0], atol=1e-9)
    assert place[0, 2] < 0.25 and (place[3:, 2] > 0.8).all() and np.linalg.norm(place[4] - place[0]) > 2.0


@pytest.mark.parametrize(
    ("settings", "said"), [({"people": 99}, "people = 99"), ({"people": 1, "activities": ("fly",)}, "'fly' is unknown")]
)
def test_people_that_cannot_be_are_told(tmp_path: Path, settings: dict, said: str) -> None:
    with pytest.raises(SlamError, match=said):
        simulate(tmp_path / "r", progress=silent, **settings)
