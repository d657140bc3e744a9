"""Dense maps from posed depth images: `voxel_cloud` or `tsdf` the surface, `occupancy` by `ray_casting` the space, `texture` its colours."""
