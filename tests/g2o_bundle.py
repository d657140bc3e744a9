"""The same bundle adjustment in g2o, for tests and scripts: VertexSE3, VertexPointXYZ, EdgeSE3PointXYZDepth."""

from pathlib import Path

import numpy as np

from slamcli.estimation.bundle_problem import Observations
from slamcli.geometry import se3


class G2oBundle:
    """A bundle problem in g2o. Built from a text file, as the camera parameters cannot be set from Python."""

    def __init__(self, T_cw, x_w, seen: Observations, camera, *, is_fixed, limits, folder: Path) -> None:
        import g2opy

        self.n_kf = len(T_cw)
        path = folder / "bundle.g2o"
        path.write_text("\n".join(self._lines(T_cw, x_w, seen, camera, is_fixed)) + "\n")
        self.optimizer = g2opy.SparseOptimizer()
        self.optimizer.set_algorithm(g2opy.OptimizationAlgorithmLevenberg(g2opy.BlockSolverSE3(g2opy.LinearSolverEigenSE3())))
        assert self.optimizer.load(str(path))
        vertices = self.optimizer.vertices()
        for lm in range(len(x_w)):
            vertices[self.n_kf + lm].set_marginalized(True)
        for edge in self.optimizer.edges():
            has_depth = edge.information()[2, 2] > 0.0
            edge.set_robust_kernel(g2opy.RobustKernelHuber(float(np.sqrt(limits[1] if has_depth else limits[0]))))
        self.optimizer.initialize_optimization()

    def _lines(self, T_cw, x_w, seen, camera, is_fixed):
        T_wc = se3.inverse(T_cw)
        pose = np.concatenate([T_wc[:, :3, 3], se3.quaternion_xyzw(T_wc)], axis=1)
        has_depth = np.isfinite(seen.depth)
        w_px, w_z = np.asarray(seen.sigma_px) ** -2.0, np.where(has_depth, np.asarray(seen.sigma_z) ** -2.0, 0.0)
        yield f"PARAMS_CAMERACALIB 0 0 0 0 0 0 0 1 {camera.fx!r} {camera.fy!r} {camera.cx!r} {camera.cy!r}"
        for k in range(self.n_kf):
            yield f"VERTEX_SE3:QUAT {k} " + " ".join(map(repr, pose[k].tolist()))
        for k in np.flatnonzero(is_fixed):
            yield f"FIX {k}"
        for lm, x in enumerate(x_w.tolist()):
            yield f"VERTEX_TRACKXYZ {self.n_kf + lm} " + " ".join(map(repr, x))
        columns = np.column_stack([seen.xy, np.where(has_depth, seen.depth, 0.0), w_px, w_z]).tolist()
        for k, lm, (u, v, d, a, b) in zip(np.asarray(seen.kf).tolist(), np.asarray(seen.lm).tolist(), columns, strict=True):
            yield f"EDGE_PROJECT_DEPTH {k} {self.n_kf + lm} 0 {u!r} {v!r} {d!r} {a!r} 0 0 {a!r} 0 {b!r}"

    def cost(self) -> float:
        self.optimizer.compute_active_errors()
        return self.optimizer.active_robust_chi2()

    def optimize(self, iterations: int) -> int:
        return self.optimizer.optimize(iterations)

    def T_cw(self) -> np.ndarray:
        vertices = self.optimizer.vertices()
        return se3.inverse(np.array([vertices[k].estimate().matrix() for k in range(self.n_kf)]))
