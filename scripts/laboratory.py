"""The laboratory of [L] section 4 in simulation: Table 2 and Figures 7 to 10, and how right the grid is.

For each seed a room of 8 m x 5 m with a hanging and a low box is rendered, a robot drives round it once with the paper's Kinect (57
degrees, 1.2 to 3.5 m, 0.15 m/s, 0.15 rad/s, 15 Hz), and `slamcli run` makes the grid from the estimated poses. Then lengths and angles
are measured on it and on the grid of a simulated planar laser, the grid is compared with the scene cell by cell, and paths are planned
past the boxes on both and checked in three dimensions.

    python scripts/laboratory.py OUT [--seeds 0 1 2 3 4] [--set grid2d.source=octree]

OUT/seed<N> keeps recording, run and pictures; a recording or run that is there is used again. OUT/laboratory.json holds every figure.
"""

import argparse
import itertools
import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from lab_laser import laser_grid
from lab_measure import Reading, measure, outlines, table_2

import slamcli
from slamcli import console
from slamcli.datasets.simulate import simulate
from slamcli.errors import SlamError
from slamcli.evaluation import grid_truth
from slamcli.evaluation.grid_truth import TrueRoom
from slamcli.geometry import se3
from slamcli.navigation import grid as grid_module
from slamcli.navigation import planner
from slamcli.runs.placement import camera_path
from slamcli.runs.run_directory import RunDir
from slamcli.schema import Features, Grid, Ground, Map, Tracks, frame_poses
from slamcli.visualization.grid_picture import Overlay, draw

PAPER = {"speed": 0.15, "turn_rate": 0.15, "laps": 1.03, "field_of_view": 57.0, "depth_min": 1.2, "depth_max": 3.5, "frames": None}
SENSOR = ("sensor.depth_min=1.2", "sensor.depth_max=3.5", "grid2d.min_range=1.2", "grid2d.max_range=3.5")
RADIUS, HEIGHT, GROUND_CLEARANCE = 0.2, 0.5, 0.05  # [m] of the robot
LASER_HEIGHT = 0.2  # [m]
OPPOSITE = -0.86  # cosine between the directions in which start and goal lie from a box
MAX_PAIRS = 60  # of start and goal tried past a box


@dataclass(frozen=True)
class Lab:
    """One run of the laboratory and its truth."""

    run: RunDir
    scene: TrueRoom
    grid: Grid
    laser: Grid
    T_lc: np.ndarray  # (N, 4, 4) estimated poses of the frames the grid looked at
    T_sc: np.ndarray  # (N, 4, 4) true ones
    T_sl: np.ndarray  # (4, 4) level frame to the scene's, by all frames
    frames: np.ndarray  # (N,)


def main() -> None:
    """Run the laboratory."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2, 3, 4])
    parser.add_argument("--set", dest="settings", action="append", default=[], metavar="KEY=VALUE", help="for slamcli run")
    parser.add_argument("--rate", type=float, default=15.0, help="images a second; the paper's 15, less is quicker")
    given = parser.parse_args()
    results = [one(given.out / f"seed{seed}", seed, given.settings, given.rate) for seed in given.seeds]
    (given.out / "laboratory.json").write_text(json.dumps(results, indent=1) + "\n")
    summary(results)


def one(folder: Path, seed: int, settings: list[str], rate: float) -> dict:
    """Run one seed; returns its figures."""
    lab = prepare(folder, seed, settings, rate)
    readings = measured(lab)
    score = scored(lab)
    plans = planned(lab)
    draw_all(folder, lab, plans)
    print(f"\nseed {seed}: {len(lab.frames)} views")
    for row in readings:
        values = "  ".join(f"{name} {value:7.3f} ({value - row.true:+.3f})" for name, value in row.measured.items())
        print(f"  {row.name:44s} {row.true:7.3f} {row.unit:4s} {values}")
    print(f"  {json.dumps({k: round(v, 4) if isinstance(v, float) else v for k, v in score.items()})}")
    for plan in plans:
        print(f"  past the {plan['box']}: ours touches {plan['ours'] or 'nothing'}, the laser's touches {plan['laser'] or 'nothing'}")
    rows = [{"name": r.name, "unit": r.unit, "true": r.true, **r.measured} for r in readings]
    return {"seed": seed, "table_2": rows, "score": score, "plans": [{k: plan[k] for k in ("box", "ours", "laser")} for plan in plans]}


def prepare(folder: Path, seed: int, settings: list[str], rate: float) -> Lab:
    """Render and run, unless done already, and gather what the figures need."""
    recording, path = folder / "recording", folder / "run"
    folder.mkdir(parents=True, exist_ok=True)
    if not recording.exists():
        simulate(recording, progress=console.progress, rate=rate, seed=seed, **PAPER)
    run = slamcli.run(recording, path=path, settings=(*SENSOR, *settings), progress=console.progress, tell=console.say).directory
    scene, grid = grid_truth.read_scene(recording / "scene.json"), run.load(Grid, "grid2d")
    T_wc = frame_poses(run.load(Tracks, "loop"), run.load(Map, "loop"))
    T_lc = run.load(Ground, "densify").T_lw @ T_wc
    truth = true_poses(run)
    has_both = np.isfinite(T_lc[:, 0, 0]) & np.isfinite(truth[:, 0, 0])
    T_sl, _ = se3.umeyama(T_lc[has_both, :3, 3], truth[has_both, :3, 3])
    config = run.config().grid2d
    frames = grid_module.spaced(np.where(has_both[:, None, None], T_lc, np.nan), metres=config.spacing, degrees=config.spacing_deg)
    rng = np.random.default_rng([seed, 7])
    laser = laser_grid(scene, truth[frames], T_lc[frames], grid, rng)
    return Lab(run, scene, grid, laser, T_lc[frames], truth[frames], T_sl, frames)


def true_poses(run: RunDir) -> np.ndarray:
    """Return T_sc (F, 4, 4) of every frame."""
    truth = run.dataset().ground_truth()
    stamp = run.load(Features, "extract").stamp
    at = np.clip(np.searchsorted(truth.stamp, stamp - 1e-4), 0, len(truth.stamp) - 1)
    return np.where(np.abs(truth.stamp[at] - stamp)[:, None, None] < 1e-3, truth.T_wc[at], np.nan)


def measured(lab: Lab) -> list[Reading]:
    """Read Table 2 off both grids."""
    faces = outlines(lab.scene, LASER_HEIGHT)
    lines: dict[str, dict] = {}
    for name, grid in (("ours", lab.grid), ("laser", lab.laser)):
        found = {i: measure(grid, face, lab.T_sl) for i, face in enumerate(faces)}
        lines[name] = {i: line for i, line in found.items() if line is not None}
    return table_2(lines, faces)


def scored(lab: Lab) -> dict:
    """Compare the grid with the scene cell by cell."""
    dataset, camera, config = lab.run.dataset(), lab.run.camera(), lab.run.config().grid2d
    points = (
        grid_truth.exact_points(lab.scene, depth, T_sc, camera, max_range=config.max_range)
        for depth, T_sc in ((dataset.depth(int(frame)), T_sc) for frame, T_sc in zip(lab.frames, lab.T_sc, strict=True))
        if depth is not None
    )
    return grid_truth.score(lab.grid, lab.scene, lab.T_sl, points, band=(config.band_low, config.band_high)).to_dict()


def planned(lab: Lab) -> list[dict]:
    """Plan on both grids past each box, from one side to the other, until the laser's path hits it or no more places are left."""
    plans = []
    T_ls = se3.inverse(lab.T_sl)
    for solid in lab.scene.solids:
        if solid["name"] not in grid_truth.SPECIAL:
            continue
        best = None
        for start, goal in opposite_places(lab, se3.transform(T_ls, np.array([solid["centre"]]))[0, :2]):
            routes = {name: route(grid, start, goal) for name, grid in (("ours", lab.grid), ("laser", lab.laser))}
            if None in routes.values():
                continue
            hits = {name: touched(lab, found.xy) for name, found in routes.items()}
            is_hit = solid["name"] in hits["laser"]
            if best is None or is_hit:
                best = {"box": solid["name"], "routes": routes, **hits}
            if is_hit:
                break
        if best is not None:
            plans.append(best)
    return plans


def opposite_places(lab: Lab, centre: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return pairs of places (2,) on opposite sides of a box with room for the robot in both grids, those near to each other first."""
    room = np.minimum(*(planner.obstacle_distance(grid, allow_unknown=False) for grid in (lab.grid, lab.laser))) >= RADIUS
    angle = np.arange(0.0, 2.0 * np.pi, np.pi / 12)
    direction = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    step = (np.array([0.6, 0.9, 1.2, 1.6, 2.0])[:, None, None] * direction).reshape(-1, 2)
    column, row = np.floor((centre + step - lab.grid.origin) / float(lab.grid.resolution)).astype(int).T
    inside = (row >= 0) & (column >= 0) & (row < room.shape[0]) & (column < room.shape[1])
    step = step[inside][room[row[inside], column[inside]]]
    pairs = [(a, b) for a, b in itertools.combinations(step, 2) if a @ b < OPPOSITE * np.linalg.norm(a) * np.linalg.norm(b)]
    pairs.sort(key=lambda pair: np.linalg.norm(pair[0] - pair[1]))
    return [(centre + a, centre + b) for a, b in pairs[:MAX_PAIRS]]


def route(grid: Grid, start: np.ndarray, goal: np.ndarray) -> planner.Route | None:
    """Plan, or give None where that cannot be."""
    try:
        return planner.plan(grid, tuple(start), tuple(goal), radius=RADIUS)
    except SlamError:
        return None


def touched(lab: Lab, xy_l: np.ndarray) -> list[str]:
    """Name what the robot, an upright cylinder, touches on a path in the level frame."""
    xy = xy_l @ lab.T_sl[:2, :2].T + lab.T_sl[:2, 3]
    angle = np.linspace(0.0, 2.0 * np.pi, 72, endpoint=False)
    rim = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    body = xy[:, None, None, :] + RADIUS * np.array([0.25, 0.5, 0.75, 1.0])[:, None, None] * rim
    hits = ["a wall"] if ((body < lab.scene.low[:2]) | (body > lab.scene.high[:2])).any() else []
    return hits + [s["name"] for s in lab.scene.solids if grid_truth.footprint(s, body, GROUND_CLEARANCE, HEIGHT).any()]


def draw_all(folder: Path, lab: Lab, plans: list[dict]) -> None:
    """Draw Figures 7 to 10 of the paper."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    config = lab.run.config().grid2d
    points = band_points(lab, config.band_low, config.band_high)
    trajectory = camera_path(lab.run)
    figures = {name: Figure(figsize=size) for name, size in (("fig7_band", (9, 7)), ("fig8_projection", (8, 7)), ("fig9_grids", (16, 8)))}
    axis = figures["fig7_band"].add_subplot(projection="3d")
    axis.scatter(*points[:: max(1, len(points) // 40000)].T, c=points[:: max(1, len(points) // 40000), 2], s=0.4, cmap="viridis")
    axis.set_box_aspect(np.ptp(points, axis=0) * [1, 1, 3], zoom=1.3)
    axis.set(xlabel="x [m]", ylabel="y [m]", zticks=[config.band_low, config.band_high])
    axis.set_title(f"points from {config.band_low:g} to {config.band_high:g} m above the floor (heights threefold)")
    axis = figures["fig8_projection"].add_subplot()
    axis.plot(points[:, 0], points[:, 1], ",", color="#1a1a1a")
    axis.set_aspect("equal")
    axis.set(xlabel="x [m]", ylabel="y [m]")
    axis.set_title("the same along the floor's normal")
    for k, (name, grid) in enumerate((("from the camera", lab.grid), (f"from a laser at {LASER_HEIGHT:g} m", lab.laser))):
        draw(figures["fig9_grids"].add_subplot(1, 2, k + 1), grid, Overlay(trajectory), title=name)
    for plan in plans:
        figures[f"fig10_{plan['box']}"] = figure = Figure(figsize=(16, 8))
        for k, (name, grid) in enumerate((("ours", lab.grid), ("laser", lab.laser))):
            title = f"{name}: touches {', '.join(plan[name]) or 'nothing'}"
            draw(figure.add_subplot(1, 2, k + 1), grid, Overlay(route=plan["routes"][name].xy, radius=RADIUS), title=title)
    for name, figure in figures.items():
        FigureCanvasAgg(figure)
        figure.savefig(folder / f"{name}.png", dpi=110, bbox_inches="tight")


def band_points(lab: Lab, low: float, high: float) -> np.ndarray:
    """Return the cloud's points (N, 3) within the band."""
    from slamcli.formats.cloud import read_ply

    xyz = read_ply(lab.run.stage_path("densify", "cloud.ply"))[0]
    return xyz[(xyz[:, 2] > low) & (xyz[:, 2] < high)]


def is_found(box: dict[str, int]) -> bool:
    """Say whether nine tenths of a box's seen outline are occupied and hardly a cell on it is free."""
    return box["outline"] > 0 and box["outline_occupied"] >= 0.9 * box["outline"] and box["free"] <= 0.05 * box["cells"]


def summary(results: list[dict]) -> None:
    """Print the worst of every figure."""
    print(f"\nover {len(results)} seeds")
    for unit in ("m", "deg"):
        rows = [row for result in results for row in result["table_2"] if row["unit"] == unit]
        for name in ("ours", "laser"):
            errors = np.abs([row[name] - row["true"] for row in rows])
            if len(errors):
                print(
                    f"  {len(errors)} {'lengths' if unit == 'm' else 'angles'}, {name}: worst {errors.max():.3f} {unit}, mean {errors.mean():.3f}"
                )
    for key, pick in (
        ("free_is_free", min),
        ("floor_is_free", min),
        ("floor_is_free_exact", min),
        ("floor_is_occupied", max),
        ("outline_is_occupied", min),
    ):
        print(f"  {key}: worst {pick(result['score'][key] for result in results):.4f}")
    for box in grid_truth.SPECIAL:
        found = sum(is_found(result["score"]["special"][box]) for result in results)
        plans = [plan for result in results for plan in result["plans"] if plan["box"] == box]
        ours, laser = sum(bool(plan["ours"]) for plan in plans), sum(box in plan["laser"] for plan in plans)
        print(
            f"  {box}: found in {found} of {len(results)}; {len(plans)} paths past it: {ours} of ours touch something, {laser} of the laser's hit it"
        )


if __name__ == "__main__":
    main()
