"""The program from Python: the same run as the command line makes, and nothing printed."""

import logging
import shutil
from pathlib import Path

import numpy as np
import pytest

import slamcli
from slamcli.config import toml
from slamcli.config.options import Config
from slamcli.errors import SlamError
from slamcli.formats.trajectory import read_tum
from slamcli.geometry import se3
from slamcli.schema import Trajectory
from slamcli.slam.doubt import Finding
from slamcli.stages import NAMES


def test_a_run_from_python_is_byte_for_byte_that_of_the_command_line(
    room: Path, room_run: Path, here: Path, capfd: pytest.CaptureFixture
) -> None:
    run = slamcli.run(room, path=here / "mine", until="loop")
    theirs = slamcli.open_run(room_run)
    for stage in NAMES[: NAMES.index("loop") + 1]:
        assert run.record(stage)["digest"] == theirs.record(stage)["digest"]
    assert run.record("densify") is None
    assert capfd.readouterr() == ("", ""), "progress and talk are the caller's"


def test_progress_and_lines_reach_the_caller(room: Path, here: Path) -> None:
    lines, labels = [], []

    def progress(items, label, total=None):
        labels.append(label)
        yield from items

    slamcli.run(room, path="run", until="match", progress=progress, tell=lines.append)
    assert "extract" in labels
    assert [line.split()[0] for line in lines if line.split()[0] in NAMES] == ["extract", "match"]
    slamcli.open_run("run").update(until="match", tell=lines.append)
    assert [line.split(maxsplit=1)[1] for line in lines[-2:]] == ["up to date"] * 2


def test_settings_are_values_or_the_texts_of_the_command_line_and_stay_with_the_run(room: Path, here: Path) -> None:
    run = slamcli.run(room, path="run", settings={"extract.features": 200, "seed": 3}, until="extract")
    assert (run.config().extract.features, run.config().seed) == (200, 3)
    run.update(settings=["extract.features=150"], until="extract")
    assert (run.config().extract.features, run.config().seed) == (150, 3)
    assert run.status()["extract"].is_fresh
    stale = run.status(settings={"extract.features": 99})["extract"]
    assert stale.reason == "config: extract.features 150 -> 99"
    assert run.config().extract.features == 150, "asking changes nothing"


@pytest.mark.parametrize(
    "settings, message",
    [
        ({"track.min_inlier": 20}, r"settings: track.min_inlier is not known; did you mean track.min_inliers"),
        ({"track": 20}, r"track is a section"),
        ({"track.min_inliers": "many"}, r"settings: track.min_inliers = \"many\": must be a whole number"),
        ({"extract.features": 10**9}, r"settings: extract.features = 1000000000"),
        ({"seed.track": 1}, r"settings: seed.track is not known"),
    ],
)
def test_a_wrong_setting_is_named(settings: dict, message: str) -> None:
    with pytest.raises(SlamError, match=message):
        toml.resolve(Config(), None, settings)


def test_what_a_run_made_is_read_in_the_level_frame(room_run: Path) -> None:
    run = slamcli.open_run(room_run)
    world, level = run.trajectory(), run.trajectory(frame="level")
    np.testing.assert_allclose(level.T_wc, run.ground().T_lw @ world.T_wc)
    np.testing.assert_allclose(world.T_wc, read_tum(room_run / "loop" / "trajectory.txt").T_wc, atol=1e-4)
    xyz, rgb, normal = run.cloud()
    assert xyz.shape == rgb.shape == normal.shape and len(xyz) > 100
    tree, grid = run.octree(), run.grid()
    assert tree.is_occupied().any() and not tree.is_occupied().all()
    low, high = grid.origin, grid.origin + np.array(grid.state.shape[::-1]) * grid.resolution
    assert ((low < level.T_wc[:, :2, 3].max(axis=0)) & (level.T_wc[:, :2, 3].min(axis=0) < high)).all()
    assert run.summary()["extract"]["frames"] == len(run.dataset())


def test_a_map_is_judged(room_run: Path) -> None:
    verdict = slamcli.open_run(room_run).verdict()
    assert verdict is not None and not verdict.is_usable
    assert verdict.findings[0].cause == "floor never seen"


def test_errors_against_the_truth(room_run: Path) -> None:
    run = slamcli.open_run(room_run)
    ape, rpe = run.ape(), run.rpe("track", seconds=None)
    assert 0.0 < ape.to_dict()["rmse"] < 0.1
    assert ape.stage == "loop" and rpe.stage == "track" and rpe.unit == "frame"
    moved = se3.transform(ape.T_gw, run.trajectory().T_wc[:, :3, 3])
    np.testing.assert_allclose(moved[: len(ape.x_aligned)], ape.x_aligned, atol=1e-6)


def test_errors_against_poses_of_ones_own_choice(room_run: Path) -> None:
    run = slamcli.open_run(room_run)
    own, other = run.trajectory(), run.trajectory("track")
    ape = run.ape(truth=Trajectory(own.stamp[::2], own.T_wc[::2]))
    assert ape.rmse < 1e-9 and ape.n_poses == len(own.stamp) and len(ape.stamp) == len(own.stamp[::2])
    assert run.ape(truth=other).rmse > 1e-6, "loop moved the poses that track found"
    assert run.rpe(truth=own).translation.max() < 1e-9


def test_a_stage_alone_and_a_report(room_run: Path, here: Path) -> None:
    shutil.copytree(room_run, here / "run")
    run = slamcli.open_run("run").run_stage("grid2d", settings={"grid2d.resolution": 0.1})
    assert float(run.grid().resolution) == 0.1
    assert run.report("page.html").read_text().lower().startswith("<!doctype html>")


@pytest.mark.parametrize(
    ("settings", "message"),
    [({"recording.start": 1e6}, "nothing is left of it"), ({"camera.fx": -1.0}, "fx")],
)
def test_a_way_to_read_the_recording_in_which_it_cannot_be_read_changes_nothing(
    room_run: Path, here: Path, settings: dict, message: str
) -> None:
    run = slamcli.open_run(shutil.copytree(room_run, here / "run"))
    before = run.config()
    with pytest.raises(slamcli.SlamError, match=message):
        run.update(settings=settings)
    assert run.config() == before
    assert all(state.is_fresh for state in run.status().values())


def test_there_is_no_run_to_open(here: Path) -> None:
    with pytest.raises(SlamError, match="not a run directory"):
        slamcli.open_run("nowhere")
    with pytest.raises(SlamError, match="no run here yet"):
        slamcli.open_run()


def test_warnings_go_to_the_logger(room: Path, here: Path, caplog: pytest.LogCaptureFixture) -> None:
    broken = shutil.copytree(room, here / "recording")
    sorted((broken / "rgb").iterdir())[3].write_bytes(b"")
    with caplog.at_level(logging.WARNING, logger="slamcli"):
        slamcli.run(broken, path="run", until="extract")
    assert any("frame 3 skipped" in record.getMessage() for record in caplog.records)


def test_names_of_the_package(room_run: Path) -> None:
    assert {"run", "open_run", "Run", "SlamError"} <= set(dir(slamcli))
    with pytest.raises(AttributeError, match="no attribute 'walk'"):
        _ = slamcli.walk
    assert repr(slamcli.open_run(room_run)) == f"Run({str(room_run)!r})"


def test_a_look_may_find_nothing_or_refuse_a_recording(room: Path, here: Path) -> None:
    seen = []
    first = slamcli.run(room, path="run", until="extract", look=lambda dataset: seen.append(dataset.root))
    assert seen == [room.resolve()] and "doubts" not in first.summary()["extract"]

    def refuse(dataset):
        raise SlamError(f"{dataset.root}: not this one")

    with pytest.raises(SlamError, match="not this one"):
        slamcli.run(room, path="other", look=refuse)
    assert slamcli.open_run("other").summary() == {}


def test_what_a_look_finds_stays_with_the_run(room: Path, here: Path) -> None:
    run = slamcli.run(room, path="run", until="extract", look=lambda dataset: [Finding("lamp", "the lamp is off")])
    assert [row["name"] for row in run.summary()["extract"]["doubts"]] == ["lamp"]
