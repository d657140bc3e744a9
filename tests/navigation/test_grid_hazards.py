"""What a robot must not drive on or into, in analytic rooms: edges, things that hang, reflections, boxes too near to be measured."""

from dataclasses import replace

import numpy as np
import pytest
from boxroom import HANGING, KINECT, ROOM, cells, kinect_noise, look_along, render, round_trip

from slamcli.config.options import GridConfig, SensorConfig
from slamcli.geometry import se3
from slamcli.navigation import hanging
from slamcli.navigation.grid import FREE, OCCUPIED, UNKNOWN, build_grid

SETTINGS = GridConfig(stride=1, min_range=0.5, n_low=3, n_high=8)


def build(T_lc, *, boxes=(), room=ROOM, change=None, settings=SETTINGS, near=0.5, far=4.0):
    """Make a grid of noisy images; `change` (image, pose) alters the exact ones."""
    rng = np.random.default_rng(0)
    exact = (render(T, boxes=boxes, room=room) for T in T_lc)
    images = (z if change is None else change(z, T) for z, T in zip(exact, T_lc, strict=True))
    frames = [(kinect_noise(z, rng, near=near, far=far), T) for z, T in zip(images, T_lc, strict=True)]
    return build_grid(frames, KINECT, settings=settings, sensor=SensorConfig())


def drive(x0, x1, *, y=2.5, height=0.6, pitch=0.35, step=0.1, yaw=0.0):
    """Camera poses along x."""
    return np.stack([look_along([x, y, height], yaw, pitch) for x in np.arange(x0, x1, step)])


@pytest.mark.parametrize("depth", [0.12, 0.5])
def test_floor_beyond_an_edge_is_not_free(depth):
    upper = ((0.0, 0.0, -depth), (4.0, 5.0, 0.0))
    pit = ((0.0, 0.0, -depth), (8.0, 5.0, 2.5))
    made = build(drive(1.0, 3.4), boxes=(upper,), room=pit)
    assert (cells(made, 2.0, 2.0, 3.9, 3.0) == FREE).mean() > 0.95
    beyond = cells(made, 4.05, 0.0, 8.0, 5.0)
    assert (beyond == FREE).sum() == 0


@pytest.mark.shows("grid2d.drop")
def test_stairs_down_are_not_free_and_neither_is_a_pit_with_floor_behind_it():
    stairs = tuple(((3.0 + 0.28 * k, 0.0, -2.0), (3.28 + 0.28 * k, 5.0, -0.17 * k)) for k in range(1, 8))
    upper = ((0.0, 0.0, -2.0), (3.28, 5.0, 0.0))
    made = build(drive(1.0, 2.8), boxes=(upper, *stairs), room=((0.0, 0.0, -2.0), (8.0, 5.0, 2.5)))
    assert (cells(made, 2.0, 2.0, 3.2, 3.0) == FREE).mean() > 0.95
    assert (cells(made, 3.35, 0.0, 8.0, 5.0) != FREE).all()
    sides = (((0.0, 0.0, -0.6), (3.0, 5.0, 0.0)), ((3.6, 0.0, -0.6), (8.0, 5.0, 0.0)))
    made, careless = (
        build(drive(1.0, 2.6), boxes=sides, room=((0.0, 0.0, -0.6), (8.0, 5.0, 2.5)), settings=replace(SETTINGS, drop=drop))
        for drop in (0.08, 0.7)
    )
    assert (cells(made, 3.06, 2.0, 3.54, 3.0) != FREE).all() and (cells(careless, 3.06, 2.0, 3.54, 3.0) == FREE).any()
    assert (cells(made, 3.8, 2.2, 4.4, 2.8) == FREE).mean() > 0.9


def test_a_reflecting_patch_of_floor_neither_blocks_nor_frees():
    patch = (3.0, 2.2, 3.6, 2.8)

    def mirrored(depth, T_lc):
        """Where a line of sight meets the patch, the reading is of the wall or ceiling in the mirror, which lies below the floor."""
        mirror = ((0.0, 0.0, -2.5), (8.0, 5.0, 2.5))
        below = render(T_lc, boxes=(), room=mirror)
        ray = np.concatenate([KINECT.rays, np.ones((120, 160, 1), np.float32)], axis=2) @ T_lc[:3, :3].T
        at = T_lc[:3, 3] + depth[..., None] * ray
        is_patch = (np.abs(at[..., 2]) < 1e-3) & (at[..., 0] > patch[0]) & (at[..., 0] < patch[2])
        is_patch &= (at[..., 1] > patch[1]) & (at[..., 1] < patch[3])
        return np.where(is_patch, below, depth)

    made = build(drive(1.0, 2.8), change=mirrored, far=6.0)
    inside = cells(made, 3.06, 2.26, 3.54, 2.74)
    assert (inside == UNKNOWN).all()
    assert (cells(made, 2.0, 2.2, 2.9, 2.8) == FREE).mean() > 0.95
    assert (cells(made, 3.7, 2.2, 4.4, 2.8) == FREE).mean() > 0.9  # virtual points run below this floor


def test_points_of_one_view_in_the_air_do_not_block():
    T = drive(1.0, 2.8)

    def ghost(depth, T_lc):
        return np.where(np.isclose(T_lc[0, 3], 1.8) & (np.indices(depth.shape)[1] // 20 == 4) & (depth > 1.5), 1.4, depth)

    clean, made = build(T), build(T, change=ghost)
    assert (made.state == OCCUPIED).sum() <= (clean.state == OCCUPIED).sum() + 2


def test_a_ceiling_seen_a_third_of_the_time_and_beams_above_the_robot_are_no_obstacles():
    low_room, beam, table = ((0.0, 0.0, 0.0), (8.0, 5.0, 2.4)), ((3.0, 0.0, 1.3), (3.3, 5.0, 1.6)), ((3.0, 1.0, 0.40), (3.8, 1.6, 0.44))
    T = np.concatenate([drive(1.0, 4.5), drive(1.0, 4.5, pitch=-0.7, step=0.2)])
    made = build(T, boxes=(beam, table), room=low_room)
    assert (cells(made, 2.0, 2.0, 5.0, 3.0) == FREE).mean() > 0.95
    assert (cells(made, 2.95, 0.95, 3.85, 1.65) == OCCUPIED).mean() > 0.2
    assert (cells(made, 3.05, 1.05, 3.75, 1.55) == FREE).mean() < 0.02


def test_a_low_box_stays_when_the_camera_is_too_near_to_measure_it():
    box = ((3.5, 2.3, 0.0), (3.8, 2.7, 0.12))
    made = build(drive(1.5, 3.45, height=0.4, pitch=0.3, step=0.06), boxes=(box,), near=0.4)
    assert (cells(made, *box[0][:2], *box[1][:2]) == OCCUPIED).mean() > 0.85
    assert (cells(made, *box[0][:2], *box[1][:2]) == FREE).sum() == 0


def test_a_hanging_box_is_filled_between_two_faces_and_the_floor_beyond_it_is_free():
    made = build(round_trip(), boxes=(HANGING,))
    (x0, y0, _), (x1, y1, _) = HANGING
    inside = cells(made, x0, y0, x1, y1)
    assert (inside == OCCUPIED).mean() > 50 / 70 and (inside == FREE).sum() == 0
    around = cells(made, x0 - 0.5, y0 - 0.5, x1 + 0.5, y1 + 0.5)
    assert (around == OCCUPIED).sum() <= (inside == OCCUPIED).sum() + 2 * (10 + 7) + 4


def test_floor_under_a_shelf_is_free_once_lines_of_sight_cross_where_the_shelf_could_reach():
    board = ((3.0, 2.0, 0.3), (3.1, 3.0, 0.9))
    ahead = drive(1.0, 2.2)
    assert (cells(build(ahead, boxes=(board,)), 3.3, 2.3, 3.6, 2.7) == FREE).mean() < 0.1
    across = np.stack([look_along([3.2 + 0.1 * k, 0.8, 0.6], np.pi / 2, 0.25) for k in range(6)])
    made = build(np.concatenate([ahead, across]), boxes=(board,))
    assert (cells(made, 3.3, 2.3, 3.6, 2.7) == FREE).mean() > 0.95
    assert (cells(made, 3.0, 2.0, 3.1, 3.0) != FREE).all()


@pytest.mark.parametrize("degrees", [0, 17, 45, 80])
def test_the_rectangle_of_two_faces_is_their_things(degrees):
    rng = np.random.default_rng(degrees)
    along, across = np.linspace(0, 12, 13), np.linspace(0, 8, 9)
    faces = np.concatenate([np.stack([along, 0 * along], axis=1), np.stack([0 * across, across], axis=1)])
    a = np.radians(degrees)
    R = np.array([[np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]])
    found = hanging.fit_rectangle((faces + rng.uniform(-0.3, 0.3, faces.shape)) @ R.T + [20.0, 30.0])
    assert sorted(found.sides) == pytest.approx([8.0, 12.0], abs=0.9)
    np.testing.assert_allclose(found.centre, R @ [6.0, 4.0] + [20.0, 30.0], atol=0.6)


def test_a_thing_seen_from_one_side_is_not_filled():
    hangs = np.zeros((40, 40), np.uint16)
    hangs[10, 10:20] = 0xFF00
    things = hanging.find(hangs, widest=20.0)
    assert not things.inside.any() and not things.face.any()
    hangs[10:18, 10] = 0xFF00
    things = hanging.find(hangs, widest=20.0)
    assert things.inside[11:17, 11:19].all() and not things.inside[:, 22:].any()
    assert (things.face[10, 10:20] == things.around[14, 14]).all() and things.around[14, 14] > 0
    assert not hanging.find(np.kron(hangs, np.ones((3, 3), np.uint16)), widest=20.0).inside.any()  # too large for one thing


def test_a_thing_seen_all_over_from_above_has_the_outline_seen_whichever_of_its_sides_were():
    hangs = np.zeros((40, 40), np.uint16)
    hangs[10:19, 10:19] = 0x8000
    hangs[10:13, 10:13] = hangs[16:19, 10:13] = hangs[10:13, 16:19] = hangs[16:19, 16:19] = 0
    things = hanging.find(hangs, widest=20.0)
    assert (things.face[12:17, 12:17] > 0).all()
    hangs[12:17, 12:17] = 0
    assert not hanging.find(hangs, widest=20.0).face.any(), "nor were its sides"


def test_poses_in_any_frame_give_the_same_hazards():
    upper, pit = ((0.0, 0.0, -0.5), (4.0, 5.0, 0.0)), ((0.0, 0.0, -0.5), (8.0, 5.0, 2.5))
    T = drive(1.0, 3.4)
    turn = se3.exp(np.array([0.35, -0.8, 0.0, 0.0, 0.0, 0.0]))
    images = [render(t, boxes=(upper,), room=pit) for t in T]
    a, b = (build_grid(zip(images, poses, strict=True), KINECT, settings=SETTINGS, sensor=SensorConfig()) for poses in (T, turn @ T))
    assert (a.state == b.state).mean() > 0.995
