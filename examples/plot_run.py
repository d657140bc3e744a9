"""Run a recording and draw the camera's path on the navigation grid.

    python examples/plot_run.py [RECORDING] [PICTURE]

RECORDING is anything that `slamcli run` takes; without it the demo is run, a simulated room.
"""

import sys

import matplotlib.pyplot as plt

import slamcli


def main(recording: str = "demo", picture: str = "run.png") -> None:
    """Run, then draw what came out, seen from above."""
    run = slamcli.run(recording)
    grid, path = run.grid(), run.trajectory(frame="level").T_wc[:, :3, 3]

    rows, columns = grid.state.shape
    x, y = grid.origin
    extent = (x, x + columns * grid.resolution, y, y + rows * grid.resolution)
    plt.imshow(-grid.state, origin="lower", extent=extent, cmap="gray", interpolation="nearest")  # occupied dark, free grey, unknown light
    plt.plot(path[:, 0], path[:, 1])
    plt.xlabel("x [m]")
    plt.ylabel("y [m]")
    plt.title(f"{run.name}: {len(path)} poses")
    plt.savefig(picture, dpi=120)
    print(picture)


if __name__ == "__main__":
    main(*sys.argv[1:])
