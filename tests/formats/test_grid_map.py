"""map_server's files, cell by cell: where each cell lies, what each grey means, and what is refused."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays

from slamcli.errors import SlamError
from slamcli.formats import grid_map
from slamcli.formats.grid_map import GridMap
from slamcli.schema import Grid


def load_as_map_server(page, *, free_thresh=None):
    """What map_server does in mode trinary, written from its documentation: occupancy by (column, row from below)."""
    keys = dict(line.split(": ", 1) for line in page.read_text().splitlines())
    raw = (page.parent / keys["image"].strip('"')).read_bytes()
    magic, size, greatest, pixels = raw.split(b"\n", 3)
    assert (magic, greatest) == (b"P5", b"255")
    columns, rows = (int(n) for n in size.split())
    assert len(pixels) == rows * columns
    assert keys["negate"] == "0"
    occupancy = {}
    for top_row in range(rows):
        for column in range(columns):
            p = (255 - pixels[top_row * columns + column]) / 255.0
            value = 100 if p > float(keys["occupied_thresh"]) else 0 if p < (free_thresh or float(keys["free_thresh"])) else -1
            occupancy[column, rows - 1 - top_row] = value
    x, y, yaw = (float(v) for v in keys["origin"].strip("[]").split(","))
    return occupancy, (x, y, yaw), float(keys["resolution"])


def test_every_cell_lies_where_map_server_puts_it(tmp_path):
    rng = np.random.default_rng(0)
    state = rng.integers(-1, 2, (7, 11)).astype(np.int8)
    made = GridMap(state, (-1.25, 3.5), 0.05)
    _, page = grid_map.write(tmp_path / "map.pgm", made)
    occupancy, (x0, y0, yaw), resolution = load_as_map_server(page)
    assert yaw == 0.0
    for (column, row), value in occupancy.items():
        # the centre of this cell in metres, by the map's own page, leads back to the state of that place
        x, y = x0 + (column + 0.5) * resolution, y0 + (row + 0.5) * resolution
        i, j = int((y - made.origin[1]) // made.resolution), int((x - made.origin[0]) // made.resolution)
        assert value == {1: 100, 0: 0, -1: -1}[int(state[i, j])]


def test_unknown_stays_unknown_in_ros_1_and_nav2_takes_the_pages_threshold(tmp_path):
    _, page = grid_map.write(tmp_path / "map.pgm", GridMap(np.array([[-1]], np.int8), (0.0, 0.0), 0.05))
    assert load_as_map_server(page)[0][0, 0] == -1
    assert load_as_map_server(page, free_thresh=0.25)[0][0, 0] == 0  # nav2's default, which is why the page gives 0.196
    assert "free_thresh: 0.196\n" in page.read_text()
    assert (255 - 205) / 255 > 0.196


def test_the_picture_is_seen_from_above_with_y_up(tmp_path):
    state = np.array([[0, 0], [-1, 1]], np.int8)  # occupied at the largest x and y
    path, _ = grid_map.write(tmp_path / "map.pgm", GridMap(state, (0.0, 0.0), 1.0))
    assert path.read_bytes() == b"P5\n2 2\n255\n" + bytes([205, 0, 254, 254])


@settings(max_examples=40, deadline=None)
@given(
    state=arrays(np.int8, array_shapes(min_dims=2, max_dims=2, max_side=12), elements=st.integers(-1, 1)),
    origin=st.tuples(*[st.floats(-1e4, 1e4)] * 2),
    resolution=st.floats(1e-3, 10.0),
    ending=st.sampled_from(grid_map.ENDINGS),
)
def test_what_is_written_is_read_back(tmp_path_factory, state, origin, resolution, ending):
    _, page = grid_map.write(tmp_path_factory.mktemp("map") / f"some map{ending}", GridMap(state, origin, resolution))
    back = grid_map.read(page)
    np.testing.assert_array_equal(back.state, state)
    assert (back.origin, back.resolution) == (origin, resolution)


def test_maps_of_others_are_read(tmp_path):
    (tmp_path / "floor.pgm").write_bytes(b"P5\n# CREATOR: map_saver 0.05 m/pix\n3 1\n# x\n255\n" + bytes([0, 205, 254]))
    page = tmp_path / "floor.yaml"
    page.write_text(
        "image: floor.pgm\nresolution: 0.050000\norigin: [-1, -2.5, 0.000000]\nnegate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.196\n\n"
    )
    read = grid_map.read(page)
    assert read.state.tolist() == [[1, -1, 0]]
    assert (read.origin, read.resolution) == ((-1.0, -2.5), 0.05)
    page.write_text(page.read_text().replace("negate: 0", "negate: 1"))
    assert grid_map.read(page).state.tolist() == [[0, 1, 1]]


GOOD = "image: m.pgm\nmode: trinary\nresolution: 0.05\norigin: [0.0, 0.0, 0.0]\nnegate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.196\n"


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ("image: m.pgm", "image: ../m.pgm", "same folder"),
        ("image: m.pgm", "image: /etc/passwd", "same folder"),
        ("image: m.pgm", "image: none.pgm", "cannot be read"),
        ("resolution: 0.05\n", "", "'resolution' is missing"),
        ("resolution: 0.05", "resolution: -1", "side of a cell"),
        ("resolution: 0.05", "resolution: !!python/object:os.system", "not a number"),
        ("resolution: 0.05", "resolution: nan", "not a number"),
        ("[0.0, 0.0, 0.0]", "[0.0, 0.0, 0.7]", "turned"),
        ("[0.0, 0.0, 0.0]", "[0.0, 0.0]", "must be"),
        ("mode: trinary", "mode: raw", "only trinary"),
    ],
)
def test_pages_that_cannot_be_used_are_refused(tmp_path, old, new, says):
    (tmp_path / "m.pgm").write_bytes(b"P5\n1 1\n255\n\x00")
    page = tmp_path / "m.yaml"
    page.write_text(GOOD)
    assert grid_map.read(page).state.tolist() == [[1]]
    page.write_text(GOOD.replace(old, new))
    with pytest.raises(SlamError, match=says) as caught:
        grid_map.read(page)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("data", "says"),
    [
        (b"", "not a binary PGM"),
        (b"P2\n1 1\n255\n0", "not a binary PGM"),
        (b"P5\n1 1\n65535\n\0\0", "not a binary PGM"),
        (b"P5\n9 9\n255\n\0", "cut off: 1 of 81"),
        (b"P5\n999999999 999999999\n255\n\0", "not a size"),
        (b"P5\n0 4\n255\n", "not a size"),
        (b"P5" + b"\n" * 5000 + b"1 1\n255\n\0", "not a binary PGM"),
        (b"\x89PNG\r\n", "not a binary PGM"),
    ],
)
def test_pictures_that_cannot_be_used_are_refused(tmp_path, data, says):
    (tmp_path / "m.pgm").write_bytes(data)
    with pytest.raises(SlamError, match=says):
        grid_map.read_pgm(tmp_path / "m.pgm")


def test_a_page_that_is_no_page(tmp_path):
    for name, data in (("a.yaml", b"\xff\xfe\x00"), ("b.yaml", b"image: x\n" * 20000), ("c.yaml", b"")):
        (tmp_path / name).write_bytes(data)
        with pytest.raises(SlamError, match=name):
            grid_map.read(tmp_path / name)
    with pytest.raises(SlamError, match=r"name the \.yaml"):
        grid_map.read(tmp_path / "missing.yaml")


def test_other_names_and_places_are_refused(tmp_path):
    some = GridMap(np.zeros((1, 1), np.int8), (0.0, 0.0), 0.05)
    with pytest.raises(SlamError, match=r"ends in \.pgm"):
        grid_map.write(tmp_path / "map.tif", some)
    with pytest.raises(SlamError, match="cannot be written"):
        grid_map.write(tmp_path / "nowhere" / "map.pgm", some)


def test_a_grids_numbers_are_written_without_the_tails_of_sums(tmp_path):
    """23 cells of 0.05 m make 1.1500000000000001 m."""
    origin = np.array([-23, -1]) * 0.05
    assert repr(float(origin[0])) == "-1.1500000000000001"
    grid = Grid(np.zeros((2, 2), np.float32), np.ones((2, 2), np.int32), np.zeros((2, 2), np.int8), origin, np.array(0.05))
    _, page = grid_map.write(tmp_path / "map.pgm", GridMap.of(grid))
    assert "resolution: 0.05\norigin: [-1.15, -0.05, 0.0]\n" in page.read_text()


def test_where_the_recording_began_is_a_comment(tmp_path):
    grid = GridMap(np.zeros((2, 2), np.int8), (0.0, 0.0), 0.05)
    _, page = grid_map.write(tmp_path / "map.pgm", grid, start=(-1e-17, 0.25, -1.5))
    assert page.read_text().startswith("# start: x 0.0, y 0.25, yaw -1.5 [m, m, rad]")
    assert grid_map.read(page).resolution == 0.05
