"""The observations of landmarks as chains, and what is worked out along them: views counted, landmarks fused, how a landmark looks.

A landmark's chain starts at `head`, goes on at `next` and ends at -1. An observation that was removed keeps its place with `kf` = -1.
"""

from typing import NamedTuple

import numpy as np
from numba import b1, f8, i4, i8, u1, u8

from slamcli.geometry import elementary
from slamcli.geometry.bits import hamming
from slamcli.jit.kernel import kernel

# Views beyond the latest add nothing to a landmark's mean direction and would make its medoid quadratic in its life.
LATEST_VIEWS = 16


class Chains(NamedTuple):
    """The chains of L landmarks, of O observations."""

    head: i4[::1]  # (L,) row of a landmark's latest observation
    n_obs: i4[::1]  # (L,) key frames that observe it
    next: i4[::1]  # (O,) observation of the same landmark before this one, -1 = none
    lm: i4[::1]  # (O,) landmark
    kf: i4[::1]  # (O,) key frame, -1 = removed
    row: i8[::1]  # (O,) feature


class Fates(NamedTuple):
    """What became of L landmarks."""

    n_visible: i4[::1]  # (L,) frames that should have seen it
    n_found: i4[::1]  # (L,) frames that did
    is_alive: b1[::1]  # (L,)
    replaced_by: i4[::1]  # (L,) landmark that it was fused into, -1 = none


class FeatureColumns(NamedTuple):
    """What M features tell of how landmarks look."""

    desc: u8[:, ::1]  # (M, 4)
    octave: u1[::1]  # (M,)
    octave_scale: float


class Looks(NamedTuple):
    """How L landmarks look."""

    desc: u8[:, ::1]  # (L, 4) of the observation nearest to all others, 256 bits
    direction: f8[:, ::1]  # (L, 3) mean unit vector from the key frames that saw it
    reach: f8[::1]  # (L,) [m] distance at which it appears at octave 0


@kernel
def link(chains: Chains, start: i8):
    """Put the observations from row `start` on at the heads of their landmarks' chains."""
    for o in range(start, len(chains.lm)):
        lm = chains.lm[o]
        chains.next[o] = chains.head[lm]
        chains.head[lm] = o
        chains.n_obs[lm] += 1


@kernel
def mark(first: i8[::1], last: i8[::1], lm_of_row: i4[::1], is_seen: b1[::1]):
    """Mark the landmarks that rows `first` to `last` of the features, the last left out, show in each of several key frames."""
    for k in range(len(first)):
        for row in range(first[k], last[k]):
            if lm_of_row[row] >= 0:
                is_seen[lm_of_row[row]] = True


@kernel
def count_views(ids: i4[::1], chains: Chains, counts: i4[::1]):
    """Count for each key frame (K,) how many of the landmarks `ids` it sees."""
    head, next_, obs_kf = chains.head, chains.next, chains.kf
    # All chains at once, a step each: memory is waited for less than along one after the other, where each place depends on the one before.
    at, n = np.empty(len(ids), dtype=np.int32), 0
    for lm in ids:
        at[n] = head[lm]
        n += head[lm] >= 0
    while n > 0:
        n_left = 0
        for i in range(n):
            o = at[i]
            if obs_kf[o] >= 0:
                counts[obs_kf[o]] += 1
            at[n_left] = next_[o]
            n_left += next_[o] >= 0
        n = n_left


@kernel
def gather(ids: i4[::1], chains: Chains, which: i4[::1], kf: i4[::1], row: i8[::1]):
    """Write the observations of landmarks `ids`, each one's sorted by key frame as they come: most chains nearly are. Returns how many."""
    head, next_, obs_kf, obs_row = chains.head, chains.next, chains.kf, chains.row
    n = 0
    for i in range(len(ids)):
        first, o = n, head[ids[i]]
        while o >= 0:
            if obs_kf[o] >= 0:
                place = n
                while place > first and kf[place - 1] > obs_kf[o]:
                    kf[place], row[place] = kf[place - 1], row[place - 1]
                    place -= 1
                which[n], kf[place], row[place] = i, obs_kf[o], obs_row[o]
                n += 1
            o = next_[o]
    return n


@kernel
def unlink(rows: i8[::1], lm_of_row: i4[::1], is_alive: b1[::1], chains: Chains):
    """Remove the observations of features `rows`; a landmark without any left dies."""
    head, n_obs, next_, obs_kf, obs_row = chains.head, chains.n_obs, chains.next, chains.kf, chains.row
    for row in rows:
        lm = lm_of_row[row]
        if lm < 0:
            continue
        o = head[lm]
        while o >= 0:
            if obs_kf[o] >= 0 and obs_row[o] == row:
                obs_kf[o] = -1
                n_obs[lm] -= 1
                break
            o = next_[o]
        lm_of_row[row] = -1
        if n_obs[lm] == 0:
            is_alive[lm] = False


@kernel
def fuse(kept: i4[::1], gone: i4[::1], lm_of_row: i4[::1], fates: Fates, chains: Chains):
    """Merge landmarks `gone` into `kept`, pair by pair: observations move over, save of a key frame that sees the other already."""
    head, n_obs, next_, obs_lm, obs_kf, obs_row = chains.head, chains.n_obs, chains.next, chains.lm, chains.kf, chains.row
    n_visible, n_found, is_alive, replaced_by = fates.n_visible, fates.n_found, fates.is_alive, fates.replaced_by
    for pair in range(len(kept)):
        a, b = kept[pair], gone[pair]
        if not (is_alive[a] and is_alive[b]):
            continue
        o = head[b]
        while o >= 0:
            following = next_[o]
            if obs_kf[o] >= 0:
                clash = False
                p = head[a]
                while p >= 0:
                    if obs_kf[p] == obs_kf[o]:
                        clash = True
                        break
                    p = next_[p]
                if clash:
                    lm_of_row[obs_row[o]] = -1
                    obs_kf[o] = -1
                else:
                    lm_of_row[obs_row[o]] = a
                    obs_lm[o] = a
                    next_[o] = head[a]
                    head[a] = o
                    n_obs[a] += 1
            o = following
        n_visible[a] += n_visible[b]
        n_found[a] += n_found[b]
        head[b], n_obs[b], is_alive[b], replaced_by[b] = -1, 0, False, a


@kernel
def refresh(ids: i4[::1], chains: Chains, xyz: f8[:, ::1], T_wk: f8[:, :, ::1], features: FeatureColumns, looks: Looks):
    """Work out anew how landmarks `ids` look, from where their latest views stand."""
    head, next_, obs_kf, obs_row = chains.head, chains.next, chains.kf, chains.row
    desc, octave, direction, reach = features.desc, features.octave, looks.direction, looks.reach
    rows = np.empty(LATEST_VIEWS, dtype=np.int64)
    for lm in ids:
        n = 0
        sx = sy = sz = 0.0
        nearest = np.inf
        o = head[lm]
        while o >= 0 and n < LATEST_VIEWS:
            if obs_kf[o] >= 0:
                kf = obs_kf[o]
                dx, dy, dz = xyz[lm, 0] - T_wk[kf, 0, 3], xyz[lm, 1] - T_wk[kf, 1, 3], xyz[lm, 2] - T_wk[kf, 2, 3]
                distance = np.sqrt(dx * dx + dy * dy + dz * dz) + 1e-12
                sx, sy, sz = sx + dx / distance, sy + dy / distance, sz + dz / distance
                if distance < nearest:
                    nearest = distance
                    reach[lm] = distance * elementary.whole_power(features.octave_scale, octave[obs_row[o]])
                rows[n] = obs_row[o]
                n += 1
            o = next_[o]
        if n == 0:
            continue
        norm = np.sqrt(sx * sx + sy * sy + sz * sz) + 1e-12
        direction[lm, 0], direction[lm, 1], direction[lm, 2] = sx / norm, sy / norm, sz / norm
        best, best_sum = rows[0], 1 << 30
        for a in range(n):  # medoid: the descriptor nearest to all others
            total = 0
            for b in range(n):
                total += int(hamming(desc, rows[a], desc, rows[b]))
            if total < best_sum:
                best, best_sum = rows[a], total
        for i in range(4):
            looks.desc[lm, i] = desc[best, i]
