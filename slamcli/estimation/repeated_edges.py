"""Edges of a pose graph that repeat each other, and the information that each may claim.

Edges that hold what one map says are not independent: ten of them per key frame, taken as if they were, would make the chain of key frames
twenty times stiffer than its drift is. So they share the information of the strongest.
"""

import numpy as np

from slamcli.estimation.relative_pose_factors import Edges

CHAIN_SPAN = 20  # key frames; an edge across more is no part of the chain in time


def share_of_information(edges: Edges, is_trusted: np.ndarray) -> np.ndarray:
    """Return the share (E,) of its information that each edge may claim when trusted edges repeat each other, 1 for other edges.

    Stretch the chain of key frames evenly: an edge of weight w over s steps is stretched s times as far as one step and so resists, per
    step, like w s single edges. Over every cut between neighbours, all edges together may resist like one edge of the largest weight.
    """
    first, last = np.sort(edges.kf, axis=1).astype(np.int64).T
    span, weight = last - first, np.trace(edges.information, axis1=1, axis2=2)
    is_chain = is_trusted & (span >= 1) & (span <= CHAIN_SPAN)
    n_cuts = int(last.max(initial=0)) + 1
    stiffness, strongest = np.zeros(n_cuts), np.zeros(n_cuts)
    for step in range(CHAIN_SPAN):
        crossing = is_chain & (span > step)
        np.add.at(stiffness, first[crossing] + step, (weight * span)[crossing])
        np.maximum.at(strongest, first[crossing] + step, weight[crossing])
    per_cut = np.divide(strongest, stiffness, out=np.ones(n_cuts), where=stiffness > 0.0)
    summed = np.append(0.0, np.cumsum(per_cut))
    share = np.ones(len(edges))
    share[is_chain] = (summed[last[is_chain]] - summed[first[is_chain]]) / span[is_chain]
    across = is_trusted & ~is_chain
    share[across] = 0.5 * (per_cut[first[across]] + per_cut[np.maximum(last[across] - 1, 0)])
    return share
