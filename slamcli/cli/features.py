"""slamcli inspect-features."""

from __future__ import annotations

import json
from pathlib import Path

import click

from slamcli.cli.common import Target, complete_target, json_option


@click.command("inspect-features", short_help="Draw plain OpenCV ORB beside our features on one frame.")
@click.argument("recording", shell_complete=complete_target)
@click.argument("frame", type=click.IntRange(min=0))
@click.argument("out", type=Target())
@click.option("--data", metavar="DIR", help="Folder of recordings. [default: $SLAMCLI_DATA, ./data, the user's cache]")
@click.option("--features", type=click.IntRange(50, 20000), default=1000, show_default=True, help="Key points wanted.")
@json_option
def inspect_features(recording: str, frame: int, out: Path, data: str | None, features: int, as_json: bool) -> None:
    """Draw plain OpenCV ORB beside our features on FRAME (0, 1, ...) of RECORDING into the picture OUT, and print how even both are.

    RECORDING is what `slamcli run` takes, or a run directory.
    """
    import cv2

    from slamcli import files
    from slamcli.config.options import ExtractConfig
    from slamcli.datasets import open_dataset
    from slamcli.errors import SlamError
    from slamcli.runs.run_directory import RunDir
    from slamcli.vision import comparison, orb

    is_run = (Path(recording) / "run.json").is_file()
    dataset = RunDir.find(recording).dataset() if is_run else open_dataset(recording, data=data)
    if frame >= len(dataset):
        raise SlamError(f"{recording}: has no frame {frame}; its {len(dataset)} frames are 0 to {len(dataset) - 1}")
    grey = dataset.grey(frame)
    found = {"OpenCV ORB": comparison.plain_orb(grey, features), "slamcli": orb.detect(grey, ExtractConfig(features=features))}
    figures = {}
    for name, points in found.items():
        even = comparison.evenness(points.xy, dataset.camera.width, dataset.camera.height)
        figures[name] = {"points": len(points), "cells_hit": round(even.share, 4), "variance_to_mean": round(even.ratio, 3)}
    try:
        _, picture = cv2.imencode(out.suffix, comparison.side_by_side(grey, *found.values()))
    except cv2.error as error:
        raise SlamError(f"{out}: not a kind of picture that can be written; take .png or .jpg") from error
    files.write_bytes(out, picture.tobytes())
    if as_json:
        click.echo(json.dumps(figures, indent=1))
        return
    for name, row in figures.items():
        click.echo(
            f"{name:<12}{row['points']:>6} points   {row['cells_hit']:>6.1%} of cells hit   variance / mean {row['variance_to_mean']:.2f}"
        )
