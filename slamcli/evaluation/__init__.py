"""Results measured: `trajectory_error` and `map_error` against the truth, `map_verdict` without one, and the tables and plots of it.

Which trajectory of a run is measured is up to `run_trajectories`.
"""
