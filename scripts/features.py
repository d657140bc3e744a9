#!/usr/bin/env python
"""Measure features, matches and words against the truth, with plain OpenCV ORB as the peer in the same process.

    python scripts/features.py RECORDING ... [-s extract.KEY=VALUE] [--pairs N]

RECORDING as for `slamcli run`, with a true trajectory: tum/fr1_xyz, a folder, demo. Recall says something only of a recording that the
vocabulary was not trained on: `slamcli vocab info` names what the shipped one was trained on; of another recording take

    slamcli vocab train without.npz OTHER RECORDINGS AND PICTURES      (without the recording; its defaults made the shipped one)
    python scripts/features.py RECORDING -s match.vocabulary=without.npz

The factor of two threads over one is beside what the machine gives two processes that share nothing: less than that is the GIL's part.
"""

import argparse
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from multiprocessing import get_context

import cv2
import numpy as np
from feature_truth import Recording, pairs_within
from scipy.spatial import cKDTree

from slamcli.config import toml
from slamcli.config.options import Config, MatchConfig
from slamcli.errors import SlamError
from slamcli.formats import vocabulary_file
from slamcli.parallel import ordered_map
from slamcli.vision import bag_of_words, hamming, orb, vocabulary
from slamcli.vision.comparison import evenness, plain_orb

RADIUS = 3.0  # [px] within which a point is found again, or a match is correct
CHANCE = (8.0, 16.0)  # [px] by which points are moved to tell how often one is hit by chance
REVISIT_AFTER = 5.0  # [s] a place seen again sooner is not a loop
KEY_FRAME_SHARED, SAME_PLACE, OTHER_PLACE = 0.8, 0.5, 0.1  # shared view: less makes a key frame; more is the same place; less is another
ROUNDS = 7  # the fastest counts: other processes only ever add time
WALL_ROUNDS = 20  # of wall time, which needs both cores free at once

Detector = Callable[[np.ndarray], orb.KeyPoints]


def cpu_ms(works: dict[str, Callable[[], object]], n: int) -> dict[str, float]:
    """Return the CPU time of each work on n items, of all threads, per item [ms]. They take turns, so that all meet the same machine."""
    best = dict.fromkeys(works, np.inf)
    for _ in range(ROUNDS):
        for name, work in works.items():
            start = time.process_time()
            work()
            best[name] = min(best[name], time.process_time() - start)
    return {name: seconds / n * 1e3 for name, seconds in best.items()}


def rate(detect: Detector, images: list[np.ndarray], workers: int) -> float:
    """Return images per second of wall time."""
    start = time.perf_counter()
    for _ in ordered_map(detect, images, workers=workers):
        pass
    return len(images) / (time.perf_counter() - start)


def threads(detect: Detector, images: list[np.ndarray]) -> dict[str, float]:
    """Return the images per second of one worker and of two, and of a worker in each of two processes; the best of rounds taken in turn."""
    one, two, apart = 0.0, 0.0, 0.0
    with ProcessPoolExecutor(2, mp_context=get_context("fork")) as pool:
        for _ in range(WALL_ROUNDS):
            one, two = max(one, rate(detect, images, 1)), max(two, rate(detect, images, 2))
            apart = max(apart, sum(pool.map(rate, (detect, detect), (images, images), (1, 1))))
    return {"frames/s with 1": one, "with 2": two, "factor": two / one, "two processes": apart / one}


def spread(recording: Recording, detect: Detector, pairs: list[tuple[int, int]]) -> dict[str, float]:
    """Average evenness over the first frames of the pairs."""
    found = [evenness(detect(recording.grey(i)).xy, recording.camera.width, recording.camera.height) for i, _ in pairs]
    return {"cells hit": np.mean([f.share for f in found]), "variance / mean": np.mean([f.ratio for f in found])}


def found_again(recording: Recording, detect: Detector, pairs: list[tuple[int, int]]) -> dict[str, float]:
    """Average the share of the points of i, visible in j, that j has a point near, and how much of it is chance; and repeatability.

    found again : within RADIUS of the true place there is any point, be it of another scale, or the partner of many
    by chance : the same for places moved by CHANCE; beyond chance : what is left of the rest
    mutual : each other's nearest, within RADIUS
    repeatability : of K. Mikolajczyk et al., A comparison of affine region detectors, IJCV 2005, doi:10.1007/s11263-005-3848-x: pairs, each
    point in one at most and the nearest first, over the smaller number of points in the part of the scene that both frames see.
    "any scale" asks for RADIUS alone; without, octaves may differ by one: discs of further ones overlap by less than the 60 % asked for.
    """
    rng = np.random.default_rng(0)
    rows = []
    for i, j in pairs:
        a, b = detect(recording.grey(i)), detect(recording.grey(j))
        here, back = recording.carry(a.xy.astype(np.float64), i, j), recording.carry(b.xy.astype(np.float64), j, i)
        there, is_seen, is_shared = recording.camera.undistort(b.xy), np.isfinite(here[:, 0]), np.isfinite(back[:, 0])
        if not is_seen.any() or not is_shared.any():
            continue
        here, tree = here[is_seen], cKDTree(there)
        distance, nearest = tree.query(here)
        turn, reach = rng.uniform(0, 2 * np.pi, len(here)), rng.uniform(*CHANCE, len(here))
        moved = here + np.stack([reach * np.cos(turn), reach * np.sin(turn)], axis=1)
        is_near, is_mutual = distance < RADIUS, cKDTree(here).query(there)[1][nearest] == np.arange(len(here))
        fewer = min(len(here), int(is_shared.sum()))
        one_to_one = partial(pairs_within, here, there[is_shared], RADIUS, a.octave[is_seen], b.octave[is_shared])
        rows.append(
            [
                is_near.mean(),
                (tree.query(moved)[0] < RADIUS).mean(),
                (is_near & is_mutual).mean(),
                one_to_one(octaves=np.inf) / fewer,
                one_to_one(octaves=1) / fewer,
            ]
        )
    any_, chance, mutual, any_scale, repeatability = np.mean(rows, axis=0)
    return {
        "found again": any_,
        "by chance": chance,
        "beyond chance": (any_ - chance) / (1 - chance),
        "mutual": mutual,
        "any scale": any_scale,
        "repeatability": repeatability,
    }


def matched(
    recording: Recording, detect: Detector, pairs: list[tuple[int, int]], methods: dict[str, Callable]
) -> dict[str, dict[str, float]]:
    """For each method average the matches that are correct, their share of those whose truth is known, their median error; and the time."""
    frames = {k: detect(recording.grey(k)) for pair in pairs for k in pair}
    known, correct = dict.fromkeys(methods, 0), dict.fromkeys(methods, 0)
    errors = {name: [] for name in methods}
    for i, j in pairs:
        true, there = recording.carry(frames[i].xy.astype(np.float64), i, j), recording.camera.undistort(frames[j].xy)
        for name, match in methods.items():
            rows, _ = match(frames[i], frames[j])
            error = np.linalg.norm(true[rows[:, 0]] - there[rows[:, 1]], axis=1)
            known[name] += np.isfinite(error).sum()
            correct[name] += (error < RADIUS).sum()
            errors[name].append(error[error < RADIUS])
    ms = cpu_ms({name: (lambda m=match: [m(frames[i], frames[j]) for i, j in pairs]) for name, match in methods.items()}, len(pairs))
    return {
        name: {
            "correct": correct[name] / len(pairs),
            "precision": correct[name] / max(known[name], 1),
            "median px": np.median(np.concatenate(errors[name])),
            "ms": ms[name],
        }
        for name in methods
    }


def brute(a: orb.KeyPoints, b: orb.KeyPoints) -> tuple[np.ndarray, np.ndarray]:
    """Match all with all."""
    return hamming.match_brute(hamming.Described(a.desc, a.angle), hamming.Described(b.desc, b.angle))


class ByNode:
    """Match under vocabulary nodes; words are looked up once a frame, as the pipeline does, and not timed."""

    def __init__(self, words: vocabulary.Vocabulary, settings: MatchConfig) -> None:
        self.words, self.settings, self._nodes = words, settings, {}

    def nodes(self, points: orb.KeyPoints) -> np.ndarray:
        """Return the nodes of a frame's points."""
        if id(points) not in self._nodes:
            level, margin = self.settings.node_level, self.settings.node_margin
            self._nodes[id(points)] = points, vocabulary.quantize(self.words, points.desc, node_level=level, margin=margin)[1]
        return self._nodes[id(points)][1]

    def __call__(self, a: orb.KeyPoints, b: orb.KeyPoints) -> tuple[np.ndarray, np.ndarray]:
        """Match two frames."""
        return hamming.match_nodes(*(hamming.Described(points.desc, points.angle, self.nodes(points)) for points in (a, b)))


def recall(recording: Recording, detect: Detector, words: vocabulary.Vocabulary) -> dict[str, float]:
    """Tell how well places seen again are recognized: queries are the key frames that truly come back to an earlier one.

    Candidates are all key frames more than REVISIT_AFTER earlier, whether the place is the same or not.
    """
    frames = recording.key_frames(least_shared=KEY_FRAME_SHARED)
    stamp = recording.dataset.stamp[frames]
    vectors = [bag_of_words.word_vector(vocabulary.quantize(words, detect(recording.grey(int(f))).desc)[0], words.idf) for f in frames]
    n_queries, n_found, best = 0, 0, []
    for k, vector in enumerate(vectors):
        earlier = np.flatnonzero(stamp < stamp[k] - REVISIT_AFTER)
        shared = np.array([recording.shared_view(int(frames[k]), int(frames[e])) for e in earlier])
        index = bag_of_words.InvertedIndex(words.n_words)
        for row, e in enumerate(earlier):
            index.add(row, *vectors[e])
        found, score = index.query(*vector)
        order = np.argsort(-score, kind="stable")
        if (shared >= SAME_PLACE).any():
            n_queries += 1
            n_found += (shared[found[order[:5]]] >= SAME_PLACE).any()
        if len(order):
            best.append((score[order[0]], shared[found[order[0]]]))
    return {
        "key frames": len(frames),
        "revisits": n_queries,
        "recall in 5": n_found / max(n_queries, 1),
        **at_full_precision(best, n_queries),
    }


def at_full_precision(best: list[tuple[float, float]], n_queries: int) -> dict[str, float]:
    """Return the recall when each query's best score above a threshold is accepted, the threshold the lowest that lets no other place in.

    best : score and shared view of each query's best candidate
    """
    wrong = max((score for score, shared in best if shared < OTHER_PLACE), default=0.0)
    n_right = sum(score > wrong and shared >= SAME_PLACE for score, shared in best)
    return {"recall at 100 %": n_right / max(n_queries, 1), "threshold": wrong}


def table(title: str, rows: Iterable[tuple[str, dict[str, float]]]) -> Iterator[str]:
    """Set figures out in lines."""
    yield f"  {title}"
    for name, figures in rows:
        yield "    " + f"{name:<14}" + "  ".join(f"{key} {value:.3f}" for key, value in figures.items())


def report(recording: Recording, settings: Config, n_pairs: int) -> Iterator[str]:
    """Measure everything on one recording."""
    detectors = {"OpenCV ORB": plain_orb, "slamcli": partial(orb.detect, settings=settings.extract)}
    ours = detectors["slamcli"]
    near, far = recording.pairs(apart=1, wanted=n_pairs), recording.pairs(apart=10, wanted=n_pairs)
    images = [recording.grey(i) for i, _ in far]
    yield f"{recording.dataset.name}: {len(far)} pairs of frames"
    yield from table("evenness", ((name, spread(recording, d, far)) for name, d in detectors.items()))
    yield from table(
        f"repeatability, 10 frames apart, {RADIUS:g} px", ((name, found_again(recording, d, far)) for name, d in detectors.items())
    )
    yield from table(
        "brute-force matches, 10 frames apart", ((name, matched(recording, d, far, {"": brute})[""]) for name, d in detectors.items())
    )
    works = {name: (lambda d=d: [d(grey) for grey in images]) for name, d in {"OpenCV ORB": orb_bare(), "slamcli": ours}.items()}
    yield from table("CPU time", ((name, {"ms a frame": ms}) for name, ms in cpu_ms(works, len(images)).items()))
    yield from table("threads", [("slamcli", threads(ours, images))])
    words = vocabulary_file.read(settings.match.vocabulary)
    by_node = ByNode(words, settings.match)
    for apart, pairs in ((1, near), (10, far)):
        yield from table(f"matching, {apart} apart", matched(recording, ours, pairs, {"brute": brute, "words": by_node}).items())
    yield from table(f"places seen again, {words.n_words} words", [("slamcli", recall(recording, ours, words))])


def orb_bare() -> Callable[[np.ndarray], object]:
    """Return plain ORB as it is, without making arrays of its key points."""
    plain = cv2.ORB_create(1000)
    return lambda grey: plain.detectAndCompute(grey, None)


def main() -> None:
    """Read the arguments and print the figures of each recording."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recordings", nargs="+", metavar="RECORDING")
    parser.add_argument("-s", "--set", action="append", default=[], metavar="KEY=VALUE", dest="assignments")
    parser.add_argument("--pairs", type=int, default=40, help="pairs of frames, default 40")
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    try:
        settings = toml.apply(Config(), arguments.assignments)
        for target in arguments.recordings:
            for line in report(Recording(target), settings, arguments.pairs):
                print(line, flush=True)
    except SlamError as error:
        raise SystemExit(f"Error: {error}") from None


if __name__ == "__main__":
    main()
