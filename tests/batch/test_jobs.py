"""What a batch is to do, and its table."""

import csv
import errno
import io
import os
import platform
import time
from pathlib import Path

import pytest

from slamcli.batch import figures, jobs, storage
from slamcli.batch.jobs import Order
from slamcli.errors import SlamError
from slamcli.stages import NAMES


@pytest.mark.parametrize(
    "recordings, names",
    [
        (["/data/a", "/data/b"], ["a", "b"]),
        (["/monday/scan", "/tuesday/scan", "/data/b"], ["monday-scan", "tuesday-scan", "b"]),
        (["s3://bucket/walk.mcap", "tum/fr1_room", "demo"], ["walk.mcap", "fr1_room", "demo"]),
        (["/x/scan", "/y/x/scan", "s3://x/scan"], None),
        (["/data/..hidden ü", "/"], None),
        (["/x/a b", "/x/a_b", "/recording1", "/recording0"], ["recording2", "recording3", "recording1", "recording0"]),
        (["/x/" + "n" * 199, "/y/" + "n" * 199, "/z/" + "m" * 201], ["recording0", "recording1", "recording2"]),
        (["s3://" + "a/" * 2_000_000, "s3://b/" + "a/" * 2_000_000], ["recording0", "recording1"]),
    ],
)
def test_runs_are_named_after_recordings_and_never_alike(recordings: list[str], names: list[str] | None) -> None:
    found = jobs.names(recordings)
    assert names is None or found == names
    assert len(set(found)) == len(recordings)
    assert all(name and "/" not in name and not name.startswith(".") for name in found)


def test_a_list_has_a_recording_a_line_and_comments(here: Path) -> None:
    (here / "room").mkdir()
    (here / "list.txt").write_text("# this week\nroom   # the first\n\ntum/fr1_xyz\ns3://bucket/walk/\n")
    found = jobs.jobs(["list.txt", "demo"], Order(out="/runs"))
    assert [job.recording for job in found] == [str(here / "room"), "tum/fr1_xyz", "s3://bucket/walk", "demo"]
    assert found[0].run == "/runs/room"
    assert found[0].stages == NAMES


def test_a_long_list_is_named_in_a_time_that_grows_with_it() -> None:
    start = time.process_time()
    found = jobs.names([f"/data/{k // 2}/part{k % 2}" for k in range(50_000)])
    assert found[-1] == "24999-part1" and len(set(found)) == 50_000
    assert time.process_time() - start < 5.0


@pytest.mark.parametrize(
    "given, message",
    [
        (["demo", "demo"], "named twice"),
        (["empty.txt"], "no recording"),
        (["./a", "a"], "named twice"),
        (["long.txt"], "100001 recordings: a batch has at most 100000"),
    ],
)
def test_what_is_no_batch_is_said(here: Path, given: list[str], message: str) -> None:
    (here / "empty.txt").write_text("# nothing\n")
    (here / "long.txt").write_text("".join(f"room{k}\n" for k in range(100_001)))
    (here / "a").mkdir()
    with pytest.raises(SlamError, match=message):
        jobs.jobs(given, Order(out="/runs"))


def test_stages_end_where_the_order_says() -> None:
    (job,) = jobs.jobs(["demo"], Order(out="s3://bucket/runs", until="track"))
    assert job.stages == ("extract", "match", "track")
    assert job.run == "s3://bucket/runs/demo"


def test_the_marker_is_there_for_the_time_of_the_batch(here: Path) -> None:
    with jobs.prepared(Order(out=str(here / "runs"))) as order:
        assert (here / "runs" / order.marker).is_file()
    assert list((here / "runs").iterdir()) == []


def test_no_marker_is_left_of_a_batch_for_which_the_disk_had_no_room(here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def no_room() -> str:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(jobs.platform, "node", no_room)
    with (
        pytest.raises(SlamError, match=r"runs/\.batch-\w+: cannot be written \(No space left"),
        jobs.prepared(Order(out=str(here / "runs"))),
    ):
        pass
    assert list((here / "runs").iterdir()) == []


def test_a_url_without_its_package_names_the_package() -> None:
    with pytest.raises(SlamError, match=r"nowhere://a/b: "):
        storage.connect("nowhere://a/b")


ROWS = [
    {"recording": "a", "run": "/r/a", "state": "done", "reason": "", "frames": 40, "coverage": 0.975, "ape_m": 0.00412, "seconds": 8.0,
     "cpu_seconds": 12.0, "peak_mib": 300.5, "output_mb": 4.2, "warnings": 1, "doubt": "Lost, \"often\"", "closures": 1},
    {"recording": "<script>", "run": "/r/b", "state": "failed", "reason": "rgb.txt: not\nthere"},
]  # fmt: skip


def test_the_csv_reads_back(here: Path) -> None:
    read = list(csv.DictReader(io.StringIO(figures.as_csv(ROWS))))
    assert [row["state"] for row in read] == ["done", "failed"]
    assert read[0]["doubt"] == 'Lost, "often"' and float(read[0]["ape_m"]) == 0.00412
    assert read[1]["reason"] == "rgb.txt: not\nthere" and read[1]["coverage"] == ""


def test_the_page_escapes_what_comes_from_outside_counts_and_puts_failures_first() -> None:
    page = figures.as_page(ROWS)
    assert "<script>" not in page and "&lt;script&gt;" in page
    assert "2 recordings: 1 done, 1 failed, 1 to doubt" in page
    assert page.index("&lt;script&gt;") < page.index("Lost, ")
    assert "97.5%" in page and "0.0041" in page


def test_lines_tell_what_became_of_a_recording() -> None:
    assert figures.as_line(ROWS[0]) == "a: done, 97.5% of 40 frames, APE 0.0041 m, 12.0 s of CPU time, to doubt"
    assert figures.as_line(ROWS[1]).startswith("<script>: failed: rgb.txt: not")


def test_markers_of_the_dead_go_and_those_of_the_living_and_of_others_stay(here: Path) -> None:
    order, out = Order(out=str(here / "runs")), here / "runs"
    out.mkdir()
    (out / ".batch-dead").write_text(platform.node())
    (out / ".batch-elsewhere").write_text("another machine")
    with jobs.prepared(order) as one, jobs.prepared(order) as two:
        assert {path.name for path in out.iterdir()} == {one.marker, two.marker, ".batch-elsewhere"}
    assert [path.name for path in out.iterdir()] == [".batch-elsewhere"]


def test_a_list_that_is_a_pipe_is_not_waited_for(here: Path) -> None:
    os.mkfifo(here / "list.txt")
    with pytest.raises(SlamError, match="list.txt: not a regular file"):
        storage.read_text(str(here / "list.txt"))
