"""Floor plans as JSON, as SVG to look at or print, and as DXF for CAD programs, through ezdxf.

All take the plan as plain values, see `FloorPlan.to_dict`.
"""

import io
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from slamcli.errors import SlamError
from slamcli.files import write_text

Plan = dict[str, Any]
Place = list[float]

PER_METRE = 100.0  # SVG units
MM_PER_METRE = 20.0  # on paper: 1 to 50
MARGIN = 0.6  # [m] around the plan
FILLS = ("#dbe9f6", "#e3f1dd", "#fbe9d3", "#efe0f0", "#f7f0c9", "#dcefee", "#f5dada", "#e6e6ee")
METRES = 6  # of $INSUNITS
LAYERS = {"WALLS": 7, "ROOMS": 5, "DOORS": 3, "TEXT": 8}  # colours of AutoCAD's index
TEXT_HEIGHT = 0.2  # [m]


def write_json(path: Path, plan: Plan) -> None:
    """Write a plan's values."""
    write_text(path, json.dumps(plan, indent=1) + "\n")


def write_svg(path: Path, plan: Plan) -> None:
    """Draw a plan at 1 to 50: rooms in colour with number and area, walls with their lengths, doors as gaps with a dashed line."""
    places = _places(plan)
    low, high = places.min(axis=0) - MARGIN, places.max(axis=0) + MARGIN
    width, height = high - low

    def at(place: Place) -> str:
        x, y = place
        return f"{(x - low[0]) * PER_METRE:.1f},{(high[1] - y) * PER_METRE:.1f}"

    lines = [
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{width * MM_PER_METRE:.0f}mm" height="{height * MM_PER_METRE:.0f}mm"'
        f' viewBox="0 0 {width * PER_METRE:.1f} {height * PER_METRE:.1f}" font-family="sans-serif" text-anchor="middle">',
        '<rect width="100%" height="100%" fill="#ffffff"/>',
    ]
    for room in plan["rooms"]:
        fill = FILLS[(room["room"] - 1) % len(FILLS)]
        lines.append(f'<polygon points="{" ".join(map(at, room["outline"]))}" fill="{fill}"/>')
    for wall in plan["walls"]:
        lines.append(_svg_line(at(wall["from"]), at(wall["to"]), 'stroke="#222222" stroke-width="7" stroke-linecap="round"'))
    for door in plan["doors"]:
        x, y = at(door["middle"]).split(",")
        lines.append(
            f'<circle cx="{x}" cy="{y}" r="{door["width_m"] / 2 * PER_METRE:.1f}" fill="none" stroke="#b05020" stroke-dasharray="6 4"/>'
        )
    for room in plan["rooms"]:
        x, y = at(room["middle"]).split(",")
        lines.append(f'<text x="{x}" y="{y}" font-size="26">{room["room"]}: {room["area_m2"]:.1f} m²</text>')
    for wall in plan["walls"]:
        lines.append(_svg_length(wall, at))
    lines.append(_svg_scale(height))
    write_text(path, "\n".join([*lines, "</svg>"]) + "\n")


def _svg_line(a: str, b: str, style: str) -> str:
    (x1, y1), (x2, y2) = a.split(","), b.split(",")
    return f'<line x1="{x1}" y1="{y1}" x2="{x2}" y2="{y2}" {style}/>'


def _svg_length(wall: dict[str, Any], at: Callable[[Place], str]) -> str:
    """Write a wall's length along it, the right way up."""
    start, end = np.array(wall["from"]), np.array(wall["to"])
    turn = -np.degrees(np.arctan2(*(end - start)[::-1]))
    turn = turn - 180.0 * np.round(turn / 180.0)
    x, y = at(((start + end) / 2).tolist()).split(",")
    return f'<text x="{x}" y="{y}" dy="-8" font-size="16" fill="#444444" transform="rotate({turn:.1f} {x} {y})">{wall["length_m"]:.2f} m</text>'


def _svg_scale(height: float) -> str:
    y, x = (height - MARGIN / 2) * PER_METRE, MARGIN / 2 * PER_METRE
    bar = _svg_line(f"{x:.1f},{y:.1f}", f"{x + PER_METRE:.1f},{y:.1f}", 'stroke="#000000" stroke-width="3"')
    return f'{bar}\n<text x="{x + PER_METRE / 2:.1f}" y="{y - 8:.1f}" font-size="16">1 m (1:50)</text>'


def write_dxf(path: Path, plan: Plan) -> None:
    """Write a plan as DXF R2010 in metres, on the layers WALLS, ROOMS, DOORS and TEXT; the same plan gives the same bytes."""
    ezdxf = _ezdxf()
    was_fixed, ezdxf.options.write_fixed_meta_data_for_testing = ezdxf.options.write_fixed_meta_data_for_testing, True
    try:
        text = io.StringIO()
        _drawing(ezdxf, plan).write(text)
    finally:
        ezdxf.options.write_fixed_meta_data_for_testing = was_fixed
    write_text(path, text.getvalue())


def _drawing(ezdxf: Any, plan: Plan) -> Any:
    drawing = ezdxf.new("R2010")
    drawing.header["$INSUNITS"] = METRES
    for name, colour in LAYERS.items():
        drawing.layers.add(name, color=colour)
    space = drawing.modelspace()
    for wall in plan["walls"]:
        space.add_line(wall["from"], wall["to"], dxfattribs={"layer": "WALLS"})
    for room in plan["rooms"]:
        space.add_lwpolyline(room["outline"], close=True, dxfattribs={"layer": "ROOMS"})
        text = f"{room['room']}: {room['area_m2']:.1f} m2"
        space.add_text(text, height=TEXT_HEIGHT, dxfattribs={"layer": "TEXT", "insert": room["middle"]})
    for door in plan["doors"]:
        space.add_circle(door["middle"], door["width_m"] / 2, dxfattribs={"layer": "DOORS"})
    return drawing


def _ezdxf() -> Any:
    try:
        import ezdxf
    except ImportError as error:
        raise SlamError("DXF files need one more package: pip install 'slamcli[survey]'") from error
    return ezdxf


def _places(plan: Plan) -> np.ndarray:
    """Return all places of a plan (N, 2)."""
    places = [place for wall in plan["walls"] for place in (wall["from"], wall["to"])]
    places += [place for room in plan["rooms"] for place in room["outline"]]
    if not places:
        raise SlamError("the floor plan is empty: the grid has no free floor, and the cloud shows no wall")
    return np.array(places)


WRITERS: dict[str, Callable[[Path, Plan], None]] = {".json": write_json, ".svg": write_svg, ".dxf": write_dxf}
