"""Write small recordings in the TUM layout, sound or broken, for the readers' tests."""

from pathlib import Path

import cv2
import numpy as np

SIZE = (64, 48)  # width, height
CAMERA = '{"width": 64, "height": 48, "fx": 60.0, "fy": 60.0, "cx": 31.5, "cy": 23.5, "depth_scale": 5000}'


def colour(seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (SIZE[1], SIZE[0], 3), dtype=np.uint8)


def depth(seed: int = 0) -> np.ndarray:
    raw = np.random.default_rng(seed).integers(4000, 15000, (SIZE[1], SIZE[0]), dtype=np.uint16)
    raw[0, :5] = 0
    return raw


def png(image: np.ndarray, suffix: str = ".png") -> bytes:
    return cv2.imencode(suffix, image)[1].tobytes()


def write_recording(folder: Path, *, frames: int = 4, suffix: str = ".png", camera: str | None = CAMERA, offset: float = 0.004) -> Path:
    """Write `frames` pairs at 30 Hz, depth `offset` s after colour."""
    for name in ("rgb", "depth"):
        (folder / name).mkdir(parents=True)
    lists: dict[str, list[str]] = {"rgb": ["# colour"], "depth": ["# depth"]}
    for i in range(frames):
        stamp = i / 30
        (folder / "rgb" / f"{i}{suffix}").write_bytes(png(colour(i), suffix))
        (folder / "depth" / f"{i}.png").write_bytes(png(depth(i)))
        lists["rgb"].append(f"{stamp:.6f} rgb/{i}{suffix}")
        lists["depth"].append(f"{stamp + offset:.6f} depth/{i}.png")
    for name, lines in lists.items():
        (folder / f"{name}.txt").write_text("\n".join(lines) + "\n")
    if camera is not None:
        (folder / "camera.json").write_text(camera)
    return folder
