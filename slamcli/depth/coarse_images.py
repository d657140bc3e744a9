"""The coarse depth images of a recording, kept in lossless code and decoded as they are asked for: half the size, and few are needed at a time."""

from collections.abc import Callable, Iterable

import numpy as np

from slamcli.errors import SlamError
from slamcli.formats import rvl
from slamcli.parallel import LastUsed
from slamcli.schema import CoarseDepth

KEPT = 256  # decoded images, of 38 kB each: views are compared with those up to a second before and after
Change = Callable[[int, np.ndarray], np.ndarray]


def encode(images: Iterable[np.ndarray | None], shape: tuple[int, int]) -> CoarseDepth:
    """Encode the coarse depth images (V, U) uint16 of a recording's frames, None where a frame has none."""
    nothing = code_of(np.zeros(shape, np.uint16))
    codes = [nothing if image is None else code_of(image) for image in images]
    return CoarseDepth(
        coarse_shape=np.array(shape, dtype=np.int32),
        coarse_offset=np.cumsum([0, *map(len, codes)], dtype=np.int64),
        coarse_code=np.frombuffer(b"".join(codes), dtype=np.uint8),
    )


def code_of(image: np.ndarray) -> bytes:
    """Encode one coarse depth image (V, U) uint16."""
    return rvl.encode(image) if image.size else b""


class CoarseImages:
    """A sequence of coarse depth images (V, U) uint16, those used last kept. Several threads may ask at once."""

    def __init__(self, depth: CoarseDepth, change: Change | None = None) -> None:
        """Take the code; change : makes of a frame's number and its image the image that is shown, and may write into it."""
        self._depth, self._change = depth, change
        rows, columns = (int(n) for n in depth.coarse_shape)
        self.shape = len(depth.coarse_offset) - 1, rows, columns
        self._kept: LastUsed[np.ndarray] = LastUsed(KEPT)

    def __len__(self) -> int:
        return self.shape[0]

    def code(self, frame: int) -> np.ndarray:
        """Return the code of one frame's image as it was given: equal images have equal codes."""
        first, end = (int(n) for n in self._depth.coarse_offset[frame : frame + 2])
        return self._depth.coarse_code[first:end]

    @property
    def size(self) -> int:
        """Return the number of pixels of all images together."""
        return self.shape[0] * self.shape[1] * self.shape[2]

    def __getitem__(self, frame: int) -> np.ndarray:
        """Return a frame's image, not to be written to."""
        frame = range(len(self))[frame]
        return self._kept.get(frame, self._decode)

    def of(self, frames: Iterable[int]) -> np.ndarray:
        """Return the images (N, V, U) of some frames."""
        chosen = [self[int(frame)] for frame in frames]
        return np.stack(chosen) if chosen else np.zeros((0, *self.shape[1:]), np.uint16)

    def changed(self, change: Change) -> "CoarseImages":
        """Return the same images as `change` makes them."""
        return CoarseImages(self._depth, change)

    def _decode(self, frame: int) -> np.ndarray:
        _, rows, columns = self.shape
        if rows * columns == 0:
            return np.zeros((rows, columns), np.uint16)
        code = self._depth.coarse_code[int(self._depth.coarse_offset[frame]) : int(self._depth.coarse_offset[frame + 1])]
        try:
            image = rvl.decode(code.tobytes(), columns, rows)
        except SlamError as error:
            raise SlamError(f"coarse_code.npy, frame {frame}: {error}") from error
        return image if self._change is None else self._change(frame, image)
