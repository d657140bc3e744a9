"""What the options of grid2d do, in the direction that their help promises."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import boxroom
import cv2
import numpy as np
import pytest
from boxroom import KINECT, kinect_noise, look_along

from slamcli import artifacts
from slamcli.config.options import Config, GridConfig, SensorConfig
from slamcli.depth import icp
from slamcli.depth.coarse_images import encode
from slamcli.formats import octomap
from slamcli.geometry.octree import DEPTH, Octree
from slamcli.navigation import grid
from slamcli.navigation.grid import FREE, OCCUPIED, build_grid
from slamcli.schema import CoarseDepth, FrameTimes, Grid, Ground, Map, Moving, Timing, Tracks
from slamcli.stages import grid2d

SETTINGS = GridConfig(stride=1, min_range=0.5, n_low=3, n_high=8)  # of images a quarter as wide as a Kinect's
BOX = ((3.0, 2.2, 0.0), (3.6, 2.8, 0.3))
T_LC = np.array([look_along([1.2 + 0.1 * i, 2.5, 0.6], 0.0, 0.35) for i in range(6)])


def built(boxes: tuple = (BOX,), **options) -> Grid:
    rng = np.random.default_rng(0)
    frames = [(kinect_noise(boxroom.render(T, boxes=boxes), rng), T) for T in T_LC]
    return build_grid(frames, KINECT, settings=replace(SETTINGS, **options), sensor=SensorConfig())


def within(made: Grid, box: tuple) -> np.ndarray:
    """The states of the cells below a box."""
    rows, columns = made.state.shape
    y, x = (made.origin[k] + (np.arange(n) + 0.5) * float(made.resolution) for k, n in ((1, rows), (0, columns)))
    return made.state[np.ix_((y > box[0][1]) & (y < box[1][1]), (x > box[0][0] - 0.05) & (x < box[1][0]))]


@pytest.mark.shows("grid2d.resolution")
def test_the_cells_are_as_large_as_asked_for() -> None:
    fine, coarse = (built(resolution=side) for side in (0.05, 0.1))
    assert float(coarse.resolution) == 0.1 and 0.2 < coarse.state.size / fine.state.size < 0.3


@pytest.mark.shows("grid2d.band_low")
def test_the_robot_drives_over_what_is_lower() -> None:
    sill = ((3.0, 2.0, 0.0), (3.3, 3.0, 0.12))
    blocks, is_driven_over = ((within(built((sill,), band_low=low), sill) == OCCUPIED).sum() for low in (0.05, 0.2))
    assert blocks > 20 and is_driven_over == 0


@pytest.mark.shows("grid2d.band_high")
def test_what_is_higher_than_the_robot_is_passable() -> None:
    board = ((3.0, 2.0, 0.6), (3.4, 3.0, 0.8))
    passes, is_hit = ((within(built((board,), band_high=high), board) == OCCUPIED).sum() for high in (0.5, 1.0))
    assert passes == 0 and is_hit > 10


@pytest.mark.shows("grid2d.stride")
def test_fewer_pixels_leave_fewer_cells_occupied() -> None:
    usual, sparse = ((built(stride=stride).state == OCCUPIED).sum() for stride in (1, 5))
    assert sparse < 0.7 * usual


@pytest.mark.shows("grid2d.n_low", "grid2d.n_high")
def test_so_many_points_leave_a_cell_open_and_so_many_say_full() -> None:
    assert view_of(5, GridConfig(n_low=6)) == pytest.approx(0.9) and view_of(5, GridConfig(n_low=3)) < 0.5
    assert view_of(12, GridConfig(n_high=12)) == pytest.approx(0.1) and view_of(12, GridConfig(n_high=40)) > 0.25


@pytest.mark.shows("grid2d.min_range", "grid2d.max_range")
def test_readings_out_of_range_tell_nothing_of_a_cell() -> None:
    usual, near, far = (built(**o) for o in ({}, {"max_range": 1.2}, {"min_range": 2.5}))
    assert (near.state != -1).sum() < 0.5 * (usual.state != -1).sum() and (within(near, BOX) != OCCUPIED).all()
    assert (within(usual, BOX) == OCCUPIED).any() and (within(far, BOX) == OCCUPIED).sum() < (within(usual, BOX) == OCCUPIED).sum()


def view_of(n: int, settings: GridConfig, *, before: float = 0.5, times: int = 1) -> float:
    """Enter views with n points into a cell that one view gave P(E) = `before`."""
    p, count = np.full((1, 1), before, np.float32), np.ones((1, 1), np.int32)
    update = grid.paper_update if settings.update == "paper" else grid.evidence_update
    for _ in range(times):
        update(p, count, np.array([0]), np.array([0]), np.array([n]), settings)
    return float(p[0, 0])


@pytest.mark.shows("grid2d.p_empty_empty", "grid2d.p_full_empty", "grid2d.p_floor")
def test_how_far_one_view_is_believed() -> None:
    assert [view_of(0, GridConfig(p_empty_empty=p)) for p in (0.6, 0.95)] == pytest.approx([0.6, 0.95])
    assert [view_of(50, GridConfig(p_full_empty=p)) for p in (0.05, 0.4)] == pytest.approx([0.05, 0.4])
    assert [view_of(0, GridConfig(p_floor=p), times=20) for p in (0.05, 0.2)] == pytest.approx([0.95, 0.8])


@pytest.mark.shows("grid2d.blend")
def test_the_papers_blend_weighs_what_was_empty_against_what_was_full() -> None:
    """(23) with P(E1) = 0.6: 0.9 / 0.6 of the one, 0.1 / 0.4 of the other."""
    found = [view_of(0, GridConfig(update="paper", blend=share), before=0.6) for share in (0.0, 0.2)]
    assert found == pytest.approx([0.25, 0.2 * 1.5 + 0.8 * 0.25])


@pytest.mark.shows("grid2d.update")
def test_the_papers_update_forgets_what_many_views_said() -> None:
    """Three views see a box, then it is masked: one empty view is all that the paper's rule needs."""
    frames = [(boxroom.render(T_LC[0], boxes=(BOX,)), T_LC[0])] * 4 + [(boxroom.render(T_LC[0], boxes=()), T_LC[0])]
    left = [
        (within(build_grid(frames, KINECT, settings=replace(SETTINGS, update=how), sensor=SensorConfig()), BOX) == OCCUPIED).sum()
        for how in ("evidence", "paper")
    ]
    assert left[1] < 0.5 * left[0]


@pytest.mark.shows("grid2d.m_low", "grid2d.m_high")
def test_a_cell_is_free_below_the_one_and_occupied_above_the_other() -> None:
    usual, hardly_free, hardly_occupied = (built(**o) for o in ({}, {"m_low": 0.011}, {"m_high": 0.989}))
    n = [[(made.state == state).sum() for made in (usual, hardly_free, hardly_occupied)] for state in (FREE, OCCUPIED)]
    assert n[0][1] < 0.9 * n[0][0] and n[0][2] == n[0][0]
    assert n[1][2] < 0.9 * n[1][0] and n[1][1] == n[1][0]


# the stage


class Recording(SimpleNamespace):
    """The images of a drive."""

    def __len__(self) -> int:
        return len(self.images)


class Drive:
    """What grid2d is given: frames of a room at their true poses; every image shows a bumper at its lower edge."""

    workers = 1

    def __init__(self, folder: Path) -> None:
        self.T_lc = np.array([look_along([1.2 + 0.05 * i, 2.5 + 0.2 * np.sin(0.4 * i), 0.6], 0.12 * i, 0.35) for i in range(24)])
        n, none, rng = len(self.T_lc), np.zeros(0), np.random.default_rng(0)
        self._folder, self.warnings, stamp = folder, [], np.arange(n) / 30.0
        images = [kinect_noise(boxroom.render(T, boxes=(BOX,)), rng) for T in self.T_lc]
        for image in images:
            image[104:, 50:110] = 0.6
        plane = np.array([0.0, 0.0, 1.0, 0.0])
        kf, ref = np.zeros(1, np.int32), np.zeros(n, np.int32)
        self._records = {
            FrameTimes: SimpleNamespace(stamp=stamp, depth_stamp=stamp),
            Ground: Ground(np.eye(4), plane, np.array(0.0), np.array(1.0), np.array(True)),
            Map: Map(kf, 0 * kf, self.T_lc[:1], none.reshape(0, 3), none.astype("i4"), none.astype("i4"), none.astype("i8")),
            Tracks: Tracks(ref, np.linalg.inv(self.T_lc[0]) @ self.T_lc, none, none),
            Timing: Timing(np.array(0.0), np.array(0.0), np.array(0.0), np.zeros((n, 6))),
            Moving: Moving(),
            CoarseDepth: encode([icp.coarsen(image) for image in images], icp.coarse_shape(KINECT)),
        }
        self.dataset = Recording(images=images, camera=KINECT, depth=lambda i, camera: images[i])

    def camera(self, stage: str = "extract"):
        return KINECT

    def load(self, cls: type, stage: str):
        return self._records[cls]

    def path(self, stage: str, *names: str) -> Path:
        return self._folder.joinpath(*names)

    def progress(self, items, label, total=None):
        return items

    def warn(self, message: str) -> None:
        self.warnings.append(message)


def run(folder: Path, **options) -> tuple[Grid, dict, list[str]]:
    out = folder / f"grid{len(list(folder.iterdir()))}"
    out.mkdir()
    cfg = Config(grid2d=replace(SETTINGS, **options))
    summary = grid2d.run(drive := Drive(folder), out, cfg, drive)
    return artifacts.load(Grid, out), summary, drive.warnings


@pytest.mark.shows("grid2d.spacing", "grid2d.spacing_deg")
def test_a_frame_is_used_when_the_camera_moved_or_turned_far_enough(tmp_path: Path) -> None:
    views = [
        run(tmp_path, spacing=metres, spacing_deg=degrees)[1]["views"] for metres, degrees in ((0.01, 180.0), (9.0, 5.0), (9.0, 180.0))
    ]
    assert views[0] == 24 and 10 < views[1] <= 24 and views[2] == 1


@pytest.mark.shows("grid2d.own_body")
def test_the_robots_own_body_is_left_out(tmp_path: Path) -> None:
    (with_body, _, quiet), (without, _, told) = (run(tmp_path, own_body=is_left_out, spacing=0.01) for is_left_out in (False, True))
    assert (without.state == OCCUPIED).sum() < (with_body.state == OCCUPIED).sum()
    assert not any("body" in text for text in quiet) and any("body" in text for text in told)


@pytest.mark.shows("grid2d.mask")
def test_masked_pixels_tell_nothing(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "mask.png"), np.full((120, 160), 255, np.uint8))
    seen, masked = (run(tmp_path, mask=mask)[0].state for mask in ("", str(tmp_path / "mask.png")))
    assert (seen != -1).any() and (masked == -1).all()


@pytest.mark.shows("grid2d.driven")
def test_floor_near_the_path_is_free_on_a_robot(tmp_path: Path) -> None:
    off, on = (run(tmp_path, driven=radius)[0] for radius in (0.0, 0.3))
    assert (on.state == FREE).sum() > (off.state == FREE).sum() + 20


@pytest.mark.shows("grid2d.source")
def test_the_grid_is_made_from_the_octree_if_asked_for(tmp_path: Path) -> None:
    tree = Octree(0.05, np.array([7]), np.array([DEPTH], np.uint8), np.array([2.0], np.float32))
    octomap.write_ot(tmp_path / "map.ot", tree)
    summary = run(tmp_path, source="octree")[1]
    assert "views" not in summary and summary["free"] == 0
