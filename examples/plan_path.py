"""Plan a robot's path on the grid of a run, from where the camera began to where it was farthest from there.

    python examples/plan_path.py [RECORDING]

RECORDING is anything that `slamcli run` takes; without it the demo is run, a simulated room.
"""

import sys

import numpy as np

import slamcli
from slamcli.navigation import planner


def main(recording: str = "demo") -> None:
    """Run, plan, print the path's corners."""
    run = slamcli.run(recording)
    grid, path = run.grid(), run.trajectory(frame="level").T_wc[:, :2, 3]

    is_roomy = planner.obstacle_distance(grid, allow_unknown=False) > 0.3  # [m], of the robot's middle
    if not is_roomy.any():
        sys.exit(f"{run.path}: the grid has no free place; was the floor seen? try: slamcli report")
    rows, columns = np.nonzero(is_roomy)
    places = grid.origin + (np.stack([columns, rows], axis=1) + 0.5) * grid.resolution
    start = places[np.argmin(np.linalg.norm(places - path[0], axis=1))]
    farthest = path[np.argmax(np.linalg.norm(path - path[0], axis=1))]
    goal = places[np.argmin(np.linalg.norm(places - farthest, axis=1))]

    route = planner.plan(grid, tuple(start), tuple(goal), radius=0.15)
    print(f"{route.length:.2f} m from ({start[0]:.2f}, {start[1]:.2f}) to ({goal[0]:.2f}, {goal[1]:.2f}), {len(route.xy)} points")
    for x, y in route.xy[:: max(1, len(route.xy) // 10)]:
        print(f"{x:8.3f} {y:8.3f}")


if __name__ == "__main__":
    main(*sys.argv[1:])
