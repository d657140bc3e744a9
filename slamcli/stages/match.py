"""match: features -> visual words and matches between neighbouring frames. Needs no pose."""

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from slamcli import artifacts, mapped_memory
from slamcli.config.options import Config, MatchConfig
from slamcli.formats import vocabulary_file
from slamcli.parallel import ordered_map
from slamcli.schema import Features, Flow, Matches, Words
from slamcli.stages.contract import Inputs, Summary, Tools
from slamcli.vision import hamming, optical_flow, vocabulary


def run(inputs: Inputs, out: Path, cfg: Config, tools: Tools) -> Summary:
    """Quantize every feature, match each frame to those before it."""
    features, settings = inputs.load(Features, "extract"), cfg.match
    words = _words(features, vocabulary_file.read(settings.vocabulary), settings, out)
    pairs = [(i, j) for i in range(len(features.stamp)) for j in range(max(0, i - settings.window), i)]
    flowed = inputs.load(Flow, "extract").flow_xy
    match, offset = partial(_match, features, words, flowed, settings), [0]
    with artifacts.Writer(Matches, out, "row") as writer:
        for rows in tools.progress(ordered_map(match, pairs, workers=tools.workers), "match", len(pairs)):
            writer.append(row=rows)
            offset.append(offset[-1] + len(rows))
        matches = writer.finish(pair=np.array(pairs, dtype=np.int32).reshape(-1, 2), offset=np.array(offset, dtype=np.int64))
    return {
        "frames": len(features.stamp),
        "pairs": len(pairs),
        "matches_per_pair": float(np.median(np.diff(matches.offset))) if pairs else 0.0,
        "words": len(words.idf),
        "words_seen": int((words.idf[seen(words)] > 0).sum()),
    }


def _words(features: Features, words: vocabulary.Vocabulary, settings: MatchConfig, out: Path) -> Words:
    """Quantize all features and write their words."""
    with artifacts.Writer(Words, out, "word", "second_node") as writer:
        for rows in mapped_memory.blocks(features.desc):
            word, node = vocabulary.quantize(words, features.desc[rows], node_level=settings.node_level, margin=settings.node_margin)
            writer.append(word=word, second_node=node[:, 1])
        word_node = words.node_of_word(settings.node_level)
        return writer.finish(idf=words.idf, word_node=word_node, word_offset=np.array(features.offset))


def seen(words: Words) -> np.ndarray:
    """Say which words (W,) occur."""
    is_seen = np.zeros(len(words.idf), dtype=bool)
    for rows in mapped_memory.blocks(words.word):
        is_seen[words.word[rows]] = True
    return is_seen


def _match(features: Features, words: Words, flowed: np.ndarray, settings: MatchConfig, pair: tuple[int, int]) -> np.ndarray:
    rows = _match_descriptors(features, words, settings, pair)
    if len(flowed) == 0 or len(rows) >= settings.flow_below or pair[0] - pair[1] != 1:
        return rows
    i, j = (slice(int(features.offset[frame]), int(features.offset[frame + 1])) for frame in pair)
    is_free_i, is_free_j = np.ones(i.stop - i.start, dtype=bool), np.ones(j.stop - j.start, dtype=bool)
    is_free_i[rows[:, 0]] = is_free_j[rows[:, 1]] = False
    more = optical_flow.match(features.xy[i], flowed[j], is_free_i=is_free_i, is_free_j=is_free_j, radius=settings.flow_radius)
    return np.concatenate([rows, more])


def _match_descriptors(features: Features, words: Words, settings: MatchConfig, pair: tuple[int, int]) -> np.ndarray:
    i, j = (slice(int(features.offset[frame]), int(features.offset[frame + 1])) for frame in pair)
    checks: Any = {"max_distance": settings.max_distance, "ratio": settings.ratio, "check_rotation": settings.check_rotation}
    here, there = (hamming.Described(features.desc[rows], features.angle[rows], words.node(rows)) for rows in (i, j))
    matched, _ = (hamming.match_brute if settings.method == "brute" else hamming.match_nodes)(here, there, **checks)
    return matched
