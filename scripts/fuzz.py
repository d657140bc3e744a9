#!/usr/bin/env python
"""Feed every parser mutated files and report whatever is neither a result nor a SlamError within bounded time and memory.

    python scripts/fuzz.py [PARSER]... [--inputs 100000] [--seed 0] [--keep FOLDER] [--atheris]

Each input is a good file with a few seeded mutations, so a run can be repeated; --atheris lets that package steer them by coverage instead
(one PARSER, until interrupted). Inputs that failed are written to FOLDER. Exit status 1 where there was one.
"""

import argparse
import contextlib
import gzip
import io
import json
import os
import random
import resource
import shutil
import signal
import sys
import tarfile
import tempfile
import time
import traceback
import warnings
import zipfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from slamcli import artifacts, files
from slamcli.batch import jobs
from slamcli.cli.grid import kept_out
from slamcli.config import toml
from slamcli.config.options import Config
from slamcli.console import silent, stage_line
from slamcli.datasets import download, images, open_dataset
from slamcli.datasets.intrinsics import read_camera_file
from slamcli.datasets.lists import read_list, read_pairs
from slamcli.datasets.simulate import read_stamps
from slamcli.errors import SlamError
from slamcli.evaluation import grid_truth
from slamcli.formats import cloud, dbow2, g2o, grid_map, mask, octomap, rvl, trajectory, vocabulary_file
from slamcli.geometry.camera import Camera
from slamcli.geometry.octree import Octree
from slamcli.runs import damage, housekeeping, summary
from slamcli.runs.run_directory import RunDir
from slamcli.schema import Closures, Grid, Trajectory
from slamcli.slam import doubt
from slamcli.stages import NAMES, stage_named
from slamcli.vision import vocabulary

SECONDS = 5.0  # of CPU that one input may take,
WAITED = 20  # and times as long by the clock, so that a busy machine is no fault and a wait without end is one
MEMORY = 1 << 30  # bytes that one input may reserve
SIZE = (8, 6)  # px of the pictures
WORDS = (
    b"0", b"-1", b"1e999", b"nan", b"inf", b"-0.0", b"9" * 20, b"9" * 400, b"9" * 5000, b"18446744073709551616", b"\x00", b"\xff" * 8, b"\n", b" ", b",", b"../../etc/passwd",
    b"/dev/zero", b"~nouser/x", b"[" * 200, b"{", b'"', b"a.b." * 40, b"\xef\xbb\xbf", b"#", b"e", b"0x" + b"f" * 99, b"\x80\x00\x00\x00", b"\x7f\xff\xff\xff",
)  # fmt: skip


@dataclass(frozen=True)
class Parser:
    """A parser and the good files to begin with."""

    name: str  # of the file it reads
    seeds: tuple[bytes, ...]
    read: Callable[[Path], object]
    others: tuple[tuple[str, bytes], ...] = ()  # files that are read along with it, in whose place a mutated one is put as often


def main() -> int:
    """Fuzz the parsers named, all of them by default."""
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("parsers", nargs="*", metavar="PARSER")
    options.add_argument("--inputs", type=int, default=100_000, help="mutated files for each parser [100000]")
    options.add_argument("--seed", type=int, default=0)
    options.add_argument("--keep", type=Path, help="folder for the inputs that failed")
    options.add_argument("--atheris", action="store_true", help="let atheris steer the mutations of one parser")
    given = options.parse_args()
    warnings.simplefilter("ignore")
    n_failures = 0
    with tempfile.TemporaryDirectory(dir="/dev/shm" if Path("/dev/shm").is_dir() else None) as folder:
        known = {**parsers(), **recordings(Path(folder) / "recordings"), **runs(Path(folder) / "runs")}
        if unknown := set(given.parsers) - known.keys():
            options.error(f"no such parser: {', '.join(sorted(unknown))}; there are {', '.join(known)}")
        said, mute = os.fdopen(os.dup(2), "w"), os.open(os.devnull, os.O_WRONLY)
        os.dup2(mute, 2)  # libpng and its like tell of every fault
        for name in given.parsers or known:
            if given.atheris:
                steer(known[name], Path(folder))
            attempt(known[name], Path(folder), known[name].seeds[0], bound=contextlib.nullcontext)  # compiles its kernels
            tried = Tally()
            held = reset_peak()
            for failure in fuzz(known[name], Path(folder), inputs=given.inputs, seed=given.seed, tally=tried):
                n_failures += 1
                print(failure.told, file=said, flush=True)
                if given.keep:
                    given.keep.mkdir(parents=True, exist_ok=True)
                    (given.keep / f"{name}-{failure.number}").write_bytes(failure.data)
            print(
                f"{name:<22}{tried.read:>8} read {tried.refused:>8} refused {tried.failed:>6} failed"
                f"   slowest {tried.slowest:.2f} s, together {tried.seconds:.0f} s   at most {(peak() - held) >> 20} MiB more",
                flush=True,
            )
    return 1 if n_failures else 0


@dataclass
class Tally:
    """What became of the inputs."""

    read = refused = failed = 0
    slowest = seconds = 0.0  # of CPU


@dataclass(frozen=True)
class Failure:
    """An input that ended in neither a result nor a SlamError."""

    number: int
    data: bytes
    told: str


def reset_peak() -> int:
    """Forget how much memory this process once held; returns how many bytes it holds."""
    Path("/proc/self/clear_refs").write_text("5")
    return peak()


def peak() -> int:
    """Return how many bytes of memory this process held at most."""
    return 1024 * next(int(line.split()[1]) for line in Path("/proc/self/status").read_text().splitlines() if line.startswith("VmHWM"))


def fuzz(parser: Parser, folder: Path, *, inputs: int, seed: int, tally: Tally) -> Iterator[Failure]:
    """Try so many inputs; yields the failures, one of each kind."""
    rng, seen = random.Random(f"{seed} {parser.name}"), set()
    targets = [(parser.name, parser.seeds), *((name, (good,)) for name, good in parser.others)]
    for number in range(inputs):
        name, seeds = rng.choice(targets)
        data = mutated(rng, seeds)
        started = time.process_time()
        error = attempt(parser, folder, data, name=name)
        took = time.process_time() - started
        if parser.others:
            (folder / name).write_bytes(seeds[0])
        tally.slowest, tally.seconds = max(tally.slowest, took), tally.seconds + took
        if error is None:
            tally.read += 1
        elif isinstance(error, SlamError):
            tally.refused += 1
        else:
            tally.failed += 1
            frames = traceback.extract_tb(error.__traceback__)
            ours = [frame for frame in frames if f"{os.sep}slamcli{os.sep}" in frame.filename] or frames
            kind = (type(error).__name__, ours[-1].filename, ours[-1].lineno)
            if kind not in seen:
                seen.add(kind)
                yield Failure(
                    number, data, f"{name} {number}: {type(error).__name__}: {str(error)[:200]} at {Path(kind[1]).name}:{kind[2]}"
                )


def attempt(parser: Parser, folder: Path, data: bytes, *, name: str = "", bound: Callable | None = None) -> BaseException | None:
    """Read one input within the bounds, in the place of the file `name`, the parser's first by default; returns what was raised."""
    path = folder / (name or parser.name)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(data)
    try:
        with (bound or bounded)():
            parser.read(path)
    except Exception as error:
        return error
    return None


class TooSlowError(Exception):
    """An input took longer than it may."""


@contextlib.contextmanager
def bounded() -> Iterator[None]:
    """Bound time and address space of what happens within."""

    def late(number: int, frame: object) -> None:
        raise TooSlowError(f"more than {SECONDS} s of CPU" if number == signal.SIGPROF else f"more than {WAITED * SECONDS} s")

    pages = int(Path("/proc/self/statm").read_text().split()[0])
    limit = resource.getrlimit(resource.RLIMIT_AS)
    before = {number: signal.signal(number, late) for number in (signal.SIGPROF, signal.SIGALRM)}
    signal.setitimer(signal.ITIMER_PROF, SECONDS)
    signal.setitimer(signal.ITIMER_REAL, WAITED * SECONDS)
    resource.setrlimit(resource.RLIMIT_AS, (pages * resource.getpagesize() + MEMORY, limit[1]))
    try:
        yield
    finally:
        for timer in (signal.ITIMER_PROF, signal.ITIMER_REAL):
            signal.setitimer(timer, 0)
        for number, handler in before.items():
            signal.signal(number, handler)
        resource.setrlimit(resource.RLIMIT_AS, limit)


def mutated(rng: random.Random, seeds: Sequence[bytes]) -> bytes:
    """Change a good file in a few places, mostly few."""
    data = bytearray(rng.choice(seeds))
    for _ in range(rng.choice((1, 1, 1, 2, 3, 8))):
        at = rng.randrange(len(data) + 1)
        to = min(len(data), at + rng.choice((1, 1, 2, 4, 8, 64, len(data))))
        match rng.randrange(8):
            case 0:
                data[at:to] = rng.choice(WORDS)
            case 1:
                del data[at:to]
            case 2:
                data[at:at] = data[at:to] * rng.choice((1, 2, 50))
            case 3:
                data[at:to] = rng.randbytes(to - at) if to - at <= 64 else bytes(to - at)
            case 4 if at < len(data):
                data[at] ^= 1 << rng.randrange(8)
            case 5:
                other = rng.choice(seeds)
                data[at:] = other[rng.randrange(len(other) + 1) :]
            case 6:
                data[at:to] = word_like(rng, bytes(data[at:to]))
            case _:
                lines = data.split(b"\n")
                rng.shuffle(lines)
                data = bytearray(b"\n".join(lines))
    return bytes(data[: 1 << 20])


def word_like(rng: random.Random, text: bytes) -> bytes:
    """Put another number in the place of a number."""
    return str(rng.choice((0, 1, -1, 2**31, 2**63, 2**64, -(2**31), 1e300, 1e-300, 0.5, rng.randrange(10**6)))).encode() or text


def parsers() -> dict[str, Parser]:
    """Make a small good file of every format that is read, with its parser."""
    rng = np.random.default_rng(0)
    xyz, rgb = rng.random((5, 3), dtype=np.float32), rng.integers(0, 255, (5, 3), dtype=np.uint8)
    tree = Octree(0.05, np.arange(5) * 8, np.full(5, 15, np.uint8), rng.random(5, dtype=np.float32))
    words = vocabulary.from_parents(
        np.array([0, 0, 1, 1, 2, 2], np.int32), rng.integers(0, 255, (6, 32), dtype=np.uint8), np.ones(6), origin="x", source=""
    )
    poses = Trajectory(np.arange(4.0), np.tile(np.eye(4), (4, 1, 1)))
    edges = (np.array([[1, 0], [2, 1]]), np.tile(np.eye(4), (2, 1, 1)), np.tile(np.eye(6), (2, 1, 1)))
    state = grid_map.GridMap(rng.integers(-1, 2, (4, 5)).astype(np.int8), (0.5, -1.0), 0.05)
    unknown = np.full((4, 5), np.nan, np.float32)
    cells = Grid(
        state=state.state, origin=np.array(state.origin), resolution=np.array(0.05), n_seen=np.zeros((4, 5), np.int32), p_occupied=unknown
    )
    camera = Camera(width=8, height=6, fx=8.0, fy=8.0, cx=4.0, cy=3.0)
    tum_list = b"# stamp file\n1.0 rgb/1.png\n2.0 rgb/2.png\n3.5 rgb/3.png\n"
    pairs = b"1.0 rgb/1.png 1.01 depth/1.png\n2.0 rgb/2.png 2.01 depth/2.png\n"
    closures = Closures(np.array([[1, 0], [2, 1]], np.int32), np.tile(np.eye(4), (2, 1, 1)), np.zeros(2, np.int32), np.zeros(2, np.float32))

    def page(path: Path) -> object:
        if not (path.parent / "map.pgm").exists():
            grid_map.write(path.parent / "map.pgm", state)
        return grid_map.read(path)

    def record(path: Path) -> object:
        artifacts.save(closures, fresh(path.parent / "record"))
        shutil.copy(path, path.parent / "record" / "closure_T_ij.npy")
        return artifacts.load(Closures, path.parent / "record")

    def intrinsics(path: Path) -> object:
        values, _, _ = read_camera_file(path)
        return Camera.from_dict(values, source=str(path))

    def sections(path: Path) -> object:
        return toml.dump(toml.read(path))

    def assignment(path: Path) -> object:
        return toml.dump(toml.apply(Config(), [path.read_bytes().decode(errors="replace")]))

    def picture(path: Path) -> object:
        data = images.read_bytes(path)
        return images.decode_grey(data, SIZE, name="x"), images.decode_depth(data, SIZE, name="x")

    def keep_out(path: Path) -> object:
        return kept_out(cells, path)

    def unpacked(path: Path) -> object:
        if path.suffix == ".tar":
            path = path.with_suffix(".gz")
            path.write_bytes(gzip.compress(path.with_suffix(".tar").read_bytes(), compresslevel=1))
        shutil.rmtree(path.parent / "room", ignore_errors=True)
        return download.unpack(path, path.parent / "room", progress=silent)

    def scene(path: Path) -> object:
        room = grid_truth.read_scene(path)
        grid_truth.cast(room, np.zeros(3), np.eye(3))
        return room.occupied(np.zeros((4, 2)), 0.1, 0.5)

    return {
        "config": Parser("config.toml", (toml.dump(Config()).encode(), b"[camera]\nfx = 500.0\n[extract]\nfeatures = 700\n"), sections),
        "assignment": Parser("assignment", (b"track.min_inliers=20", b"match.vocabulary=\"words.npz\"", b"optimize.enabled=false"), assignment),
        "run_config": Parser("config.toml", written("config.toml", lambda path: damage.write_config(path, Config())), damage.read_config),
        "sealed": Parser("run.json", written("run.json", lambda path: files.write_sealed(path, {"a": [1, 2.5, None], "b": {"c": "d"}})), files.read_sealed),
        "camera_json": Parser("camera.json", (json.dumps(camera.to_dict(), indent=1).encode(),), intrinsics),
        "camera_toml": Parser("camera.toml", (b"width = 8\nheight = 6\nfx = 8.0\nfy = 8.0\ncx = 4.0\ncy = 3.0\nk1 = 0.1\ndepth_scale = 5000.0\n",), intrinsics),
        "list": Parser("rgb.txt", (tum_list, tum_list.replace(b" ", b","), b"\xef\xbb\xbf" + tum_list), read_list),
        "associations": Parser("associations.txt", (pairs,), read_pairs),
        "trajectory": Parser("t.txt", written("t.txt", lambda path: trajectory.write_tum(path, poses)), trajectory.read_tum),
        "ply": Parser("c.ply", (*written("c.ply", lambda path: cloud.write_ply(path, xyz, rgb)), ASCII_PLY), cloud.read_ply),
        "pcd": Parser("c.pcd", (*written("c.pcd", lambda path: cloud.write_pcd(path, xyz, rgb)), ASCII_PCD), cloud.read_pcd),
        "ot": Parser("m.ot", written("m.ot", lambda path: octomap.write_ot(path, tree)), octomap.read),
        "bt": Parser("m.bt", written("m.bt", lambda path: octomap.write_bt(path, tree)), octomap.read),
        "g2o": Parser("p.g2o", written("p.g2o", lambda path: g2o.write_g2o(path, np.tile(np.eye(4), (3, 1, 1)), *edges)), g2o.read_g2o),
        "grid_page": Parser("map.yaml", written("map.yaml", lambda path: grid_map.write(path.with_suffix(".pgm"), state)), page),
        "pgm": Parser("picture.pgm", written("picture.pgm", lambda path: grid_map.write(path, state)), grid_map.read_pgm),
        "vocabulary": Parser("v.npz", written("v.npz", lambda path: vocabulary_file.write(path, words)), vocabulary_file.read),
        "dbow2": Parser("v.txt", written("v.txt", lambda path: dbow2.write(path, dbow2.Tree(2, 2, words.parent, words.centre[1:], words.node_weight))), read_dbow2),
        "npy": Parser("x.npy", written("closure_T_ij.npy", lambda path: artifacts.save(closures, path.parent)), record),
        "scene": Parser("scene.json", (json.dumps(SCENE, indent=1).encode(),), scene),
        "stamps": Parser("stamps.txt", (b"# colour depth\n1.0 1.01\n1.04 1.05\n", b"1 2\n3 4\n"), read_stamps),
        "batch_list": Parser("week.txt", (b"# this week\n/data/monday\n/data/b/monday  # again\ndemo\ns3://bucket/a/b\n",), lambda path: jobs.jobs([str(path)], jobs.Order(out="/runs"))),
        "archive": Parser("run.zip", (packed("run/track/stage.json", "run/run.json"),), housekeeping.stages_in),
        "tar": Parser("room.tar", (tarred("room/rgb.txt", "room/rgb/1.png"),), unpacked),
        "tgz": Parser("room.tgz", (gzip.compress(tarred("room/rgb.txt", "room/rgb/1.png")),), unpacked),
        "keep_out": Parser("areas.json", (b"[[[0, -0.5], [0.1, -0.9], [0.2, -0.7]], [[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0, 1]]]",), keep_out),
        "mask": Parser("mask", tuple(encoded(kind, rng, depth=False) for kind in (".png", ".bmp")), lambda path: mask.read_mask(path, SIZE[::-1])),
        "rvl": Parser("rvl", (rvl.encode(rng.integers(0, 3, SIZE[::-1]) * rng.integers(500, 3000, SIZE[::-1])),), lambda path: rvl.decode(path.read_bytes(), *SIZE)),
        "image": Parser("picture", tuple(encoded(kind, rng) for kind in (".png", ".jpg", ".tiff", ".bmp", ".gif", ".pgm", ".exr")), picture),
    }  # fmt: skip


def recordings(folder: Path) -> dict[str, Parser]:
    """Make a recording of two frames in every layout that can be written here; one of its files is mutated, each as often as the others."""
    sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
    import layouts  # writers that are independent of our readers

    rng = np.random.default_rng(0)
    camera = {"width": 8, "height": 6, "fx": 8.0, "fy": 8.0, "cx": 4.0, "cy": 3.0, "depth_scale": 1000.0}
    content = layouts.Content(
        [10**9, 2 * 10**9], [10**9, 2 * 10**9], [encoded(".png", rng, depth=False) for _ in range(2)], ".png",
        [rng.integers(500, 3000, (6, 8), dtype=np.uint16) for _ in range(2)], camera, np.tile(np.eye(4), (2, 1, 1)),
    )  # fmt: skip
    found = {}
    for layout in layouts.LAYOUTS:
        out = folder / layout.name
        try:
            root = layout.write(content, out)
        except ImportError:
            continue
        paths = sorted((path for path in out.rglob("*") if path.is_file()), key=lambda path: (path.suffix in (".png", ".jpg"), path))
        first, *others = ((str(path.relative_to(folder.parent)), path.read_bytes()) for path in paths)
        found[f"layout {layout.name}"] = Parser(first[0], (first[1],), lambda _, root=root: play(root), tuple(others))
    return found


def runs(folder: Path) -> dict[str, Parser]:
    """Make a finished run; one of the files that say what it is is mutated and sealed anew, as a forger would."""
    sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
    import finished

    run = finished.make(folder, frames=20).run
    first, *others = (
        (str(path.relative_to(folder.parent)), path.read_bytes())
        for path in (run / "run.json", run / "config.toml", *sorted(run.glob("*/stage.json")))
    )
    return {"forged run": Parser(first[0], (first[1],), forged, tuple(others))}


def forged(path: Path) -> None:
    """Seal a file of a run anew, so that what lies behind the seal is reached, and ask what the run is."""
    if path.name == "config.toml":
        text = path.read_bytes().partition(damage.SEAL.encode())[0]
        path.write_bytes(text + damage.seal(text))
    else:
        try:
            files.write_sealed(path, {name: value for name, value in json.loads(path.read_bytes()).items() if name != files.SEAL})
        except (ValueError, AttributeError, RecursionError) as error:
            raise SlamError("no object of JSON") from error
    run = RunDir.find(str(path.parent if path.name != "stage.json" else path.parents[1]))
    run.states(run.config())
    records = {stage: run.record(stage) for stage in NAMES}
    doubt.headline(doubt.from_records(records))
    for name, record in records.items():
        if record is not None:
            stage_line(record, stage_named(name).told)
    summary.outcome(run)
    housekeeping.list_runs(run.path.parent)


def play(root: Path) -> None:
    """Open a recording and decode it, as a run would; a frame that cannot be used costs a frame."""
    dataset = open_dataset(str(root))
    for i in range(min(len(dataset), 3)):
        for decode in (dataset.grey, dataset.rgb, dataset.depth):
            with contextlib.suppress(SlamError):
                decode(i)
    dataset.digest()
    dataset.ground_truth()


def read_dbow2(path: Path) -> object:
    """Import a vocabulary."""
    tree = dbow2.read(path)
    return vocabulary.from_parents(tree.parent, tree.centre, tree.weight, origin="", source=str(path))


ASCII_PLY = b"ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty float y\nproperty float z\nend_header\n0 1 2\n3 4 5\n"
ASCII_PCD = b"FIELDS x y z rgb\nSIZE 4 4 4 4\nTYPE F F F U\nCOUNT 1 1 1 1\nWIDTH 2\nHEIGHT 1\nPOINTS 2\nDATA ascii\n0 1 2 3\n4 5 6 7\n"


SCENE = {
    "room": {"min": [-3, -2, 0], "max": [3.0, 2.0, 2.5]},
    "obstacles": [
        {"type": "box", "name": "table", "centre": [1.0, 0.5, 0.4], "size": [1.0, 0.6, 0.8], "yaw": 0.3},
        {"type": "cylinder", "name": "post", "centre": [-1.0, 0.5, 0.5], "radius": 0.2, "height": 1.0},
    ],
}


def encoded(kind: str, rng: np.random.Generator, *, depth: bool = True) -> bytes:
    """Encode a small picture, of 16 bits where the format has them and `depth` is wanted."""
    import cv2

    is_deep = depth and kind in (".png", ".tiff", ".pgm")
    shape = SIZE[::-1] if is_deep else (*SIZE[::-1], 3)
    values = rng.integers(0, 60000 if is_deep else 255, shape).astype(np.uint16 if is_deep else np.uint8)
    try:
        return cv2.imencode(kind, values)[1].tobytes()
    except cv2.error:  # a codec that this build lacks
        return b"GIF89a\x08\x00\x06\x00" + bytes(40) if kind == ".gif" else b"\x76\x2f\x31\x01" + bytes(60)


def written(name: str, write: Callable[[Path], object]) -> tuple[bytes]:
    """Return the bytes of a file that is written by our own code."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / name
        write(path)
        return (path.read_bytes(),)


def packed(*names: str) -> bytes:
    """Return a zip archive of files by these names."""
    with io.BytesIO() as file:
        with zipfile.ZipFile(file, "w") as archive:
            for name in names:
                archive.writestr(name, "{}")
        return file.getvalue()


def tarred(*names: str) -> bytes:
    """Return a tar archive of files by these names."""
    with io.BytesIO() as file:
        with tarfile.open(fileobj=file, mode="w") as archive:
            for name in names:
                member = tarfile.TarInfo(name)
                member.size = 9
                archive.addfile(member, io.BytesIO(b"1.0 a.png"))
        return file.getvalue()


def fresh(folder: Path) -> Path:
    """Empty a folder, making it where it is not there."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    return folder


def steer(parser: Parser, folder: Path) -> None:
    """Hand the parser to atheris, which never returns."""
    import atheris

    def one(data: bytes) -> None:
        error = attempt(parser, folder, data)
        if error is not None and not isinstance(error, SlamError):
            raise error

    corpus = fresh(folder / "corpus")
    for number, seed in enumerate(parser.seeds):
        (corpus / str(number)).write_bytes(seed)
    atheris.instrument_all()
    atheris.Setup([sys.argv[0], str(corpus)], one)
    atheris.Fuzz()


if __name__ == "__main__":
    sys.exit(main())
