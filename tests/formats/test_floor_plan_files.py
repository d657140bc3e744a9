"""Floor plans as files: other programs read the same lines and areas."""

import json
import xml.etree.ElementTree as ET
from pathlib import Path

import pytest

from slamcli.errors import SlamError
from slamcli.formats import floor_plan

PLAN = {
    "frame": "level: x, y [m]",
    "walls": [
        {"from": [0.0, 0.0], "to": [4.0, 0.0], "length_m": 4.0, "height_m": 2.1},
        {"from": [4.0, 0.0], "to": [4.0, 3.0], "length_m": 3.0, "height_m": 2.1},
    ],
    "rooms": [{"room": 1, "area_m2": 12.0, "middle": [2.0, 1.5], "outline": [[0.0, 0.0], [4.0, 0.0], [4.0, 3.0], [0.0, 3.0]]}],
    "doors": [{"rooms": [1, 2], "middle": [0.0, 1.5], "width_m": 0.9}],
}
SVG = "{http://www.w3.org/2000/svg}"


def test_json_holds_the_plan(tmp_path: Path) -> None:
    floor_plan.write_json(tmp_path / "plan.json", PLAN)
    assert json.loads((tmp_path / "plan.json").read_text()) == PLAN


def test_svg_is_drawn_at_one_to_fifty_with_y_upwards(tmp_path: Path) -> None:
    floor_plan.write_svg(tmp_path / "plan.svg", PLAN)
    root = ET.parse(tmp_path / "plan.svg").getroot()
    view = [float(value) for value in root.get("viewBox").split()]
    assert float(root.get("width").removesuffix("mm")) / view[2] == pytest.approx(20.0 / floor_plan.PER_METRE, rel=0.01)
    lines = [[float(line.get(name)) for name in ("x1", "y1", "x2", "y2")] for line in root.iter(f"{SVG}line")]
    assert lines[0][2] - lines[0][0] == pytest.approx(4.0 * floor_plan.PER_METRE, abs=0.2)
    assert lines[1][1] - lines[1][3] == pytest.approx(3.0 * floor_plan.PER_METRE, abs=0.2), "up in the room is up on paper"
    assert {text.text for text in root.iter(f"{SVG}text")} == {"1: 12.0 m²", "4.00 m", "3.00 m", "1 m (1:50)"}


def test_dxf_is_read_by_ezdxf(tmp_path: Path) -> None:
    ezdxf = pytest.importorskip("ezdxf")
    for name in ("a.dxf", "b.dxf"):
        floor_plan.write_dxf(tmp_path / name, PLAN)
    assert (tmp_path / "a.dxf").read_bytes() == (tmp_path / "b.dxf").read_bytes()
    drawing = ezdxf.readfile(tmp_path / "a.dxf")
    assert drawing.header["$INSUNITS"] == floor_plan.METRES and not drawing.audit().has_errors
    lines = sorted((tuple(line.dxf.start)[:2], tuple(line.dxf.end)[:2]) for line in drawing.modelspace().query("LINE[layer=='WALLS']"))
    assert lines == [((0.0, 0.0), (4.0, 0.0)), ((4.0, 0.0), (4.0, 3.0))]
    (outline,) = drawing.modelspace().query("LWPOLYLINE[layer=='ROOMS']")
    assert outline.closed and [tuple(place) for place in outline.get_points("xy")] == [
        tuple(place) for place in PLAN["rooms"][0]["outline"]
    ]


@pytest.mark.parametrize("ending", [".svg"])
def test_an_empty_plan_is_refused_in_words(tmp_path: Path, ending: str) -> None:
    with pytest.raises(SlamError, match="no free floor"):
        floor_plan.WRITERS[ending](tmp_path / f"plan{ending}", {"frame": "", "walls": [], "rooms": [], "doors": []})
    assert list(tmp_path.iterdir()) == []
