"""Floors that slope: ramps and steps that the robot climbs are free, what it cannot climb stands in its way."""

from dataclasses import replace

import numpy as np
import pytest
from boxroom import KINECT, cells, kinect_noise, look_along, render

from slamcli.config.options import GridConfig, SensorConfig
from slamcli.errors import SlamError
from slamcli.geometry import se3
from slamcli.navigation import grid_evidence, terrain
from slamcli.navigation.grid import FREE, MAX_CELLS, OCCUPIED, build_grid

SETTINGS = GridConfig(stride=1, min_range=0.5, n_low=3, n_high=8)
HALL = ((0.0, 0.0, -1.0), (9.0, 3.0, 2.6))
START, LENGTH = 3.0, 2.0  # [m] of the ramp along x


def with_ramp(depth, T_lc, *, rise, y=(0.0, 3.0)):
    """Put a ramp that rises along x, and the floor on its level behind it, into an exact image of an empty hall."""
    ray = np.concatenate([KINECT.rays.astype(np.float64), np.ones((KINECT.height, KINECT.width, 1))], axis=2) @ T_lc[:3, :3].T
    at, slope = T_lc[:3, 3], rise / LENGTH
    with np.errstate(divide="ignore", invalid="ignore"):
        ramp = (slope * (at[0] - START) - at[2]) / (ray[..., 2] - slope * ray[..., 0])
        top = (rise - at[2]) / ray[..., 2]
        side = [(edge - at[1]) / ray[..., 1] for edge in y]
    for t, ends in ((ramp, (START, START + LENGTH)), (top, (START + LENGTH, 9.0))):
        x = at + t[..., None] * ray
        is_on = (t > 0.0) & (x[..., 0] >= ends[0]) & (x[..., 0] <= ends[1]) & (x[..., 1] >= y[0]) & (x[..., 1] <= y[1])
        depth = np.where(is_on & (t < depth), t, depth)
    for t in side:
        x = at + t[..., None] * ray
        height = rise * np.clip((x[..., 0] - START) / LENGTH, 0.0, 1.0)
        is_on = (t > 0.0) & (x[..., 2] >= 0.0) & (x[..., 2] <= height)
        depth = np.where(is_on & (t < depth), t, depth)
    return depth.astype(np.float32)


def hall(*, rise, settings=SETTINGS, y=(0.0, 3.0), boxes=(), ahead=(1.0, 6.5)):
    """Make the grid of a drive along the hall, 0.6 m above floor and ramp, that looks to the left and to the right in turn."""
    rng, frames = np.random.default_rng(0), []
    lower = ((0.0, 0.0, -1.0), (9.0, 3.0, 0.0))
    for k, x in enumerate(np.arange(*ahead, 0.08)):
        lift = rise * np.clip((x - START) / LENGTH, 0.0, 1.0)
        pitch = 0.35 - (np.arctan2(rise, LENGTH) if START < x < START + LENGTH else 0.0)
        T = look_along([x, 1.5, 0.6 + lift], 0.2 * (-1) ** k, pitch)
        exact = with_ramp(render(T, boxes=(lower, *boxes), room=HALL), T, rise=rise, y=y)
        frames.append((kinect_noise(exact, rng), T))
    return build_grid(frames, KINECT, settings=settings, sensor=SensorConfig())


def rise_of(degrees):
    return LENGTH * np.tan(np.radians(degrees))


@pytest.mark.shows("grid2d.max_slope")
def test_a_ramp_of_6_degrees_and_the_floor_it_leads_to_are_free_and_a_box_on_it_is_not():
    box = ((4.0, 1.4, 0.0), (4.2, 1.7, rise_of(6.0) / 2 + 0.3))
    made = hall(rise=rise_of(6.0), boxes=(box,))
    assert (cells(made, 3.0, 1.0, 3.9, 2.0) == FREE).mean() > 0.97
    assert (cells(made, 4.6, 1.0, 5.0, 2.0) == FREE).mean() > 0.9 and (cells(made, 5.0, 1.0, 7.0, 2.0) == FREE).mean() > 0.95
    assert (cells(made, 3.98, 1.38, 4.22, 1.72) != FREE).all() and (cells(made, 4.0, 1.4, 4.2, 1.7) == OCCUPIED).mean() > 0.5
    assert (cells(made, 3.0, 0.3, 7.5, 2.7) == OCCUPIED).mean() < 0.02  # but for the box
    level_only = hall(rise=rise_of(6.0), boxes=(box,), settings=replace(SETTINGS, max_slope=0.0))
    assert (cells(level_only, 4.6, 1.0, 7.0, 2.0) == FREE).sum() == 0


def test_a_ramp_steeper_than_allowed_is_an_obstacle():
    steep = hall(rise=rise_of(14.0))
    assert (cells(steep, 3.4, 0.5, 5.0, 2.5) == FREE).sum() == 0 and (cells(steep, 3.4, 1.0, 4.6, 2.0) == OCCUPIED).mean() > 0.95
    assert (cells(steep, 5.0, 0.5, 7.0, 2.5) == FREE).sum() == 0
    assert (cells(steep, 1.8, 1.0, 2.95, 2.0) == FREE).mean() > 0.97
    climber = hall(rise=rise_of(14.0), settings=replace(SETTINGS, max_slope=18.0))
    assert (cells(climber, 3.2, 1.0, 5.0, 2.0) == FREE).mean() > 0.95


def test_a_ramp_down_is_free_and_no_hole():
    made = hall(rise=-rise_of(6.0), ahead=(1.0, 5.0))
    assert (cells(made, 3.0, 1.0, 5.0, 2.0) == FREE).mean() > 0.95


def test_the_side_of_a_ramp_is_not_free_where_it_is_higher_than_a_step():
    made = hall(rise=rise_of(6.0), y=(1.0, 2.0))
    assert (cells(made, 3.0, 1.2, 5.0, 1.8) == FREE).mean() > 0.9
    higher = START + SETTINGS.band_low / np.tan(np.radians(6.0)) + 0.1
    for across in ((0.85, 1.1), (1.9, 2.15)):
        assert (cells(made, higher, across[0], 7.0, across[1]) != FREE).any(axis=0).all()


@pytest.mark.parametrize(
    ("step", "climbs", "is_free"), [(0.015, 0.03, True), (0.045, 0.03, False), (0.045, 0.06, True), (0.10, 0.06, False)]
)
def test_a_threshold_is_passable_up_to_the_step_that_the_robot_climbs(step, climbs, is_free):
    threshold = ((3.0, 0.0, -1.0), (3.1, 3.0, step))
    made = hall(rise=0.0, boxes=(threshold,), settings=replace(SETTINGS, band_low=climbs), ahead=(1.0, 4.0))
    on_it = cells(made, 3.0, 1.0, 3.1, 2.0)
    assert (on_it == FREE).mean() > 0.95 if is_free else ((on_it == OCCUPIED).mean() > 0.8 and (on_it == FREE).sum() == 0)
    assert (cells(made, 3.3, 1.0, 4.5, 2.0) == FREE).mean() > 0.95


def test_two_steps_that_the_robot_climbs_lead_to_floor_and_a_higher_one_does_not():
    stairs = [((3.0, 0.0, -1.0), (9.0, 3.0, 0.04)), ((3.8, 0.0, -1.0), (9.0, 3.0, 0.08))]
    made = hall(rise=0.0, boxes=stairs, ahead=(1.0, 5.0))
    assert (cells(made, 3.0, 1.0, 5.5, 2.0) == FREE).mean() > 0.95
    high = [stairs[0], ((3.8, 0.0, -1.0), (9.0, 3.0, 0.16))]
    made = hall(rise=0.0, boxes=high, ahead=(1.0, 3.6))
    assert (cells(made, 3.85, 1.0, 5.5, 2.0) == FREE).sum() == 0


def surfaces(height):
    """The level surfaces of a map of heights (H, W), NaN = none, each seen well."""
    rows, columns = np.nonzero(np.isfinite(height))
    cell = np.column_stack([columns, rows]).repeat(terrain.LEAST_READINGS, axis=0)
    return terrain.add_up(cell.astype(np.int32), height[rows, columns].repeat(terrain.LEAST_READINGS))


def test_the_floor_is_followed_where_it_leads_and_not_onto_what_stands_on_it():
    height = np.zeros((30, 120))
    height[:, 40:80] = 0.005 * np.arange(40)  # 5.7 degrees
    height[:, 80:] = 0.2
    table = (slice(8, 14), slice(10, 20))
    height[table] = 0.7
    found = terrain.find_terrain(surfaces(height), settings=SETTINGS, max_cells=MAX_CELLS)
    expected = np.where(np.abs(height) > terrain.FLAT, height, 0.0)
    expected[table] = 0.0
    np.testing.assert_allclose(found.height, expected, atol=0.002)
    for change in ({"max_slope": 5.0}, {"band_low": 0.001}, {"band_low": 0.21}):
        assert terrain.find_terrain(surfaces(height), settings=replace(SETTINGS, **change), max_cells=MAX_CELLS) is None


def test_moving_by_whole_cells_moves_the_terrain_and_the_order_of_views_does_not_matter():
    rng = np.random.default_rng(0)
    cell = np.column_stack([rng.integers(-60, 60, 40000), rng.integers(-20, 20, 40000)]).astype(np.int32)
    height = np.clip(0.004 * cell[:, 0], 0.0, 0.2) + rng.normal(0.0, 0.002, 40000)
    found = []
    for order, shift in ((np.arange(40000), [0, 0]), (rng.permutation(40000), [-1000, 77])):
        seen = terrain.Surfaces()
        for part in np.array_split(order, 7):
            seen.add(terrain.add_up(cell[part] + np.array(shift, np.int32), height[part]))
        found.append(terrain.find_terrain(seen.together(), settings=SETTINGS, max_cells=MAX_CELLS))
    np.testing.assert_array_equal(found[1].low - found[0].low, [-1000, 77])
    np.testing.assert_allclose(found[0].height, found[1].height, atol=1e-6)
    assert found[0].height.max() > 0.15


def test_growing_matches_its_slow_twin():
    rng = np.random.default_rng(4)
    ramp = np.clip(0.006 * (np.arange(40) - 12), 0.0, None) + rng.normal(0.0, 0.004, (20, 40))
    ramp[rng.random(ramp.shape) < 0.1] += 0.2
    ramp[rng.random(ramp.shape) < 0.1] = np.nan
    start = np.where(np.arange(40) < 10, ramp, np.nan).astype(np.float32)
    start[np.abs(start) > 0.02] = np.nan
    levels = surfaces(ramp)
    mean, place = (levels.total / levels.n).astype(np.float32), levels.key // terrain.BINS
    i, j = (place >> terrain.CELL_BITS) - terrain.HALF_CELLS, (place & ((1 << terrain.CELL_BITS) - 1)) - terrain.HALF_CELLS
    first = np.searchsorted(i * 40 + j, np.arange(801)).astype(np.int32)
    got = start.copy()
    terrain._grow(first, (levels.key % terrain.BINS).astype(np.int32), levels.n, mean, 0.03, got)
    expected, queue = start.copy(), [tuple(cell) for cell in np.argwhere(np.isfinite(start))]
    while queue:
        r, c = queue.pop(0)
        for r2 in range(max(r - 1, 0), min(r + 2, 20)):
            for c2 in range(max(c - 1, 0), min(c + 2, 40)):
                around = expected[max(r2 - 2, 0) : r2 + 3, max(c2 - 2, 0) : c2 + 3]
                height = np.float32(ramp[r2, c2])
                if np.isnan(expected[r2, c2]) and abs(height - expected[r, c]) <= 0.03 and not (np.abs(around - height) > 0.03).any():
                    expected[r2, c2] = height
                    queue.append((r2, c2))
    np.testing.assert_allclose(got, expected, atol=1e-6)
    assert np.isfinite(expected[:, 12:]).sum() > 100 and np.isnan(expected[np.isfinite(ramp)]).any()


def test_gathered_levels_match_their_slow_twin():
    T = look_along([4.2, 0.9, 1.3], 0.6, 0.45)
    depth = kinect_noise(render(T), np.random.default_rng(3))
    sight = grid_evidence.Sight(np.zeros(2), cell=0.05, near=0.5, far=4.0, low=0.05, high=0.5, drop=0.08)
    cell, height = np.zeros((5000, 2), np.int32), np.zeros(5000)
    n = grid_evidence._gather_levels(grid_evidence.DepthImage(depth, KINECT.rays, T), sight, 3, 4, cell, height)
    expected = []
    for v in range(1, 120, 3):
        for u in range(1, 160, 3):
            ray, higher = ([*KINECT.rays[row, u].astype(float), 1.0] @ T[:3, :3].T for row in (v, max(v - 4, 0)))
            at, z = T[:3, 3] + depth[v, u] * ray, depth[v, u]
            rise = abs(T[2, 3] + depth[max(v - 4, 0), u] * higher[2] - at[2])
            if v >= 4 and 0.5 <= z <= 4.0 and ray[2] < 0.0 and rise < 0.5 * z * (higher[2] - ray[2]):
                expected.append([*np.floor(at[:2] / 0.05), at[2]])
    expected = np.array(expected)
    assert n == len(expected) > 300 and (np.abs(expected[:, 2] - 0.72) < 0.02).sum() > 20  # the table's top, too
    np.testing.assert_array_equal(cell[:n], expected[:, :2])
    np.testing.assert_allclose(height[:n], expected[:, 2], atol=1e-9)


def test_too_large_a_floor_is_an_error_before_memory_is_reserved():
    cell = np.array([[0, 0], [9000, 9000]], np.int32).repeat(10, axis=0)
    with pytest.raises(SlamError, match="grid2d"):
        terrain.find_terrain(terrain.add_up(cell, np.zeros(20)), settings=SETTINGS, max_cells=MAX_CELLS)


def test_poses_in_any_level_frame_give_the_same_ramp():
    rise, turn = rise_of(6.0), se3.exp(np.array([0.35, -0.8, 0.0, 0.0, 0.0, 0.0]))
    lower, grids = ((0.0, 0.0, -1.0), (9.0, 3.0, 0.0)), []
    T = [look_along([x, 1.5, 0.6 + rise * np.clip((x - START) / LENGTH, 0, 1)], 0.0, 0.3) for x in np.arange(1.0, 5.5, 0.25)]
    images = [with_ramp(render(t, boxes=(lower,), room=HALL), t, rise=rise) for t in T]
    for poses in (T, turn @ np.stack(T)):
        grids.append(build_grid(zip(images, poses, strict=True), KINECT, settings=SETTINGS, sensor=SensorConfig()))
    assert (grids[0].state == grids[1].state).mean() > 0.99
