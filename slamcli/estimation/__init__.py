"""Estimates without a map: a camera's pose (`camera_pose`), poses with landmarks (`bundle_adjustment`), poses with edges (`pose_graph`).

A file `*_kernels` holds what numba compiles for the file it is named after.
"""
