"""Paths through space: straight where nothing is in the way, round what is, never through what was not seen."""

import numpy as np
import pytest

from slamcli.errors import SlamError
from slamcli.geometry import voxel
from slamcli.geometry.octree import CENTRE, DEPTH, Octree, prune
from slamcli.navigation import flight

CELL = 0.1


def tree(free: np.ndarray, occupied: np.ndarray | None = None) -> Octree:
    """The octree of a box of cells (X, Y, Z), its corner at the origin."""
    cells = [np.argwhere(free), np.argwhere(np.zeros_like(free) if occupied is None else occupied)]
    key = voxel.morton(np.concatenate(cells) + CENTRE)
    log_odds = np.repeat(np.float32([-1.0, 1.0]), [len(c) for c in cells])
    order = np.argsort(key)
    return prune(Octree(CELL, key[order], np.full(len(key), DEPTH, np.uint8), log_odds[order]))


def hall(*, wall: bool = False, window: tuple[int, int] = (18, 24)) -> Octree:
    """A hall of 4 x 3 x 2.4 m; with a wall across it that is open between two heights [cells] in the middle alone."""
    free = np.ones((40, 30, 24), bool)
    if wall:
        free[19:21] = False
        free[19:21, 10:20, slice(*window)] = True
    return tree(free, ~free)


def test_the_straight_way_is_taken_where_nothing_is_in_it() -> None:
    space = flight.airspace(hall())
    route = flight.fly(space, (0.5, 0.6, 1.2), (3.5, 2.4, 1.0), radius=0.2, clearance=0.0, weight=0.0)
    straight = np.linalg.norm(np.subtract((0.5, 0.6, 1.2), (3.5, 2.4, 1.0)))
    assert straight <= route.length < 1.02 * straight
    np.testing.assert_allclose(route.xyz[[0, -1]], [(0.5, 0.6, 1.2), (3.5, 2.4, 1.0)])
    assert np.linalg.norm(np.diff(route.xyz, axis=0), axis=1).max() <= CELL + 1e-9 and route.clearance.min() >= 0.0


def test_the_way_leads_through_the_window_and_keeps_clear_of_its_frame() -> None:
    space = flight.airspace(hall(wall=True))
    route = flight.fly(space, (0.5, 0.5, 0.5), (3.5, 0.5, 0.5), radius=0.15, clearance=0.2, weight=3.0)
    at = route.xyz[np.argmin(np.abs(route.xyz[:, 0] - 2.0))]
    assert 1.15 < at[1] < 1.85 and 1.95 < at[2] < 2.25, "between the window's sides, and between its sill and the ceiling"
    assert 3.0 < route.length < 6.5


def test_what_does_not_fit_through_finds_no_way() -> None:
    space = flight.airspace(hall(wall=True))
    with pytest.raises(SlamError, match="no way leads from start to goal"):
        flight.fly(space, (0.7, 0.7, 0.7), (3.3, 0.7, 0.7), radius=0.4, clearance=0.0, weight=0.0)


def test_space_that_was_never_seen_is_no_way() -> None:
    free = np.ones((40, 30, 24), bool)
    free[15:25] = False
    with pytest.raises(SlamError, match="no way leads"):
        flight.fly(flight.airspace(tree(free)), (0.7, 1.5, 1.2), (3.3, 1.5, 1.2), radius=0.2, clearance=0.0, weight=0.0)


@pytest.mark.parametrize("place", [(0.05, 1.0, 1.0), (9.0, 1.0, 1.0), (np.nan, 0.0, 0.0), (2.0, 1.0, -3.0)])
def test_a_place_without_room_is_named_with_one_that_has_it(place: tuple[float, float, float]) -> None:
    space = flight.airspace(hall())
    with pytest.raises(SlamError, match="start .*nearest place with room is") as caught:
        flight.fly(space, place, (2.0, 1.5, 1.2), radius=0.3, clearance=0.0, weight=0.0)
    near = [float(value) for value in str(caught.value).rsplit(" ", 1)[1].split(",")]
    assert flight.fly(space, near, (2.0, 1.5, 1.2), radius=0.3, clearance=0.0, weight=0.0).clearance.min() >= 0.0


def test_nothing_flies_where_nothing_is_free_or_fits() -> None:
    with pytest.raises(SlamError, match="no free space"):
        flight.airspace(tree(np.zeros((4, 4, 4), bool), np.ones((4, 4, 4), bool)))
    with pytest.raises(SlamError, match="fits into"):
        flight.nearest_free(flight.airspace(hall()), np.zeros(3), 2.0)


def test_margins_never_promise_more_room_than_there_is() -> None:
    rng = np.random.default_rng(2)
    free = rng.random((14, 12, 10)) > 0.05
    space = flight.airspace(tree(free))
    blocked = space.centre(np.argwhere(space.margin < 0.0))
    for cell in np.argwhere(space.margin > 0.0)[::7]:
        gap = np.maximum(np.abs(blocked - space.centre(cell)) - CELL / 2, 0.0)
        assert space.margin[tuple(cell)] <= np.linalg.norm(gap, axis=1).min() + 1e-6
