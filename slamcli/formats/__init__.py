"""The table of trajectory formats, from which the exporter's choices and endings follow. Imports nothing heavy: the command line reads it."""

# name: endings of a file's name. `formats/trajectory.py` has a function `write_<name>(path, trajectory)` for each.
TRAJECTORY_FORMATS = {"tum": (".txt", ".tum"), "kitti": (".kitti",), "csv": (".csv",)}
