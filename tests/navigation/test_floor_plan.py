"""A floor plan of a made-up room: walls, area and figures agree."""

import numpy as np
import pytest
from test_rooms import CELL, grid_of
from test_walls import cloud, room

from slamcli.navigation.floor_plan import make_floor_plan


def test_walls_and_rooms_of_one_plan_agree() -> None:
    state = np.full((120, 160), -1, np.int8)
    state[20:-25, 25:-20] = 0
    xyz, normal = cloud(*room(6.0, 4.0, inset=0.1))
    origin = np.array([-1.0, -1.0])
    plan = make_floor_plan(grid_of(state, origin), xyz, normal, wall_height=1.2, door_width=1.2, least_area=1.0)
    told = plan.to_dict()
    assert sorted(wall["length_m"] for wall in told["walls"]) == pytest.approx([4.0, 4.0, 6.0, 6.0], abs=0.01)
    (only,) = told["rooms"]
    assert only["area_m2"] == pytest.approx(24.0, abs=0.3) and told["doors"] == []
    outline = np.array(only["outline"])
    assert np.abs(outline.min(axis=0)).max() < 2 * CELL and np.abs(outline.max(axis=0) - [6.0, 4.0]).max() < 2 * CELL
