"""A simulated building, and several recordings of one place: exact truth in one frame, a clear way, doors that look alike."""

import itertools
import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from slamcli.datasets import open_dataset, silent
from slamcli.datasets.simulate import OVERLAP, Simulation, build, simulate, simulate_several
from slamcli.datasets.simulated import building, drive
from slamcli.errors import SlamError
from slamcli.evaluation import grid_truth
from slamcli.schema import Trajectory

TINY = {"building": True, "rooms": 2, "frames": 6, "width": 64, "height": 48}


@pytest.mark.parametrize("n_rooms", [1, 2, 5, 10])
def test_the_way_leads_through_every_room_and_stays_clear_of_everything(n_rooms: int) -> None:
    path = building.way(n_rooms)
    step = np.linalg.norm(np.roll(path, -1, axis=0) - path, axis=1)
    assert len(path) == drive.DENSE and step.max() < 1.3 * np.median(step)
    for k in range(n_rooms):
        low, high, _ = building._room(k)
        inside = ((path > low) & (path < high)).all(axis=1)
        assert step[inside].sum() > 4.0
    scene = building.house(n_rooms, path, seed=3)
    solids = [solid.to_dict() for solid in scene.solids]
    for dx, dy in itertools.product((-0.2, 0.0, 0.2), repeat=2):  # a robot 0.4 m wide
        hit = np.zeros(len(path), dtype=bool)
        for solid in solids:
            hit |= grid_truth.footprint(solid, path + [dx, dy], 0.0, 1.0)
        assert not hit.any()


def test_rooms_differ_and_what_faces_the_corridor_looks_alike() -> None:
    scene, _ = build(Simulation(building=True, rooms=6))
    names = [solid.name for solid in scene.solids]
    assert len(set(names)) == len(names)
    furniture = [tuple(sorted(name.partition("_")[2] for name in names if name.startswith(f"room{k}_"))) for k in range(6)]
    assert all(len(pieces) > 5 for pieces in furniture) and len(set(furniture)) == 6
    for part in ("left", "right", "above"):
        for side in ("front", "back"):  # of the walls north and south of the corridor
            assert sum(patch.key == (f"corridor_{part}", side) for patch in scene.patches()) == 3


@pytest.fixture(scope="module")
def two(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    return simulate_several(tmp_path_factory.mktemp("building") / "out", 2, progress=silent, noise="none", laps=1.0, **TINY)


def test_every_recording_has_exact_truth_in_one_frame(two: list[Path]) -> None:
    assert [folder.name for folder in two] == ["1", "2"]
    scenes = [(folder / "scene.json").read_text() for folder in two]
    assert scenes[0] == scenes[1] and "wall_0_left" in scenes[0]
    scene = grid_truth.read_scene(two[0] / "scene.json")
    for folder in two:
        dataset = open_dataset(str(folder))
        truth = dataset.ground_truth()
        assert dataset.stamp[0] == 0.0 and len(dataset) == 6
        for i in range(len(dataset)):
            depth = dataset.depth(i)
            seen = np.isfinite(depth)
            rays = np.dstack([dataset.camera.rays, np.ones(depth.shape)])[seen].astype(float)
            expected = grid_truth.cast(scene, truth.T_wc[i, :3, 3], rays @ truth.T_wc[i, :3, :3].T)
            assert seen.mean() > 0.9
            off = np.abs(expected - depth[seen])
            assert np.median(off) < 3e-4 and np.quantile(off, 0.9) < 3e-3  # borders are a pixel's matter


def test_recordings_overlap_go_both_ways_and_differ_in_light(two: list[Path]) -> None:
    what = Simulation(building=True, rooms=2, frames=400, laps=(1.0 + OVERLAP) / 2)
    path = building.way(2)
    driven = [drive.turned(path, start=start, backwards=backwards) for start, backwards in ((0.0, False), (0.5 + what.laps, True))]
    n = round(what.laps * len(path))
    near = np.linalg.norm(driven[0][:n:20, None] - driven[1][None, :n:20], axis=2).min(axis=1) < 0.1
    assert 0.3 < near.mean() < 0.75
    first = [open_dataset(str(folder)).ground_truth() for folder in two]
    assert not np.allclose(first[0].T_wc[0], first[1].T_wc[0])
    light = [np.mean([open_dataset(str(folder)).grey(i) for i in range(6)]) for folder in two]
    assert 0.6 < light[1] / light[0] < 0.95


def test_another_light_and_take_change_pictures_and_not_the_truth(tmp_path: Path) -> None:
    settings = {"seed": 2, "frames": 3, "width": 64, "height": 48, "laps": 0.1}
    plain, other = (
        simulate(tmp_path / name, progress=silent, **settings, **more) for name, more in (("a", {}), ("b", {"light": 0.5, "take": 4}))
    )
    for name in ("groundtruth.txt", "scene.json", "camera.json"):
        assert (plain / name).read_bytes() == (other / name).read_bytes()
    a, b = open_dataset(str(plain)), open_dataset(str(other))
    assert b.grey(1).mean() == pytest.approx(0.5 * a.grey(1).mean(), rel=0.1)
    assert 0 < (a.depth(1) != b.depth(1)).mean() < 1


@pytest.mark.parametrize("start", [0.0, 0.3])
def test_a_drive_turned_goes_the_same_way_from_elsewhere(start: float) -> None:
    path = np.random.default_rng(0).random((100, 2))
    ahead, back = (drive.turned(path, start=start, backwards=backwards) for backwards in (False, True))
    first = round(100 * start)
    np.testing.assert_array_equal(ahead[0], path[first])
    np.testing.assert_array_equal(back[0], path[first])
    np.testing.assert_array_equal(ahead[1:], back[:0:-1])


def test_a_twin_has_the_same_patterns_arranged_otherwise() -> None:
    room, twin = (build(Simulation(seed=4, twin=number))[0] for number in (0, 1))
    assert room.seed == twin.seed
    places = [{solid.name: tuple(solid.centre.round(3)) for solid in scene.solids} for scene in (room, twin)]
    both = places[0].keys() & places[1].keys()
    assert "low_box" in both and all(places[0][name] != places[1][name] for name in ("low_box", "hanging_box"))


def test_command_line(slamcli: Callable, tmp_path: Path) -> None:
    flags = ["--building", "--rooms", 2, "--frames", 2, "--width", 64, "--height", 48]
    result = slamcli("simulate", tmp_path / "out", "--recordings", 2, *flags)
    assert result.exit_code == 0 and result.stdout.split() == [str(tmp_path / "out" / name) for name in ("1", "2")]
    before = (tmp_path / "out" / "1" / "rgb.txt").stat().st_mtime_ns
    assert slamcli("simulate", tmp_path / "out", "--recordings", 2, *flags).exit_code == 0
    assert (tmp_path / "out" / "1" / "rgb.txt").stat().st_mtime_ns == before
    assert json.loads((tmp_path / "out" / "2" / "scene.json").read_text())["room"]["max"][0] == pytest.approx(4.0)
    with pytest.raises(SlamError, match="recordings = 0"):
        simulate_several(tmp_path / "none", 0, progress=silent)


def test_motions_are_smooth_enough_to_be_tracked() -> None:
    _, motion = build(Simulation(building=True, rooms=2, frames=None, laps=1.0, rate=15.0))
    T_wc = Trajectory(stamp=motion.colour_stamp, T_wc=motion.colour_T_lc).T_wc
    step = np.linalg.norm(np.diff(T_wc[:, :3, 3], axis=0), axis=1)
    turn = np.degrees(np.arccos(np.clip(np.einsum("nk,nk->n", T_wc[1:, :3, 2], T_wc[:-1, :3, 2]), -1, 1)))
    assert step.max() < 0.08 and 1.0 < turn.max() < 12.0
