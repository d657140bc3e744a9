"""match: features -> visual words, word vectors, and matches between neighbouring frames. Needs no pose."""

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from slamcli import artifacts
from slamcli.config.options import Config, MatchConfig
from slamcli.formats import vocabulary_file
from slamcli.parallel import ordered_map
from slamcli.schema import Features, Flow, Matches, Words
from slamcli.stages.contract import Inputs, Summary, Tools
from slamcli.vision import bag_of_words, hamming, optical_flow, vocabulary


def run(inputs: Inputs, out: Path, cfg: Config, tools: Tools) -> Summary:
    """Quantize every feature, make the frames' word vectors, match each frame to those before it."""
    features, settings = inputs.load(Features, "extract"), cfg.match
    words = _words(features, vocabulary_file.read(settings.vocabulary), settings)
    pairs = [(i, j) for i in range(len(features.stamp)) for j in range(max(0, i - settings.window), i)]
    flowed = inputs.load(Flow, "extract").flow_xy
    match = partial(_match, features, words, flowed, settings)
    found = list(tools.progress(ordered_map(match, pairs, workers=tools.workers), "match", len(pairs)))
    matches = Matches(
        pair=np.array(pairs, dtype=np.int32).reshape(-1, 2),
        offset=np.cumsum([0] + [len(rows) for rows, _ in found], dtype=np.int64),
        row=np.concatenate([np.zeros((0, 2), np.int32), *(rows for rows, _ in found)]),
        distance=np.concatenate([np.zeros(0, np.uint8), *(distance for _, distance in found)]),
    )
    artifacts.save(words, out)
    artifacts.save(matches, out)
    return {
        "frames": len(features.stamp),
        "pairs": len(pairs),
        "matches_per_pair": float(np.median(np.diff(matches.offset))) if pairs else 0.0,
        "words": len(words.idf),
        "words_seen": len(np.unique(words.bow_word)),
    }


def _words(features: Features, words: vocabulary.Vocabulary, settings: MatchConfig) -> Words:
    word, node = vocabulary.quantize(words, features.desc, node_level=settings.node_level, margin=settings.node_margin)
    bow_offset, bow_word, bow_weight = bag_of_words.word_vectors(word, features.offset, words.idf)
    return Words(idf=words.idf, word=word, node=node, bow_offset=bow_offset, bow_word=bow_word, bow_weight=bow_weight)


def _match(
    features: Features, words: Words, flowed: np.ndarray, settings: MatchConfig, pair: tuple[int, int]
) -> tuple[np.ndarray, np.ndarray]:
    rows, distance = _match_descriptors(features, words, settings, pair)
    if len(flowed) == 0 or len(rows) >= settings.flow_below or pair[0] - pair[1] != 1:
        return rows, distance
    i, j = (slice(int(features.offset[frame]), int(features.offset[frame + 1])) for frame in pair)
    is_free_i, is_free_j = np.ones(i.stop - i.start, dtype=bool), np.ones(j.stop - j.start, dtype=bool)
    is_free_i[rows[:, 0]] = is_free_j[rows[:, 1]] = False
    more = optical_flow.match(features.xy[i], flowed[j], is_free_i=is_free_i, is_free_j=is_free_j, radius=settings.flow_radius)
    bits = np.unpackbits(features.desc[i][more[:, 0]] ^ features.desc[j][more[:, 1]], axis=1).sum(axis=1)
    return np.concatenate([rows, more]), np.concatenate([distance, bits.clip(0, 255).astype(np.uint8)])


def _match_descriptors(features: Features, words: Words, settings: MatchConfig, pair: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    i, j = (slice(int(features.offset[frame]), int(features.offset[frame + 1])) for frame in pair)
    checks: Any = {"max_distance": settings.max_distance, "ratio": settings.ratio, "check_rotation": settings.check_rotation}
    if settings.method == "brute":
        return hamming.match_brute(features.desc[i], features.desc[j], features.angle[i], features.angle[j], **checks)
    return hamming.match_nodes(
        features.desc[i], words.node[i], features.desc[j], words.node[j], features.angle[i], features.angle[j], **checks
    )
