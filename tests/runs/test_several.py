"""Several recordings in one map: what overlaps is joined, what does not is kept apart, and no recording changes another's own result."""

import itertools
import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from slamcli import api
from slamcli.config.options import Config
from slamcli.datasets import open_dataset, silent
from slamcli.datasets.simulate import simulate
from slamcli.errors import SlamError
from slamcli.evaluation import run_trajectories, trajectory_error
from slamcli.formats.trajectory import read_tum
from slamcli.geometry import se3
from slamcli.runs import several, summary
from slamcli.runs.creation import create_run
from slamcli.runs.pipeline import Pipeline
from slamcli.runs.run_directory import RunDir
from slamcli.schema import Map, Recordings, Tracks, frame_segments
from slamcli.stages import NAMES

TINY = {"frames": 40, "laps": 0.15, "width": 160, "height": 120}  # as the fixture `room`


def render(folder: Path, **settings: object) -> Path:
    return simulate(folder, progress=silent, **{"seed": 1, **TINY, **settings})


def arrays_of(run: Path, *stages: str) -> dict[str, bytes]:
    """Every file of a run's stages but their records, which tell the time."""
    paths = (path for stage in stages or NAMES for path in (run / stage).rglob("*") if path.is_file() and path.name != "stage.json")
    return {path.relative_to(run).as_posix(): path.read_bytes() for path in paths}


@pytest.fixture(scope="module")
def recordings(room: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """`room`, the same room a little farther on in less light by another camera, and another room; all stamps begin at 0."""
    folder = tmp_path_factory.mktemp("several")
    return {
        "room": room,
        "again": render(folder / "again", start=0.03, light=0.8, take=1, width=200, height=144, field_of_view=66.0),
        "elsewhere": render(folder / "elsewhere", seed=5, frames=30, laps=0.12),
    }


@pytest.fixture(scope="module")
def house(recordings: dict[str, Path], tmp_path_factory: pytest.TempPathFactory) -> RunDir:
    """The finished run of all three. Only to be read."""
    return made(list(recordings.values()), tmp_path_factory.mktemp("runs") / "house")


def made(targets: list[Path], path: Path, **options: object) -> RunDir:
    before = Path.cwd()
    os.chdir(path.parent)
    try:
        return api.run(targets, path=path, **options).directory
    finally:
        os.chdir(before)


def counts(run: RunDir) -> dict[str, dict[str, int]]:
    return {row["name"]: row for row in run.record("loop")["summary"]["recordings"]}


def test_what_overlaps_lies_in_one_frame(house: RunDir) -> None:
    found = counts(house)
    assert [found[name]["located"] for name in ("room", "again")] == [40, 40]
    together = trajectory_error.ape(
        run_trajectories.stage_trajectory(house, "loop"), run_trajectories.ground_truth(house), n_frames=110, name="house"
    )
    assert len(together.stamp) == 80
    assert 0.0005 < together.rmse < 0.02  # 160 pixels across, by two cameras


def test_a_recording_that_joins_nothing_is_kept_apart_and_told(house: RunDir) -> None:
    assert counts(house)["elsewhere"] == {"name": "elsewhere", "frames": 30, "located": 0, "apart": 30, "lost": 0}
    told = [warning for warning in house.record("loop")["warnings"] if "joins nothing" in warning]
    assert len(told) == 1 and "elsewhere" in told[0] and "trajectory_segment1.txt" in told[0]
    assert len(read_tum(house.path / "loop" / "trajectory_segment1.txt").stamp) == 30


def test_each_recording_has_the_bytes_of_a_run_of_it_alone(house: RunDir, room_run: Path) -> None:
    alone, inside = (arrays_of(path, "extract", "match", "track", "optimize") for path in (room_run, house.recording_path("room")))
    assert alone.keys() == inside.keys() and len(alone) > 40
    assert [name for name in alone if alone[name] != inside[name]] == []


def test_reasons_for_key_frames_add_up_over_the_recordings(house: RunDir) -> None:
    summary = (house.record("track") or {})["summary"]
    parts = [(RunDir(house.recording_path(name)).record("track") or {})["summary"] for name in ("room", "again", "elsewhere")]
    assert summary["key_frame_reasons"]["begins a segment"] == sum(part["segments"] for part in parts) == 3
    assert sum(summary["key_frame_reasons"].values()) == sum(part["key_frames"] for part in parts)


def test_the_order_in_which_they_are_named_is_not_the_order_in_which_they_are_joined(
    house: RunDir, recordings: dict[str, Path], tmp_path: Path
) -> None:
    for number, names in enumerate(itertools.permutations(recordings)):
        targets = [str(recordings[name]) for name in names]
        run, dataset, _ = create_run(targets, resolve=lambda config: config or Config(), path=tmp_path / str(number))
        assert {**run.info(), "created": ""} == {**house.info(), "created": ""}
        assert dataset.digest() == house.info()["digest"]


def test_errors_are_told_together_and_for_each_under_one_alignment(house: RunDir, slamcli: Callable) -> None:
    figures = json.loads(slamcli("eval", "ape", "-r", house.path, "--json").stdout)
    rows = {row["name"]: row for row in figures["recordings"]}
    assert list(rows) == ["again", "elsewhere (apart)", "room"]
    squared = [rows[name]["rmse"] ** 2 * rows[name]["n_matched"] for name in ("again", "room")]
    assert figures["rmse"] == pytest.approx(np.sqrt(sum(squared) / figures["n_matched"]))
    assert figures["n_frames"] == 110 and figures["lost"] == 30
    assert 0.0 < rows["elsewhere (apart)"]["rmse"] < 0.02
    table = slamcli("eval", "ape", "-r", house.path).stdout.splitlines()
    assert [line.split("  ")[0] for line in table[1:]] == ["house", *rows]


def test_a_trajectory_is_told_in_its_recordings_own_stamps(house: RunDir, slamcli: Callable, tmp_path: Path) -> None:
    own = open_dataset(str(house.recordings[0]["root"])).stamp
    assert slamcli("export-trajectory", tmp_path / "t.txt", "--recording", "again", "-r", house.path).exit_code == 0
    found, file = read_tum(tmp_path / "t.txt"), read_tum(house.path / "loop" / "trajectory_again.txt")
    np.testing.assert_allclose(found.stamp, own, atol=1e-6)
    np.testing.assert_array_equal(found.T_wc, file.T_wc)
    whole = run_trajectories.stage_trajectory(house, "loop")
    np.testing.assert_allclose(found.T_wc, whole.T_wc[:40], atol=1e-8)  # it is the first: names decide where clocks do not
    unknown = slamcli("export-trajectory", tmp_path / "u.txt", "--recording", "attic", "-r", house.path)
    assert unknown.exit_code == 1 and "its recordings are again, elsewhere, room" in unknown.output


def test_what_reads_a_run_reads_one_of_several(house: RunDir, slamcli: Callable, tmp_path: Path) -> None:
    for command in (
        ["status"],
        ["report", "--out", tmp_path / "r.html"],
        ["export-colmap", tmp_path / "c"],
        ["eval", "rpe"],
        ["compare", house.path, house.path],
    ):
        flag = [] if command[0] == "compare" else ["-r", house.path]
        result = slamcli(*command, *flag)
        assert result.exit_code == 0, f"{command}: {result.output}"
    states = json.loads(slamcli("status", "-r", house.path, "--json").stdout)
    assert {state["state"] for state in states} == {"up to date"}
    listed = json.loads(slamcli("list", house.path.parent, "--json").stdout)
    assert [one["recording"] for one in listed] == ["again + elsewhere + room"]


def test_what_recordings_warned_of_alone_is_told_of_the_run(house: RunDir, monkeypatch: pytest.MonkeyPatch) -> None:
    said = {"house": ["all is dark"], "elsewhere": ["frame 3 skipped", "frame 4 skipped"]}
    records = lambda run, stage: {"warnings": said.get(run.path.name, []), "n_warnings": 9, "summary": {}} if stage == "extract" else None  # noqa: E731
    monkeypatch.setattr(RunDir, "record", records)
    told = summary.warned(house, "extract")
    assert told.texts == ["all is dark", "elsewhere: frame 3 skipped", "elsewhere: frame 4 skipped"]
    assert told.count == 36 and summary.warned(house, "grid2d") == summary.Warned([], 0)


def test_frames_are_numbered_through(house: RunDir) -> None:
    recordings, map_ = house.load(Recordings, "extract"), house.load(Map, "loop")
    assert recordings.recording_offset.tolist() == [0, 40, 70, 110]
    assert np.all(np.diff(map_.kf_frame) > 0) and map_.kf_frame[-1] >= 70
    segment = map_.kf_segment[(map_.kf_frame >= 40) & (map_.kf_frame < 70)]
    assert set(segment) == {1} and set(map_.kf_segment) == {0, 1}


@pytest.fixture(scope="module")
def grown(recordings: dict[str, Path], room_run: Path, tmp_path_factory: pytest.TempPathFactory) -> RunDir:
    """A finished run of `room`, to which `again` was added, after that was interrupted once. Only to be read."""
    path = tmp_path_factory.mktemp("grown") / "run"
    shutil.copytree(room_run, path)
    run, whole = api.open_run(path), Pipeline.run_stage

    def killed(self: Pipeline, stage: object, **more: object) -> None:
        if stage.name == "track":
            raise KeyboardInterrupt
        whole(self, stage, **more)

    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(path.parent)
        patch.setattr(Pipeline, "run_stage", killed)
        with pytest.raises(KeyboardInterrupt):
            run.add(recordings["again"])
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(path.parent)
        run.add(recordings["again"])
    return run.directory


def test_added_recordings_track_no_other_again(grown: RunDir, room_run: Path) -> None:
    for stage in NAMES[:4]:
        own = grown.recording_path("room") / stage / "stage.json"
        assert own.read_bytes() == (room_run / stage / "stage.json").read_bytes()  # with the time that it took
    assert counts(grown)["room"]["located"] == counts(grown)["again"]["located"] == 40


def test_added_recordings_leave_the_world_where_it_was(grown: RunDir, room_run: Path) -> None:
    before, after = read_tum(room_run / "loop" / "trajectory.txt"), read_tum(grown.path / "loop" / "trajectory_room.txt")
    np.testing.assert_array_equal(after.T_wc[0], np.eye(4))
    assert 0.0 < np.linalg.norm(before.T_wc[:, :3, 3] - after.T_wc[:, :3, 3], axis=1).max() < 0.02


def test_an_added_recording_is_as_good_as_one_named_at_once(grown: RunDir, house: RunDir) -> None:
    rmse = [
        trajectory_error.ape(run_trajectories.stage_trajectory(run, "loop"), run_trajectories.ground_truth(run), n_frames=80, name="").rmse
        for run in (grown, house)
    ]
    assert rmse[0] == pytest.approx(rmse[1], rel=0.1)


def test_adding_what_is_there_changes_nothing_and_a_copy_of_it_is_refused(
    grown: RunDir, recordings: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    before = arrays_of(grown.path)
    api.open_run(grown.path).add(recordings["again"])
    assert arrays_of(grown.path) == before
    shutil.copytree(recordings["again"], tmp_path / "copy")
    with pytest.raises(SlamError, match="the same recording as .*again, which is in"):
        api.open_run(grown.path).add(tmp_path / "copy")


def test_a_lost_run_json_is_restored_with_its_recordings(grown: RunDir, tmp_path: Path) -> None:
    shutil.copytree(grown.path, tmp_path / "run")
    run, info = RunDir(tmp_path / "run"), grown.info()
    (run.path / "run.json").write_text("{")
    run.restore()
    assert {**run.info(), "created": ""} == {**info, "created": ""}


def test_other_settings_make_every_recording_stale(grown: RunDir) -> None:
    config = api.open_run(grown.path).status(settings={"track.min_inliers": 20})
    assert [config[stage].is_fresh for stage in ("extract", "match", "track", "loop")] == [True, True, False, False]


def test_mistakes_are_told(recordings: dict[str, Path], grown: RunDir, here: Path, slamcli: Callable) -> None:
    room, again, elsewhere = recordings.values()
    shutil.copytree(room, here / "copy")
    for arguments, message in (
        (["run", room, here / "copy", "-r", here / "h"], "the same recording as"),
        (["run", room, elsewhere, "-r", grown.path], "holds a run of other recordings"),
        (["run", room, "-r", grown.path], "or add to that map with: slamcli add"),
        (["run", room, again, "-r", here / "i", "--until", "optimize", "-s", "optimize.intrinsics=true"], "not with several recordings"),
        (["add", grown.path, here / "nowhere"], "no such recording"),
        (["eval", "ape", "-r", grown.path, "--truth", room / "groundtruth.txt"], "several clocks"),
        (["run", "-r", here / "h", room, ""], "no recording named"),
    ):
        result = slamcli(*arguments)
        assert result.exit_code == 1 and message in result.output, f"{arguments}: {result.output}"
    assert not (here / "h").exists()


def test_a_recordings_name_cannot_lead_out_of_the_run(grown: RunDir, tmp_path: Path) -> None:
    shutil.copytree(grown.path, tmp_path / "run")
    run = RunDir(tmp_path / "run")
    for name in ("../elsewhere", ".hidden", "a/b", ""):
        run._write_info({**run.info(), "recordings": [{**run.recordings[0], "name": name}]})
        with pytest.raises(SlamError, match="a recording lacks name"):
            RunDir.find(str(run.path))


def test_a_run_of_one_becomes_one_of_several_only_when_all_is_in_place(room_run: Path, tmp_path: Path) -> None:
    shutil.copytree(room_run, tmp_path / "run")
    run = RunDir(tmp_path / "run")
    (run.path / "recordings" / ".room.part").mkdir(parents=True)  # what a killed command left
    first = several.make_room(run)
    assert first == several.make_room(run) and not run.recordings
    inside = RunDir.find(str(run.recording_path("room")))
    assert {name: state.state for name, state in inside.states().items()} == {
        name: "up to date" if name in NAMES[:4] else "missing" for name in NAMES
    }
    assert set(frame_segments(inside.load(Tracks, "optimize"), inside.load(Map, "optimize"))) == {0}


def test_what_is_gone_in_a_later_recording_fades_from_every_map(tmp_path: Path) -> None:
    tiny = {"seed": 11, "movable": True}
    before, after = render(tmp_path / "before", gone_from=1.0, **tiny), render(tmp_path / "now", gone_from=0.0, start=0.01, take=1, **tiny)
    parcel = next(s for s in json.loads((before / "scene.json").read_text())["obstacles"] if s["name"] == "moved_box")
    inside = {}
    for name, targets in (("alone", [before]), ("both", [before, after])):
        run = made(targets, tmp_path / name, until="octree")
        truth, stage = run_trajectories.ground_truth(run), "loop"
        aligned = trajectory_error.ape(run_trajectories.stage_trajectory(run, stage), truth, n_frames=80, name=name)
        assert aligned.rmse < 0.02
        T_sl = aligned.T_gw @ se3.inverse(api.Run(run).ground().T_lw)
        tree = api.Run(run).octree()
        occupied = tree.centre[tree.is_occupied()]
        inside[name] = [_in_box(se3.transform(T_sl, points.astype(float)), parcel) for points in (api.Run(run).cloud()[0], occupied)]
    assert inside["alone"][0] > 200 and inside["alone"][1] > 20
    assert inside["both"][0] < 0.1 * inside["alone"][0] and inside["both"][1] < 0.1 * inside["alone"][1]


def _in_box(x: np.ndarray, solid: dict) -> int:
    """Count the points well above the floor within a solid of scene.json, a little of its outside included."""
    c, s = np.cos(solid["yaw"]), np.sin(solid["yaw"])
    local = (x - solid["centre"]) @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    half = np.array(solid["size"]) / 2 + 0.02
    return int((np.abs(local) < half).all(axis=1)[x[:, 2] > 0.1].sum())


def test_cleaning_takes_the_recordings_own_runs_and_leaves_each_ones_trajectory(grown: RunDir, slamcli: Callable, tmp_path: Path) -> None:
    shutil.copytree(grown.path, tmp_path / "run")
    freed = json.loads(slamcli("clean", "--keep", "results", "-r", tmp_path / "run", "--json").stdout)["freed"]
    assert list(freed) == [*NAMES[:4], "recordings"] and not (tmp_path / "run" / "recordings").exists()
    assert slamcli("export-trajectory", tmp_path / "t.txt", "--recording", "again", "-r", tmp_path / "run").exit_code == 0
    assert (tmp_path / "t.txt").read_bytes() == (grown.path / "loop" / "trajectory_again.txt").read_bytes()
