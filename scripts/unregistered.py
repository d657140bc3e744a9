"""Depth that was never registered to colour: re-render a recording's depth as another camera sees it, and run that.

    python scripts/unregistered.py path/to/rgbd_dataset_freiburg1_xyz
    python scripts/unregistered.py --rooms 103 104 105 106

Each row is a run of the same colour images: with depth as it is, and with depth of a camera of another focal length that sits aside and
turned, whose calibration is given in the camera file, or is kept back. Of simulated rooms, each depth camera's images are rendered, with its
own noise; those of other recordings are made of the registered ones, and lose some outlines twice. Errors are against the recording's
truth, without and with scale.
"""

import argparse
import json
import tempfile
from pathlib import Path

import cv2
import numpy as np

import slamcli
from slamcli import inspection
from slamcli.console import table
from slamcli.datasets import Dataset, open_dataset, silent
from slamcli.datasets.simulate import simulate
from slamcli.geometry.camera import Camera
from slamcli.geometry.depth_registration import Registration
from slamcli.slam.doubt import Finding

TURN_DEG = 0.5
# Focal length [px], offset [m], principal point [px].
CASES = {"585 px, 25 mm": (585.0, 0.025, (320.0, 240.0)), "385 px, 15 mm": (385.0, 0.015, (312.5, 246.0))}


def main() -> None:
    """Run every case."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recording", nargs="?")
    parser.add_argument("--rooms", type=int, nargs="+", metavar="SEED", default=[], help="simulated rooms instead of a recording")
    parser.add_argument("--frames", type=int, help="from the beginning; of a room [360]")
    parser.add_argument("--kept-back", action="store_true", help="also without the depth camera's calibration")
    arguments = parser.parse_args()
    if arguments.recording:
        of_recording(arguments)
    for seed in arguments.rooms:
        of_room(seed, arguments)


def of_room(seed: int, arguments: argparse.Namespace) -> None:
    """Render a room with registered depth and with each depth camera, run all, print the table."""
    rows = [["depth", "APE [m]", "with scale", "scale", "frames"]]
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder)

        def rendered(name: str, **beside: float) -> Path:
            return simulate(place / name, progress=silent, seed=seed, frames=arguments.frames or 360, **beside)

        rows.append([f"room {seed}, registered", *figures(rendered("registered"), place / "runs/registered")])
        for name, (focal, aside, _) in CASES.items():
            recording = rendered(name, depth_focal=focal, depth_aside=aside, depth_turn=TURN_DEG)
            rows.append([f"{name}, given", *figures(recording, place / "runs" / f"{name}, given")])
            if arguments.kept_back:
                calibration = json.loads((recording / "camera.json").read_text())
                del calibration["depth"]
                (recording / "camera.json").write_text(json.dumps(calibration))
                rows.append([f"{name}, kept back", *figures(recording, place / "runs" / f"{name}, kept back")])
    print(table(rows), flush=True)


def of_recording(arguments: argparse.Namespace) -> None:
    """Re-render a recording's depth for each depth camera, run all, print the table."""
    dataset = open_dataset(arguments.recording)
    n = min(arguments.frames or len(dataset), len(dataset))
    rows = [["depth", "APE [m]", "with scale", "scale", "frames"]]
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder)
        rows.append(["registered", *figures(write(dataset, place / "registered", n, None, is_told=True), place / "runs/registered")])
        for name, (focal, aside, centre) in CASES.items():
            given = rig(dataset.camera, focal, aside, centre)
            for is_told in (True, False) if arguments.kept_back else (True,):
                label = f"{name}, {'given' if is_told else 'kept back'}"
                folder_name = label.replace(" ", "_").replace(",", "")
                rows.append([label, *figures(write(dataset, place / folder_name, n, given, is_told=is_told), place / "runs" / folder_name)])
                print(table(rows[-1:]), flush=True)
    print(table(rows))


def rig(colour: Camera, focal: float, aside: float, centre: tuple[float, float]) -> Registration:
    """Put a depth camera beside the colour camera."""
    depth_camera = Camera(640, 480, focal, focal, *centre, depth_scale=colour.depth_scale)
    T_cd = np.eye(4)
    T_cd[:3, :3] = cv2.Rodrigues(np.radians(TURN_DEG) * np.array([0.5, 0.7, 0.5]))[0]
    T_cd[0, 3] = aside
    return Registration(depth_camera, colour, T_cd)


def write(dataset: Dataset, out: Path, n: int, given: Registration | None, *, is_told: bool) -> Path:
    """Write a folder that links to the colour images, with depth as the other camera sees it."""
    (out / "depth").mkdir(parents=True)
    (out / "rgb").symlink_to(dataset.root.resolve() / "rgb")
    lists: dict[str, list[str]] = {"rgb": [], "depth": []}
    seen_by = Registration(dataset.camera, given.depth_camera, np.linalg.inv(given.T_cd)) if given else None
    for i in range(n):
        lists["rgb"].append(f"{dataset.stamp[i]:.6f} {dataset.colour_name[i]}")
        depth = dataset.depth(i)
        if depth is None:
            continue
        moved = seen_by.apply(depth) if seen_by else depth
        raw = np.rint(np.nan_to_num(moved * dataset.camera.depth_scale)).clip(0, 65534).astype(np.uint16)
        cv2.imwrite(str(out / "depth" / f"{i}.png"), raw)
        lists["depth"].append(f"{dataset.depth_stamp[i]:.6f} depth/{i}.png")
    for name, lines in lists.items():
        (out / f"{name}.txt").write_text("\n".join(lines) + "\n")
    lines = [f"{key} = {value!r}" for key, value in dataset.camera.to_dict().items()]
    if given is not None and is_told:
        camera = given.depth_camera
        lines += [
            "[depth]",
            f"fx = {camera.fx}",
            f"fy = {camera.fy}",
            f"cx = {camera.cx}",
            f"cy = {camera.cy}",
            f"T_cd = {given.T_cd.tolist()}",
        ]
    (out / "camera.toml").write_text("\n".join(lines) + "\n")
    (out / "groundtruth.txt").symlink_to(dataset.root.resolve() / "groundtruth.txt")
    return out


def look(dataset: Dataset) -> list[Finding]:
    """Look at a recording first, as `slamcli run` does: it is what starts the search for a depth camera."""
    return inspection.doubts(inspection.quick_look(dataset))


def figures(recording: Path, out: Path) -> list[str]:
    """Run a recording up to loop and measure it."""
    run = slamcli.run(str(recording), path=out, until="loop", look=look)
    ape = run.ape()
    return [f"{np.sqrt(np.mean(ape.error**2)):.4f}", f"{ape.rmse_scaled:.4f}", f"{ape.scale:.4f}", str(ape.n_poses)]


if __name__ == "__main__":
    main()
