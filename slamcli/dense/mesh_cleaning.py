"""Make a mesh fit for use: without the crumbs that noise leaves in the air, and with as many triangles as are wanted."""

import numpy as np
from scipy import sparse
from scipy.sparse import csgraph

from slamcli.dense.tsdf import Mesh
from slamcli.open3d_loader import load_open3d


def without_islands(mesh: Mesh, *, min_area: float) -> Mesh:
    """Drop the parts, joined by their triangles, whose surface is smaller than `min_area` [m^2], and vertices of no triangle."""
    if not len(mesh.triangle):
        return mesh
    a, b, c = mesh.triangle.T
    n = len(mesh.xyz)
    edges = sparse.coo_matrix((np.ones(2 * len(a), dtype=np.int8), (np.concatenate([a, b]), np.concatenate([b, c]))), shape=(n, n))
    part = csgraph.connected_components(edges, directed=False)[1]
    area = np.bincount(part[a], weights=triangle_areas(mesh), minlength=part.max() + 1)
    return compact(mesh, mesh.triangle[area[part[a]] >= min_area])


def triangle_areas(mesh: Mesh) -> np.ndarray:
    """Compute the triangles' areas (M,) [m^2]."""
    a, b, c = (mesh.xyz[mesh.triangle[:, k]].astype(np.float64) for k in range(3))
    return 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)


def compact(mesh: Mesh, triangle: np.ndarray) -> Mesh:
    """Keep only these triangles (M, 3) of a mesh, and their vertices, in their order."""
    used = np.zeros(len(mesh.xyz), dtype=bool)
    used[triangle] = True
    row = (np.cumsum(used) - 1).astype(np.int32)
    return Mesh(mesh.xyz[used], mesh.rgb[used], mesh.normal[used], np.ascontiguousarray(row[triangle]))


def decimated(mesh: Mesh, *, triangles: int) -> Mesh:
    """Merge edges until at most so many triangles are left: M. Garland, P. Heckbert, SIGGRAPH 1997, doi:10.1145/258734.258849."""
    if len(mesh.triangle) <= triangles:
        return mesh
    o3d = load_open3d()
    full = o3d.geometry.TriangleMesh(
        o3d.utility.Vector3dVector(mesh.xyz.astype(np.float64)), o3d.utility.Vector3iVector(mesh.triangle.astype(np.int32))
    )
    full.vertex_colors = o3d.utility.Vector3dVector(mesh.rgb.astype(np.float64) / 255.0)
    less = full.simplify_quadric_decimation(triangles)
    less.compute_vertex_normals()
    rgb = np.clip(np.rint(np.asarray(less.vertex_colors) * 255.0), 0, 255).astype(np.uint8)
    made = Mesh(
        np.asarray(less.vertices, dtype=np.float32), rgb, np.asarray(less.vertex_normals, dtype=np.float32),
        np.asarray(less.triangles, dtype=np.int32),
    )  # fmt: skip
    return compact(made, made.triangle)
