"""How right the grid is in simulated rooms, from depth images and true poses with a little noise: no features, no SLAM, seconds a room.

    python scripts/grid_rooms.py [--seeds 0 1 2 3 4] [--set grid2d.stride=4]

Each room is driven round twice: with a Kinect, and in the laboratory's way (`scripts/laboratory.py`, which runs everything).
"""

import argparse
from dataclasses import replace

import numpy as np
from laboratory import PAPER

from slamcli.config import toml
from slamcli.config.options import Config
from slamcli.datasets import simulate
from slamcli.datasets.simulated import noise
from slamcli.datasets.simulated.raycast import Renderer
from slamcli.datasets.simulated.scene import with_textured_share
from slamcli.evaluation import grid_truth
from slamcli.geometry import se3
from slamcli.navigation import grid

T_SL = se3.exp(np.array([0.3173, -0.221, 0.0, 0.0, 0.0, 0.37]))  # level frame to the scene's: walls lie along no row of cells
POSE_NOISE = [0.0015] * 3 + [0.0006] * 3  # [m, rad] of a SLAM's pose
DRIVES = {"kinect": {"laps": 1.09}, "laboratory": {name.lstrip("-").replace("-", "_"): value for name, value in PAPER.items()}}


def main() -> None:
    """Print a line a room and drive."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2, 3, 4])
    parser.add_argument("--set", dest="settings", action="append", default=[], metavar="KEY=VALUE")
    given = parser.parse_args()
    print("drive       room  free is free  floor free  floor occupied  outline  hanging box: occupied, free  low box: occupied")
    for name, drive in DRIVES.items():
        for seed in given.seeds:
            found = score(toml.apply(Config(), given.settings), seed, drive)
            hanging, low = (found.special[box] for box in grid_truth.SPECIAL)
            print(
                f"{name:11} {seed:4} {found.free_is_free:13.4f} {found.floor_is_free:11.4f} {found.floor_is_occupied:15.4f} {found.outline_is_occupied:8.4f}"
                f" {hanging['occupied']:12} of {hanging['cells']}, {hanging['free']} {low['occupied']:18} of {low['cells']}"
            )


def score(config: Config, seed: int, drive: dict) -> grid_truth.GridScore:
    """Render one drive's depth where the grid looks, and compare the grid with the room."""
    what = simulate.Simulation(**{"frames": None, **drive, "seed": seed})
    scene, motion = simulate.build(what)
    settings = replace(config.grid2d, min_range=max(config.grid2d.min_range, what.depth_min if what.depth_min > 1 else 0.0))
    settings = replace(settings, max_range=min(settings.max_range, what.depth_max))
    renderer = Renderer(with_textured_share(scene.patches(), 0.0, seed), scene, what.camera(), texel=0.05)
    sensor = replace(noise.SensorNoise(), near=what.depth_min, far=what.depth_max)
    normal = noise.NormalNoise((what.height, what.width), seed)
    T_sc = motion.colour_T_lc[grid.spaced(motion.colour_T_lc, metres=settings.spacing, degrees=settings.spacing_deg)]
    depth = []
    for i, T in enumerate(T_sc):
        exact, cosine = renderer.depth(T, with_movable=True)
        z = noise.depth_noise(exact, cosine, what.camera().fx, sensor, normal, np.random.default_rng([seed, 3, i]))
        depth.append(np.where(z > 0, np.round(z * simulate.DEPTH_SCALE) / simulate.DEPTH_SCALE, np.nan).astype(np.float32))
    T_lc = se3.inverse(T_SL) @ T_sc @ se3.exp(np.random.default_rng(1).normal(0, 1, (len(T_sc), 6)) * POSE_NOISE)
    made = grid.build_grid(zip(depth, T_lc, strict=True), what.camera(), settings=settings, sensor=config.sensor)
    about = scene.to_dict()
    truth = grid_truth.TrueRoom(np.array(about["room"]["min"], float), np.array(about["room"]["max"], float), about["obstacles"])
    seen = (grid_truth.exact_points(truth, z, T, what.camera(), max_range=settings.max_range) for z, T in zip(depth, T_sc, strict=True))
    return grid_truth.score(made, truth, T_SL, seen, band=(settings.band_low, settings.band_high))


if __name__ == "__main__":
    main()
