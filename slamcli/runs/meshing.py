"""The surface that a run's key frames saw, with their colours on its vertices or as a texture."""

from collections.abc import Iterator
from dataclasses import replace
from functools import cached_property

import cv2
import numpy as np

from slamcli import console
from slamcli.dense.texture import Painter, Textured, sharpness, unwrap
from slamcli.dense.tsdf import Mesh, Volume
from slamcli.runs.run_directory import RunDir
from slamcli.schema import Ground, Moving
from slamcli.stages import densify
from slamcli.stages.depth_frames import DepthFrames, depth_poses

SHARPEST, BLURRED = 1.5, 0.5  # a view's quality stays between these, as shares of the middle one's


class RunSurface:
    """Makes meshes and textures from one run's key frames, in the level frame."""

    def __init__(self, folder: RunDir, *, voxel: float, even_colours: bool | None = None) -> None:
        """`voxel` is the surface's resolution [m]; colours are evened out as the run did, unless said otherwise."""
        self._config, self._camera = folder.config(), folder.camera("loop")
        self._option = replace(self._config.densify, method="tsdf", voxel=voxel)
        self._is_even = self._option.even_colours if even_colours is None else even_colours
        self._T_lw, self._poses = folder.load(Ground, "densify").T_lw, depth_poses(folder)
        self._depths = DepthFrames(folder.dataset(), self._camera, folder.load(Moving, "loop"), self._config.run.workers)

    def mesh(self) -> Mesh:
        """Integrate the key frames' depth, without what moves, to a surface with coloured vertices."""
        volume = Volume(self._camera, voxel=self._option.voxel, depth_max=self._option.depth_max)
        for view in self._views("mesh"):
            volume.add(view.seen, view.evened(self._colours), view.T_wk)
        return volume.mesh().moved(self._T_lw)

    def textured(self, mesh: Mesh, *, size: int) -> tuple[Textured, float]:
        """Paint a mesh with the key frames' images on `size` x `size` texels; also returns the share of its area that they saw."""
        painter = Painter(mesh, unwrap(mesh, size=size), self._camera, size=size)
        middle: list[float] = []
        for view in self._views("texture"):
            middle.append(sharpness(cv2.cvtColor(view.rgb, cv2.COLOR_RGB2GRAY)))
            quality = float(np.clip(middle[-1] / np.median(middle), BLURRED, SHARPEST))
            painter.add(view.evened(self._colours), view.depth, self._T_lw @ view.T_wk, quality=quality)
        return painter.textured(), painter.covered()

    @cached_property
    def _colours(self) -> densify.Colours:
        if not self._is_even:
            return densify.AS_RECORDED
        return densify.find_colours(self._depths, console.progress(self._poses, "colours"), self._config.sensor, self._option)

    def _views(self, name: str) -> Iterator[densify.KeyFrameView]:
        return densify.views(self._depths, console.progress(self._poses, name), self._config.sensor, self._option)
