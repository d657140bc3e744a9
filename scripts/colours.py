"""How far the colours of overlapping key frames differ, as recorded and evened out.

    python scripts/colours.py RUN

For each pair of key frames that share surfaces, the shared voxels' colours are compared: how much brighter one frame shows them than the
other, channel by channel, in the middle of the pair; the same in tiles of a fourth of the picture's width, where vignetting shows; and by
how much single voxels differ, texture within them and noise included. The gains were fitted to other voxels, of another size.
"""

import argparse
from collections.abc import Iterator
from itertools import combinations

import numpy as np

from slamcli import console
from slamcli.geometry import se3, voxel
from slamcli.runs.run_directory import RunDir
from slamcli.schema import Moving
from slamcli.stages import densify
from slamcli.stages.depth_frames import DepthFrames, depth_poses

SIDE, SHIFT = 0.02, 0.007  # [m] of the voxels compared, and of their borders from those of the fit
LEAST_SHARED = 1000  # voxels that two key frames share, and a tile a tenth of
TILES = 4  # across a picture
HALF_EXTENT = 1 << 20  # voxels


def main() -> None:
    """Print a row for colours as recorded, under gains, and under gains and shading."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run")
    folder = RunDir.find(parser.parse_args().run)
    config, camera, poses = folder.config(), folder.camera("loop"), depth_poses(folder)
    depths = DepthFrames(folder.dataset(), camera, folder.load(Moving, "loop"), config.run.workers)
    found = densify.find_colours(depths, poses, config.sensor, config.densify)
    kinds = {
        "as recorded": densify.AS_RECORDED,
        "gains": densify.Colours(found.log_gain, densify.AS_RECORDED.shading),
        "gains and shading": found,
    }
    samples = [Sampled.of(view, list(kinds.values())) for view in densify.views(depths, poses, config.sensor, config.densify)]
    rows = np.array(list(differences(samples)))
    corner = found.shading[0, 0] / found.shading[camera.height // 2, camera.width // 2]
    spread = np.exp(np.std(list(found.log_gain.values()), axis=0))
    print(f"{len(rows)} pairs; gains spread by {spread.round(3)}, corners brightened by {corner.round(3)} (r g b)")
    figures = [[name, *(f"{value:.2f}" for value in rows[:, k].mean(axis=0))] for k, name in enumerate(kinds)]
    print(console.table([["colours", "pair", "tile", "voxel [grey levels]"], *figures]))


class Sampled:
    """The voxels of one key frame and their mean colours, of several kinds, in grey levels."""

    def __init__(self, key: np.ndarray, colour: np.ndarray, tile: np.ndarray) -> None:
        self.key, self.colour, self.tile = key, colour, tile

    @classmethod
    def of(cls, view: densify.KeyFrameView, kinds: list[densify.Colours]) -> "Sampled":
        """Sample a view."""
        xyz = se3.transform(view.T_wk, view.seen.xyz_c.astype(np.float64))
        cell = np.floor((xyz + SHIFT) / SIDE).astype(np.int64) + HALF_EXTENT
        key, row = np.unique(voxel.morton(cell), return_inverse=True)
        n = np.bincount(row)
        images = [view.evened(colours).reshape(-1, 3)[view.seen.pixel] for colours in kinds]
        colour = np.stack([[np.bincount(row, weights=image[:, k]) / n for k in range(3)] for image in images], axis=0)
        height, width = view.depth.shape
        v, u = np.divmod(view.seen.pixel, width)
        tile = np.zeros(len(key), dtype=np.int64)
        tile[row] = v * TILES // height * TILES + u * TILES // width
        return cls(key, colour.transpose(0, 2, 1), tile)


def differences(samples: list[Sampled]) -> Iterator[list[list[float]]]:
    """Give for each pair of key frames, by kind, the differences of its middle, of its tiles and of its voxels [grey levels]."""
    for a, b in console.progress(list(combinations(samples, 2)), "pairs"):
        _, i, j = np.intersect1d(a.key, b.key, assume_unique=True, return_indices=True)
        if len(i) < LEAST_SHARED:
            continue
        tiles = [a.tile[i] == t for t in np.unique(a.tile[i])]
        tiles = [tile for tile in tiles if np.count_nonzero(tile) >= LEAST_SHARED // 10]
        rows = []
        for first, second in zip(a.colour, b.colour, strict=True):
            off = first[i] - second[j]
            of_tiles = [np.abs(np.median(off[tile], axis=0)).mean() for tile in tiles]
            rows.append([float(np.abs(np.median(off, axis=0)).mean()), float(np.mean(of_tiles)), float(np.median(np.abs(off)))])
        yield rows


if __name__ == "__main__":
    main()
