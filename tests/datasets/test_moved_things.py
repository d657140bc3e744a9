"""A door that opens and a chair that is moved: where the pictures show them, where scene.json leaves them, and never moved in view unless they may be."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from slamcli.datasets import silent
from slamcli.datasets.simulate import DEPTH_SCALE, Simulation, build, simulate
from slamcli.datasets.simulated import moved_things
from slamcli.datasets.simulated.drive import Motion
from slamcli.datasets.simulated.moved_things import Moved
from slamcli.errors import SlamError
from slamcli.formats.trajectory import read_tum

SMALL = {"width": 96, "height": 72, "laps": 1.0, "rate": 1.0, "seed": 61, "noise": "none"}
FRAMES = 260


def moved(seed: int) -> tuple[Motion, Moved, Moved]:
    """The drive through a room, its door and its chair."""
    what = Simulation(seed=seed, frames=FRAMES, laps=1.2, moved_chair=True)
    scene, motion = build(what)
    doorway = max(scene.doorways, key=lambda one: moved_things.seconds_in_view(one, motion))
    return motion, moved_things.door(doorway, motion, np.random.default_rng(0)), moved_things.chair(scene.chair_places, motion)


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return simulate(tmp_path_factory.mktemp("moved") / "room", progress=silent, frames=24, door=True, moved_chair=True, **SMALL)


def on_surface(x: np.ndarray, box: dict) -> np.ndarray:
    """How far (N,) [m] points lie from the surface of a box of scene.json."""
    c, s = np.cos(box["yaw"]), np.sin(box["yaw"])
    local = (x - box["centre"]) @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    return np.abs((np.abs(local) - 0.5 * np.array(box["size"])).max(axis=1))


def test_when_all_is_over_the_pictures_show_both_where_scene_json_has_them(room: Path) -> None:
    about = json.loads((room / "scene.json").read_text())
    value = {one["name"]: one["value"] for one in about["moving"]}
    obstacles = {name: [o for o in about["obstacles"] if o["name"].startswith(name)] for name in ("door", "moved_chair")}
    assert [len(boxes) for boxes in obstacles.values()] == [1, 6]
    truth = read_tum(room / "groundtruth.txt")
    camera = Simulation(width=SMALL["width"], height=SMALL["height"]).camera()
    share = {one["name"]: np.array(one["share"]) for one in about["moving"]}
    for name, boxes in (("door", obstacles["door"]), ("chair", obstacles["moved_chair"])):
        i = int(np.flatnonzero(share[name] > 0.001)[-1])
        stem = f"{truth.stamp[i]:.6f}.png"
        mask, units = (cv2.imread(str(room / kind / stem), cv2.IMREAD_UNCHANGED) for kind in ("moving", "depth"))
        v, u = np.nonzero(mask == value[name])
        z = units[v, u] / DEPTH_SCALE
        x_c = np.column_stack([z[:, None] * camera.rays[v, u], z])
        x = x_c @ truth.T_wc[i, :3, :3].T + truth.T_wc[i, :3, 3]
        assert len(v) >= 5
        assert np.min([on_surface(x, box) for box in boxes], axis=0).max() < 0.002


@pytest.mark.parametrize("seed", [61, 63, 65])
def test_the_door_turns_about_its_hinge_from_the_wall_while_it_is_in_view(seed: int) -> None:
    motion, door, _ = moved(seed)
    stamp = motion.colour_stamp
    T, half = door.figure.pose(stamp)[:, 0], door.figure.parts[0].half
    hinge = (T @ [-half[0], 0.0, 0.0, 1.0])[:, :3]
    np.testing.assert_allclose(hinge, hinge[:1].repeat(len(hinge), axis=0), atol=1e-9)
    turned = np.arccos(np.clip(T[:, 0, 0] * T[0, 0, 0] + T[:, 1, 0] * T[0, 1, 0], -1, 1))
    turning = np.flatnonzero((turned > 0.01) & (turned < moved_things.OPENS_BY - 0.01))
    assert turned[0] < 1e-6 and turned[-1] == pytest.approx(moved_things.OPENS_BY) and (np.diff(turned) >= -1e-6).all()
    assert 0.7 * moved_things.OPENS_IN < stamp[turning[-1]] - stamp[turning[0]] <= moved_things.OPENS_IN
    assert moved_things._is_in_view(motion, T[0, :3, 3])[turning].mean() > 0.9
    scene, _ = build(Simulation(seed=seed, frames=FRAMES, laps=1.2))
    corners = (T[:, None] @ np.array([[sx * half[0], sy * half[1], 0.0, 1.0] for sx in (-1, 1) for sy in (-1, 1)])[..., None])[:, :, :2, 0]
    assert (corners > scene.low[:2]).all() and (corners < scene.high[:2]).all()


@pytest.mark.parametrize("seed", [61, 63, 65])
def test_the_chair_is_moved_once_unseen_and_seen_before_and_after(seed: int) -> None:
    motion, _, chair = moved(seed)
    place = chair.figure.pose(motion.colour_stamp).mean(axis=1)[:, :3, 3]
    (moves,) = np.flatnonzero(np.linalg.norm(np.diff(place, axis=0), axis=1) > 0)
    first, then = (moved_things._is_in_view(motion, place[k]) for k in (0, -1))
    assert not first[moves + 1] and not then[moves + 1]
    assert first[: moves + 1].sum() > 20 and then[moves + 1 :].sum() > 20
    assert np.linalg.norm(place[0, :2] - place[-1, :2]) > 0.5
    np.testing.assert_allclose(place[-1], np.mean([solid.centre for solid in chair.last], axis=0), atol=1e-9)


def test_a_room_in_which_nothing_moves_is_the_same_but_for_them(tmp_path: Path, room: Path) -> None:
    still = simulate(tmp_path / "still", progress=silent, frames=24, **SMALL)
    for path in sorted((still / "depth").glob("*.png")):
        mask, with_both, without = (
            cv2.imread(str(folder / kind / path.name), cv2.IMREAD_UNCHANGED)
            for folder, kind in ((room, "moving"), (room, "depth"), (still, "depth"))
        )
        np.testing.assert_array_equal(with_both[mask == 0], without[mask == 0])
    assert not (still / "moving").exists()


@pytest.mark.parametrize("where", [{"building": True}, {"alias": "corridor"}])
def test_places_without_doors_of_their_own_are_refused(tmp_path: Path, where: dict) -> None:
    with pytest.raises(SlamError, match="only in a room"):
        simulate(tmp_path / "no", progress=silent, door=True, **SMALL, **where)
