"""A cloud from above: every place where it belongs, the higher point on top, the grid over it."""

import numpy as np
import pytest

from slamcli.errors import SlamError
from slamcli.schema import Grid
from slamcli.visualization.plan_view import OCCUPIED, draw_plan
from slamcli.visualization.render import BACKGROUND, PATH_COLOUR

RED, BLUE, GREEN = (250, 10, 10), (10, 10, 250), (10, 250, 10)


def grid_of(state: np.ndarray, origin: tuple[float, float]) -> Grid:
    state = state.astype(np.int8)
    return Grid(state.astype(np.float32), np.ones_like(state, dtype=np.int32), state, np.array(origin), np.array(0.1))


def square(low: tuple[float, float], high: tuple[float, float], z: float, colour: tuple[int, int, int]) -> tuple[np.ndarray, np.ndarray]:
    x, y = np.meshgrid(np.arange(low[0], high[0], 0.02), np.arange(low[1], high[1], 0.02))
    xyz = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, z)])
    return xyz, np.tile(np.array(colour, np.uint8), (len(xyz), 1))


def drawn(*squares, state: np.ndarray | None = None, **options) -> tuple[np.ndarray, float]:
    xyz, rgb = (np.concatenate(columns) for columns in zip(*squares, strict=True))
    grid = grid_of(np.full((40, 40), -1) if state is None else state, (0.0, 0.0))
    return draw_plan(xyz, rgb, grid, **{"below": 1.8, "size": (400, 300), "spacing": 0.02, **options})


def test_x_is_right_y_is_up_and_the_scale_is_true() -> None:
    floor = square((0.0, 0.0), (4.0, 3.0), 0.0, GREEN)
    picture, scale = drawn(floor, square((3.0, 2.0), (3.5, 2.5), 0.5, RED), square((3.0, 2.0), (3.5, 2.5), 0.2, BLUE))
    assert picture.shape[0] <= 300 and picture.shape[1] <= 400 and 60 < scale < 90
    is_red = (picture == RED).all(axis=2)
    rows, columns = np.nonzero(is_red)
    assert columns.mean() > 0.7 * picture.shape[1] and rows.mean() < 0.35 * picture.shape[0]
    assert is_red.sum() == pytest.approx((0.5 * scale) ** 2, rel=0.12)
    assert not (picture == BLUE).all(axis=2).any(), "what is higher covers what is lower"
    assert (picture == np.array(BACKGROUND)).all(axis=2).any()


def test_the_room_is_cut_open() -> None:
    picture, _ = drawn(square((0.0, 0.0), (2.0, 2.0), 0.0, GREEN), square((0.0, 0.0), (2.0, 2.0), 2.4, RED))
    assert not (picture == RED).all(axis=2).any() and (picture == GREEN).all(axis=2).mean() > 0.4
    with pytest.raises(SlamError, match=r"below -1 m"):
        drawn(square((0.0, 0.0), (2.0, 2.0), 0.0, GREEN), below=-1.0)


def test_the_grid_lies_over_the_cloud() -> None:
    state = np.full((40, 40), -1)
    state[10:20, 5:15], state[30:34, 30:36] = 0, 1
    picture, scale = drawn(square((0.0, 0.0), (4.0, 4.0), 0.0, (200, 200, 200)), state=state)
    is_outline = (picture == OCCUPIED).all(axis=2)
    assert is_outline.sum() == pytest.approx(2 * (0.4 + 0.6) * scale, rel=0.15)
    tinted = (picture[..., 1] > picture[..., 0] + 5) & (picture[..., 1] > picture[..., 2] + 2)
    assert tinted.sum() == pytest.approx(1.0 * 1.0 * scale**2, rel=0.1)


def test_the_path_breaks_where_the_camera_was_lost() -> None:
    path = np.array([[0.5, 0.5, 1.0], [1.0, 0.5, 1.0], [np.nan] * 3, [3.0, 0.5, 1.0], [3.5, 0.5, 1.0]])
    picture, scale = drawn(square((0.0, 0.0), (4.0, 1.0), 0.0, (255, 255, 255)), path=path)
    columns = np.flatnonzero((picture == PATH_COLOUR).all(axis=2).any(axis=0))
    assert len(columns) == pytest.approx(2 * 0.5 * scale, rel=0.15) and np.diff(columns).max() > 1.5 * scale
