"""Simulated recordings as written: exact truth, determinism, options, errors."""

import json
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from slamcli.datasets import Dataset, open_dataset, silent
from slamcli.datasets.simulate import Simulation, simulate
from slamcli.errors import SlamError
from slamcli.formats.trajectory import write_tum
from slamcli.geometry import se3
from slamcli.schema import Trajectory

SMALL = {"frames": 6, "width": 96, "height": 72, "laps": 0.5}


@pytest.fixture(scope="module")
def exact(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return simulate(tmp_path_factory.mktemp("simulated") / "exact", progress=silent, seed=2, noise="none", movable=True, **SMALL)


def poses(dataset: Dataset) -> np.ndarray:
    truth = dataset.ground_truth()
    return truth.T_wc[np.searchsorted(truth.stamp, dataset.stamp - 1e-7)]


def distance_to_surfaces(x_l: np.ndarray, scene: dict, without: set[str]) -> np.ndarray:
    """Distance (N,) from points to the nearest surface that scene.json describes."""
    low, high = np.array(scene["room"]["min"]), np.array(scene["room"]["max"])
    best = np.minimum(np.abs(x_l - low), np.abs(x_l - high)).min(axis=1)
    for obstacle in scene["obstacles"]:
        if obstacle["name"] in without:
            continue
        local = x_l - obstacle["centre"]
        if obstacle["type"] == "cylinder":
            radial = np.linalg.norm(local[:, :2], axis=1) - obstacle["radius"]
            outside = np.stack([radial, np.abs(local[:, 2]) - obstacle["height"] / 2], axis=1)
        else:
            c, s = np.cos(obstacle["yaw"]), np.sin(obstacle["yaw"])
            local = local @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
            outside = np.abs(local) - np.array(obstacle["size"]) / 2
        signed = np.linalg.norm(np.maximum(outside, 0), axis=1) + np.minimum(outside.max(axis=1), 0)
        best = np.minimum(best, np.abs(signed))
    return best


def test_every_depth_pixel_lies_on_a_surface_of_the_scene(exact: Path) -> None:
    """Pose, intrinsics, depth and scene.json agree: one wrong axis, sign or half pixel anywhere would show."""
    dataset, scene = open_dataset(str(exact)), json.loads((exact / "scene.json").read_text())
    gone = scene["gone"][0]
    for i in range(len(dataset)):
        depth = dataset.depth(i)
        assert np.isfinite(depth).all()
        x_c = np.dstack([dataset.camera.rays, np.ones(depth.shape)]) * depth[..., None]
        x_l = se3.transform(poses(dataset)[i], x_c.reshape(-1, 3))
        missing = {gone["name"]} if dataset.stamp[i] >= gone["from"] else set()
        off = distance_to_surfaces(x_l, scene, missing)
        # A cylinder is drawn with 20 facets: at most r (1 - cos 9 deg) = 3 mm inside its true surface; depth steps are 0.2 mm.
        assert off.max() < 4e-3 and np.median(off) < 2e-4


def test_the_movable_box_is_seen_only_in_the_first_half(tmp_path: Path) -> None:
    """Rendered from one place, so that nothing else changes."""
    still = Trajectory(stamp=np.arange(4.0), T_wc=np.tile(standing(), (4, 1, 1)))
    write_tum(tmp_path / "still.txt", still)
    settings = {"seed": 0, "trajectory": tmp_path / "still.txt", "noise": "none", "movable": True, "rate": 2.0, "frames": 4}
    dataset = open_dataset(str(simulate(tmp_path / "r", progress=silent, **settings, width=64, height=48, field_of_view=110)))
    assert np.array_equal(dataset.rgb(0), dataset.rgb(1)) and np.array_equal(dataset.rgb(2), dataset.rgb(3))
    assert json.loads((tmp_path / "r" / "scene.json").read_text())["gone"][0]["from"] == dataset.stamp[2]


def standing() -> np.ndarray:
    T_lc = np.eye(4)
    T_lc[:3, :3] = [[1, 0, 0], [0, 0, 1], [0, -1, 0]]  # looks along y, level
    T_lc[:3, 3] = [0.0, 0.0, 1.2]
    return T_lc


def test_two_views_of_one_point_have_one_colour(exact: Path) -> None:
    """Texture sticks to the surface: what features are matched on does not depend on where it is seen from."""
    folder_settings = {"seed": 2, "noise": "none", "frames": 2, "width": 320, "height": 240, "laps": 0.01}
    dataset = open_dataset(str(simulate(exact.parent / "near", progress=silent, **folder_settings)))
    T_ba = se3.inverse(poses(dataset)[1]) @ poses(dataset)[0]
    x_a = np.dstack([dataset.camera.rays, np.ones((240, 320))]) * dataset.depth(0)[..., None]
    x_b = se3.transform(T_ba, x_a.reshape(-1, 3)).reshape(240, 320, 3)
    xy = dataset.camera.project(x_b).astype(np.float32)
    seen = cv2.remap(dataset.grey(1), xy[..., 0], xy[..., 1], cv2.INTER_LINEAR).astype(float)
    depth = cv2.remap(dataset.depth(1), xy[..., 0], xy[..., 1], cv2.INTER_NEAREST)
    inside = (xy > 2).all(axis=2) & (xy < [317, 237]).all(axis=2) & (np.abs(depth - x_b[..., 2]) < 0.01)
    assert inside.mean() > 0.6
    assert np.abs(seen - dataset.grey(0))[inside].mean() < 4.0
    assert len(cv2.ORB_create(1000).detect(dataset.grey(0))) > 150


def test_noisy_depth_is_near_the_truth_and_has_holes(exact: Path, tmp_path: Path) -> None:
    noisy = open_dataset(str(simulate(tmp_path / "noisy", progress=silent, seed=2, movable=True, **SMALL)))
    true = open_dataset(str(exact))
    np.testing.assert_array_equal(poses(noisy), poses(true))
    for i in range(0, len(noisy), 2):
        measured, z = noisy.depth(i), true.depth(i)
        has = np.isfinite(measured)
        assert 0.4 < has.mean() < 0.999 and np.nanmax(measured) <= 5.0
        off = np.abs(measured - z)[has] / (0.0012 + 0.0019 * (z[has] - 0.4) ** 2 + 0.003 * z[has] ** 2)
        assert 0.2 < np.median(off) < 1.5


@pytest.mark.parametrize(("focal", "covered"), [(210.0, 0.99), (290.0, 0.82)])
def test_depth_of_a_camera_of_its_own_says_the_same_once_it_is_registered(tmp_path: Path, focal: float, covered: float) -> None:
    what = {"progress": silent, "seed": 2, "noise": "none", "frames": 1, "width": 320, "height": 240}
    plain, own = (
        open_dataset(str(simulate(tmp_path / name, **beside, **what))) for name, beside in (("plain", {}), ("own", {"depth_focal": focal}))
    )
    np.testing.assert_array_equal(own.grey(0), plain.grey(0))
    z, registered = plain.depth(0), own.depth(0)
    raw = cv2.imread(str(tmp_path / "own" / own.depth_name[0]), cv2.IMREAD_UNCHANGED) / 5000.0
    assert np.median(np.abs(raw - z)) > 0.02  # as it lies it is of another view
    has = np.isfinite(registered)
    assert has.mean() == pytest.approx(covered, abs=0.02)
    off = np.abs(registered - z)[has]
    assert np.median(off) < 0.0002 and (off > 0.05).mean() < 0.01  # the first is the step of a stored reading, the second at outlines


def test_same_seed_same_bytes_another_seed_another_room(exact: Path, tmp_path: Path) -> None:
    again = simulate(tmp_path / "again", progress=silent, workers=1, seed=2, noise="none", movable=True, **SMALL)
    names = sorted(str(path.relative_to(exact)) for path in exact.rglob("*") if path.is_file())
    assert len(names) == 2 * 6 + 5
    assert all((exact / name).read_bytes() == (again / name).read_bytes() for name in names)


def test_following_a_trajectory_keeps_its_motion_and_both_clocks(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    stamp = 100.0 + np.arange(50) * 0.1
    T_wc = np.tile(standing(), (50, 1, 1)) @ se3.exp(np.cumsum(rng.normal(0, 0.02, (50, 6)), axis=0))
    T_wc[:, 2, 3] -= 1.5  # below any floor: the whole motion is lifted
    write_tum(tmp_path / "t.txt", Trajectory(stamp=stamp, T_wc=T_wc))
    (tmp_path / "s.txt").write_text("# colour depth\n100.5 100.511\n100.6 100.595\n104.0 104.015\n999 999\n")
    out = simulate(
        tmp_path / "r", progress=silent, trajectory=tmp_path / "t.txt", stamps=tmp_path / "s.txt", frames=None, width=64, height=48
    )
    dataset = open_dataset(str(out))
    np.testing.assert_allclose(dataset.depth_stamp - dataset.stamp, [0.011, -0.005, 0.015], atol=1e-6)
    relative = se3.inverse(poses(dataset)[0]) @ poses(dataset)
    np.testing.assert_allclose(relative, se3.inverse(T_wc[5]) @ T_wc[[5, 6, 40]], atol=1e-6)
    truth = dataset.ground_truth()
    assert len(truth.stamp) == 6 and truth.T_wc[:, 2, 3].min() >= 0.4 - 1e-6
    low, high = (np.array(json.loads((out / "scene.json").read_text())["room"][key]) for key in ("min", "max"))
    assert (truth.T_wc[:, :2, 3] > low[:2] + 1.5).all() and (truth.T_wc[:, :2, 3] < high[:2] - 1.5).all()


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"frames": 0}, "frames = 0"),
        ({"width": 8}, "width = 8"),
        ({"laps": -1.0}, "laps"),
        ({"textured": 1.5}, "textured"),
        ({"room": (2.0, 2.0)}, "room"),
        ({"noise": "loud"}, "known are noise"),
        ({"trajectory": Path("none.txt")}, "none.txt: cannot be read"),
        ({"depth_min": 4.0, "depth_max": 3.0}, "depth_min"),
        ({"speed": float("nan")}, "speed"),
        ({"start": 1.5}, "start"),
        ({"depth_focal": 5.0}, "depth_focal"),
        ({"light": 0.0}, "light"),
        ({"building": True, "people": 2}, "building: takes no people"),
    ],
)
def test_settings_that_cannot_be_are_told(tmp_path: Path, settings: dict, said: str) -> None:
    with pytest.raises(SlamError, match=said):
        simulate(tmp_path / "r", progress=silent, **settings)
    assert list(tmp_path.iterdir()) == []


def test_stamps_from_a_device_are_refused(tmp_path: Path) -> None:
    write_tum(tmp_path / "t.txt", Trajectory(stamp=np.arange(2.0), T_wc=np.tile(standing(), (2, 1, 1))))
    with pytest.raises(SlamError, match="not a regular file"):
        simulate(tmp_path / "r", progress=silent, trajectory=tmp_path / "t.txt", stamps=Path("/dev/zero"))


@pytest.mark.parametrize("text", ["", "1 2 3\n", "a b\n", "nan 1\n"])
def test_malformed_stamps_are_told(tmp_path: Path, text: str) -> None:
    write_tum(tmp_path / "t.txt", Trajectory(stamp=np.arange(2.0), T_wc=np.tile(standing(), (2, 1, 1))))
    (tmp_path / "s.txt").write_text(text)
    with pytest.raises(SlamError, match=r"s\.txt: expected lines"):
        simulate(tmp_path / "r", progress=silent, trajectory=tmp_path / "t.txt", stamps=tmp_path / "s.txt")


def test_nothing_is_overwritten_and_interruption_leaves_nothing(tmp_path: Path) -> None:
    (tmp_path / "r").mkdir()
    (tmp_path / "r" / "mine").write_text("x")
    with pytest.raises(SlamError, match="exists already"):
        simulate(tmp_path / "r", progress=silent, **SMALL)

    def interrupt(items: object, label: str, total: int | None = None) -> object:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        simulate(tmp_path / "new", progress=interrupt, **SMALL)
    assert [path.name for path in tmp_path.iterdir()] == ["r"]


def test_command_line(slamcli: Callable, tmp_path: Path) -> None:
    result = slamcli("simulate", tmp_path / "r", "--frames", 2, "--width", 64, "--height", 48, "--alias", "corridor", "--textured", 0.5)
    assert result.exit_code == 0 and result.stdout.strip() == str(tmp_path / "r")
    assert len(open_dataset(str(tmp_path / "r"))) == 2
    assert slamcli("simulate", tmp_path / "r").exit_code == 1
    assert "--trajectory" in slamcli("simulate", tmp_path / "q", "--stamps", "x").stderr
    assert slamcli("simulate", tmp_path / "q", "--noise", "loud").exit_code == 2


def test_defaults_of_the_command_line_are_the_simulation_s() -> None:
    from slamcli.cli.simulate import simulate as command

    defaults = {parameter.name: parameter.default for parameter in command.params}
    for name in (
        "seed",
        "start",
        "light",
        "take",
        "twin",
        "gone_from",
        "rooms",
        "rate",
        "width",
        "height",
        "field_of_view",
        "camera_height",
        "pitch",
        "noise",
        "depth_min",
        "depth_max",
        "depth_aside",
        "depth_turn",
        "textured",
        "room",
    ):
        assert defaults[name] == getattr(Simulation(), name), name
