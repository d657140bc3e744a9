"""The camera that a stage knows, as a file beside its results."""

import json
from pathlib import Path

from slamcli import files
from slamcli.geometry.camera import Camera


def write_camera(out: Path, camera: Camera) -> None:
    """Write `camera.json`: the recording's calibration, and in later stages what is known of the camera by then."""
    files.write_text(out / "camera.json", json.dumps(camera.to_dict(), indent=2) + "\n")
