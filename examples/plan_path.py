"""Plan a robot's path on the grid of a run, from where the camera began to where it was farthest from there.

    python examples/plan_path.py [RECORDING]

RECORDING is anything that `slamcli run` takes; without it the demo is run, a simulated room.
"""

import sys

import numpy as np

import slamcli
from slamcli.navigation import planner

RADIUS = 0.2  # [m] of the robot


def main(recording: str = "demo") -> None:
    """Run, plan, print the path's corners."""
    run = slamcli.run(recording)
    grid, path = run.grid(), run.trajectory(frame="level").T_wc[:, :2, 3]

    farthest = path[np.argmax(np.linalg.norm(path - path[0], axis=1))]
    try:
        start, goal = planner.nearest_room(grid, [tuple(path[0]), tuple(farthest)], radius=RADIUS, allow_unknown=False)
        route = planner.plan(grid, start, goal, radius=RADIUS)
    except slamcli.SlamError as error:  # no floor to drive on, or no way
        sys.exit(str(error))
    print(f"{route.length:.2f} m from ({start[0]:.2f}, {start[1]:.2f}) to ({goal[0]:.2f}, {goal[1]:.2f}), {len(route.xy)} points")
    for x, y in route.xy[:: max(1, len(route.xy) // 10)]:
        print(f"{x:8.3f} {y:8.3f}")


if __name__ == "__main__":
    main(*sys.argv[1:])
