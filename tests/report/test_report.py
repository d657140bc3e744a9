"""The page holds what the run holds, needs nothing else, and lets no text from outside become markup."""

import dataclasses
import json
import re
import shutil
import subprocess
from collections.abc import Callable
from html.parser import HTMLParser
from pathlib import Path

import finished
import numpy as np
import pytest
from click.testing import Result

from slamcli import files
from slamcli.evaluation import map_verdict
from slamcli.evaluation.run_content import collect
from slamcli.report import make, pictures, remarks
from slamcli.report.page import PAUSE, render
from slamcli.runs.run_directory import RunDir
from slamcli.schema import Grid
from slamcli.slam import doubt

Command = Callable[..., Result]
LARGEST = 15e6  # bytes
CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
VOID = {"meta", "link", "img", "br", "hr", "input"}


class Page(HTMLParser):
    """Check that tags nest; collect what the page would load and the data it draws."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.loads: list[str] = []
        self.images = 0
        self.text = ""
        self.feed(text)
        self.close()
        assert not self.open, f"not closed: {self.open}"
        self.data = json.loads(re.search(r'<script id="data" type="application/json">(.*?)</script>', text, re.S).group(1))

    def handle_starttag(self, tag: str, attrs: list) -> None:
        self.loads += [value for name, value in attrs if name in ("src", "href", "srcset", "data", "action")]
        self.images += tag == "img"
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if self.open and self.open[-1] not in ("script", "style"):
            self.text += data


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> finished.Finished:
    return finished.make(tmp_path_factory.mktemp("finished"))


def page_of(slamcli: Command, run: Path, out: Path) -> Page:
    result = slamcli("report", "-r", run, "-o", out)
    assert result.exit_code == 0, result.stderr
    assert result.stdout.strip() == str(out)
    text = out.read_text()
    assert len(text) < LARGEST
    assert "http:" not in text
    assert "https:" not in text
    page = Page(text)
    assert all(value.startswith("data:") for value in page.loads)
    return page


def test_page_of_a_run(slamcli: Command, made: finished.Finished, tmp_path: Path) -> None:
    page = page_of(slamcli, made.run, tmp_path / "report.html")
    assert [len(page.data[key]) for key in ("time", "state", "inliers", "features", "error")] == [90] * 5
    assert [i for i, x in enumerate(page.data["position"][0]) if x is None] == np.flatnonzero(made.lost).tolist()
    assert [i for i, e in enumerate(page.data["error"]) if e is None] == np.flatnonzero(made.lost).tolist()
    assert page.data["loops"] == [[86, 0]]  # the last key frame saw the first one's place again
    assert "84 of 90 frames located" in page.text
    assert "6 of 90 frames are lost" in page.text
    assert "The floor was found" in page.text
    for stage in ("track", "optimize", "loop"):
        assert stage in page.text
    assert "grid2d has not been run" in page.text


def test_truth_lies_on_the_estimate(slamcli: Command, made: finished.Finished, tmp_path: Path) -> None:
    page = page_of(slamcli, made.run, tmp_path / "report.html")
    truth, position = np.array(page.data["truth"]).T, np.array(page.data["position"], dtype=float).T
    nearest = np.linalg.norm(position[~made.lost][:, None] - truth[None], axis=2).min(axis=1)
    assert 0.0 < np.sqrt((nearest**2).mean()) < 0.01


def test_page_goes_to_the_run_by_default(slamcli: Command, tmp_path: Path) -> None:
    made = finished.make(tmp_path, frames=30, n_lost=0)
    assert slamcli("report", "-r", made.run).exit_code == 0
    assert (made.run / "report.html").stat().st_size > 10_000


@pytest.mark.parametrize("until", ["track", "optimize", "loop"])
def test_unfinished_run(slamcli: Command, tmp_path: Path, until: str) -> None:
    made = finished.make(tmp_path, until=until, frames=30, n_lost=0)
    page = page_of(slamcli, made.run, tmp_path / "report.html")
    assert "All 30 frames have a pose" in page.text
    assert "densify has not been run" in page.text


def test_nothing_tracked_yet(slamcli: Command, tmp_path: Path) -> None:
    made = finished.make(tmp_path, until="match", frames=30, n_lost=0)
    result = slamcli("report", "-r", made.run)
    assert result.exit_code == 1
    assert "slamcli run --until track" in result.stderr


def test_without_ground_truth_and_without_the_recording(slamcli: Command, tmp_path: Path) -> None:
    made = finished.make(tmp_path, with_truth=False, frames=30, n_lost=0)
    page = page_of(slamcli, made.run, tmp_path / "report.html")
    assert page.data["error"] == []
    assert "has no ground truth" in page.text
    shutil.rmtree(made.recording)
    page = page_of(slamcli, made.run, tmp_path / "report.html")
    assert "the recording is not there any more" in page.text


def test_text_from_outside_stays_text(slamcli: Command, tmp_path: Path) -> None:
    evil = "</script><script>document.title='hit'</script><img src=x onerror=alert(1)>"
    made = finished.make(tmp_path, frames=30, n_lost=0)
    for name, change in (
        ("run.json", {"dataset": evil}),
        ("track/stage.json", {"warnings": [evil], "summary": {"frames": 30, evil: evil}}),
    ):
        files.write_sealed(made.run / name, {**files.read_sealed(made.run / name), **change})
    page = page_of(slamcli, made.run, tmp_path / "report.html")
    assert page.images == 3  # the cloud, a frame with its features, and the empty one that enlarges them
    assert page.text.count("onerror=alert(1)") >= 3


def test_remarks_are_sorted_by_gravity_and_name_what_is_wrong(made: finished.Finished) -> None:
    content = collect(RunDir.find(str(made.run)))
    kinds = [remark.kind for remark in remarks.collect(content)]
    assert kinds == sorted(kinds, key=(remarks.BAD, remarks.NOTE, remarks.GOOD).index)
    texts = " ".join(remark.text for remark in remarks.collect(content))
    assert "fewer than 150 features" in texts  # the fake run has none at all


def test_frames_of_other_map_segments_are_told_of(made: finished.Finished) -> None:
    content = collect(RunDir.find(str(made.run)))
    T_lc = content.T_lc.copy()
    T_lc[-7:] = np.nan  # not lost, but in a frame of their own
    texts = " ".join(remark.text for remark in remarks.collect(dataclasses.replace(content, T_lc=T_lc)))
    assert f"7 of {len(T_lc)} frames belong to map segments that could not be joined" in texts
    assert "belong to map segments" not in " ".join(remark.text for remark in remarks.collect(content))


def test_findings_on_the_recording_are_on_the_page_and_looked_for_once(slamcli: Command, tmp_path: Path) -> None:
    made = finished.make(tmp_path, frames=30, n_lost=0)
    assert "have no reading" not in page_of(slamcli, made.run, tmp_path / "report.html").text
    kept = files.read_sealed(made.run / "inspection.json")
    kept["findings"] = [{"level": "error", "check": "holes", "message": "no <depth> at all", "advice": "look at the lens"}]
    files.write_sealed(made.run / "inspection.json", kept)
    assert "Recording: no <depth> at all: look at the lens" in page_of(slamcli, made.run, tmp_path / "report.html").text
    files.write_sealed(made.run / "inspection.json", {**kept, "digest": "of another recording"})
    assert "no <depth> at all" not in page_of(slamcli, made.run, tmp_path / "report.html").text
    (made.run / "inspection.json").write_text(json.dumps(kept))  # another file than the one that was written: not believed
    assert "no <depth> at all" not in page_of(slamcli, made.run, tmp_path / "report.html").text
    assert files.read_sealed(made.run / "inspection.json")["findings"] != kept["findings"]
    assert slamcli("report", "-r", made.run, "--no-inspect").exit_code == 0


def test_a_page_that_cannot_be_written_names_the_users_file(slamcli: Command, made: finished.Finished, tmp_path: Path) -> None:
    result = slamcli("report", "-r", made.run, "--no-inspect", "-o", tmp_path / "nowhere" / "page.html")
    assert result.exit_code == 1
    assert f"{tmp_path / 'nowhere' / 'page.html'}: cannot be written" in result.stderr


def test_a_map_of_no_use_is_told_in_amber_with_the_cause(made: finished.Finished, room_run: Path) -> None:
    content = collect(RunDir.find(str(room_run)))
    assert content.verdict is not None
    first = remarks.collect(content)
    assert any(r.kind == remarks.NOTE and r.text.startswith("A robot could not use this map: floor seen in 0 of 40 views") for r in first)
    good = map_verdict.judge(dataclasses.replace(content.verdict.evidence, is_floor_found=True, views_with_floor=30, free_area=9.0, path_known=0.9), max_range=4.0)  # fmt: skip
    told = remarks.collect(dataclasses.replace(content, verdict=good))
    assert any(r.kind == remarks.GOOD and r.text.startswith("A robot can use the map: 9.0 m2 of free floor") for r in told)


def test_example_route_stays_in_the_largest_free_region() -> None:
    state = np.full((60, 80), 1, np.int8)
    state[5:55, 5:60] = 0
    state[5:15, 65:75] = 0  # nearer to the camera, but too small
    grid = Grid(
        p_occupied=np.zeros((60, 80), np.float32),
        n_seen=np.ones((60, 80), np.int32),
        state=state,
        origin=np.zeros(2),
        resolution=np.array(0.05),
    )
    route = pictures.example_route(grid, np.array([[3.5, 0.5, 0.0]]))
    assert route.xy[:, 0].max() < 3.0
    assert route.length > 2.0
    blocked = Grid(grid.p_occupied, grid.n_seen, np.ones_like(state), grid.origin, grid.resolution)
    assert pictures.example_route(blocked, np.array([[3.5, 0.5, 0.0]])) is None


def test_page_with_maps(room_run: Path, tmp_path: Path) -> None:
    make(RunDir.find(str(room_run)), tmp_path / "report.html")
    text = (tmp_path / "report.html").read_text()
    page = Page(text)
    assert page.images == 5
    assert "Not drawn" not in page.text
    assert len(text) < LARGEST


@pytest.mark.skipif(CHROMIUM is None, reason="needs chromium")
def test_page_runs_in_a_browser_without_complaint(slamcli: Command, made: finished.Finished, tmp_path: Path) -> None:
    page_of(slamcli, made.run, tmp_path / "report.html")
    done = "<script>console.log('charts ' + document.querySelectorAll('#charts canvas').length)</script></body>"
    text = (tmp_path / "report.html").read_text().replace("</body>", done)
    (tmp_path / "report.html").write_text(text)
    flags = ["--headless", "--no-sandbox", "--disable-gpu", "--enable-logging=stderr", f"--user-data-dir={tmp_path / 'profile'}"]
    command = [CHROMIUM, *flags, f"--screenshot={tmp_path / 'page.png'}", "--window-size=1300,1600", (tmp_path / "report.html").as_uri()]
    said = subprocess.run(command, capture_output=True, text=True, timeout=120, check=True).stderr
    messages = [line for line in said.splitlines() if "CONSOLE" in line]
    assert len(messages) == 1
    assert "charts 2" in messages[0]  # the fake run has no features in any frame: a constant is no chart


def test_recordings_follow_one_another_without_the_way_between_them(made: finished.Finished) -> None:
    """Three of them, an hour apart: charts show no hour, and neither the path nor its length has the jumps between them."""
    one = collect(RunDir(made.run))
    n = len(one.stamp)
    T_lc = np.tile(one.T_lc, (3, 1, 1))
    T_lc[n : 2 * n, 0, 3] += 100.0  # [m]
    per_frame = {name: np.tile(getattr(one, name), 3) for name in ("state", "n_inliers", "n_features", "is_doubtful")}
    stamp = np.concatenate([one.stamp + 3600.0 * k for k in range(3)])
    starts = n * np.arange(3)
    content = dataclasses.replace(one, stamp=stamp, T_lc=T_lc, starts=starts, names=["a", "b", "c"], ape={}, ape_of=[], **per_frame)
    data = Page(render(content, [])).data
    time = np.array(data["time"])
    span = one.stamp[-1] - one.stamp[0]
    assert (np.diff(time) > 0.0).all() and time[-1] == pytest.approx(3 * span + 2 * PAUSE, abs=1e-3)
    np.testing.assert_allclose(np.diff(time)[: n - 1], np.diff(one.stamp), atol=2e-4)
    assert data["starts"] == starts.tolist() and data["names"] == ["a", "b", "c"]
    assert content.seconds == pytest.approx(3 * span)
    assert np.isnan(content.path[:, 0]).sum() == 2 and len(content.path) == 3 * len(one.path) + 2
    length = [float(re.search(r"along ([0-9.]+) m", remarks.headline(each)).group(1)) for each in (one, content)]
    assert length[1] == pytest.approx(3 * length[0], abs=0.21)


def test_the_page_does_not_send_its_reader_to_itself(made: finished.Finished) -> None:
    content = collect(RunDir(made.run))
    found = doubt.Finding("poses", f"3 of 9 poses are doubtful{doubt.SEE_REPORT}")
    loop = content.states["loop"]
    record = {**loop.record, "summary": doubt.joined(loop.record["summary"], [found])}
    said = remarks.collect(dataclasses.replace(content, states={**content.states, "loop": dataclasses.replace(loop, record=record)}))
    (text,) = (remark.text for remark in said if "3 of 9 poses are doubtful" in remark.text)
    assert "amber in the charts" in text and "report" not in text
