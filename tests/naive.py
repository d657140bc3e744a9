"""Slow, obvious twins of the kernels."""

import numpy as np

# --- geometry/algebra.py


def product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Matrix product with sums from the first index to the last, every operation rounded by itself."""
    out = np.zeros((a.shape[0], b.shape[1]))
    for i, j in np.ndindex(out.shape):
        total = a[i, 0] * b[0, j]
        for k in range(1, a.shape[1]):
            total = total + a[i, k] * b[k, j]
        out[i, j] = total
    return out


# --- geometry/voxel.py, geometry/octree.py, dense/occupancy.py, dense/voxel_cloud.py, depth/oriented_points.py


def interleaved(x: int, y: int, z: int) -> int:
    """Morton key of a cell, bit by bit."""
    return sum(((x >> b & 1) | (y >> b & 1) << 1 | (z >> b & 1) << 2) << 3 * b for b in range(21))


def ray_cells(origin: np.ndarray, end: np.ndarray, resolution: float) -> list[tuple[int, int, int]]:
    """Cells from the origin's to the one before the end's: OctoMap's computeRayKeys, line by line in float32 and float64."""
    origin, end = np.float32(origin), np.float32(end)
    cell = [int(np.floor(1.0 / resolution * float(c))) + 32768 for c in origin]
    last = [int(np.floor(1.0 / resolution * float(c))) + 32768 for c in end]
    if cell == last:
        return []
    direction = end - origin
    length = np.float32(np.sqrt(np.float64(direction[0] ** 2 + direction[1] ** 2 + direction[2] ** 2)))
    direction = direction / length
    step, t_max, t_delta = [0] * 3, [np.inf] * 3, [np.inf] * 3
    for i in range(3):
        if direction[i] != 0:
            step[i] = 1 if direction[i] > 0 else -1
            border = (cell[i] - 32768 + 0.5) * resolution + float(np.float32(step[i] * resolution * 0.5))
            t_max[i] = (border - float(origin[i])) / float(direction[i])
            t_delta[i] = resolution / abs(float(direction[i]))
    out = [tuple(cell)]
    while True:
        if t_max[0] < t_max[1]:
            axis = 0 if t_max[0] < t_max[2] else 2
        else:
            axis = 1 if t_max[1] < t_max[2] else 2
        cell[axis] += step[axis]
        t_max[axis] += t_delta[axis]
        if cell == last or min(t_max) > float(length):
            return out
        out.append(tuple(cell))


def scan_marks(x_w: np.ndarray, origin: np.ndarray, max_range: float, resolution: float) -> dict[tuple[int, int, int], bool]:
    """Cells of one scan: True hit, False passed; OctoMap's computeUpdate with sets."""
    free, occupied = set(), set()
    origin = np.float32(origin)
    for point in np.float32(x_w):
        ray = point - origin
        length = np.sqrt(np.float64(ray[0] ** 2 + ray[1] ** 2 + ray[2] ** 2))
        if length <= max_range:
            occupied.add(tuple(int(np.floor(1.0 / resolution * float(c))) + 32768 for c in point))
        else:
            point = origin + ray / np.float32(length) * np.float32(max_range)
        free.update(ray_cells(origin, point, resolution))
    return {cell: cell in occupied for cell in free | occupied}


def pruned(leaves: dict[tuple[int, int], float]) -> dict[tuple[int, int], float]:
    """Leaves {(depth, prefix): value} with every eight equal siblings merged."""
    leaves = dict(leaves)
    for depth in range(16, 0, -1):
        for parent in {prefix >> 3 for d, prefix in leaves if d == depth}:
            family = [leaves.get((depth, parent << 3 | i)) for i in range(8)]
            if None not in family and len(set(family)) == 1:
                for i in range(8):
                    del leaves[depth, parent << 3 | i]
                leaves[depth - 1, parent] = family[0]
    return leaves


def ot_nodes(leaves: dict[tuple[int, int], float], parents: str) -> list[tuple[float, int]]:
    """(value, child mask) of every node depth first, by recursion from the root."""

    def visit(depth: int, prefix: int) -> tuple[float, list] | None:
        if (depth, prefix) in leaves:
            return leaves[depth, prefix], [(leaves[depth, prefix], 0)]
        if depth == 16 or not any(d > depth and p >> 3 * (d - depth) == prefix for d, p in leaves):
            return None
        children = [visit(depth + 1, prefix << 3 | i) for i in range(8)]
        values = [child[0] for child in children if child]
        value = max(values) if parents == "max" else sum(values) / 8
        mask = sum(1 << i for i, child in enumerate(children) if child)
        return value, [(value, mask)] + [node for child in children if child for node in child[1]]

    found = visit(0, 0)
    return found[1] if found else []


def voxel_means(values: np.ndarray, weight: np.ndarray, side: float) -> dict[tuple[int, int, int], np.ndarray]:
    """Weighted mean of the rows of each voxel; the first three columns are the position."""
    groups: dict[tuple[int, ...], list[int]] = {}
    for i, row in enumerate(values):
        groups.setdefault(tuple(int(c) for c in np.floor(row[:3] / side)), []).append(i)
    return {cell: np.average(values[rows], axis=0, weights=weight[rows]) for cell, rows in groups.items()}


# --- navigation/surface_patches.py, navigation/grid.py, navigation/planner.py


def block_points(depth: np.ndarray, rays: np.ndarray, side: int, max_range: float) -> np.ndarray:
    """Points of blocks of pixels by the mean of inverse depth."""
    rows, columns, step = depth.shape[0] // side, depth.shape[1] // side, -(-side // 4)
    out = np.full((rows, columns, 4), np.nan)
    for r in range(rows):
        for c in range(columns):
            block = np.s_[r * side : (r + 1) * side : step, c * side : (c + 1) * side : step]
            z = depth[block].astype(np.float64)
            is_good = (z > 0) & (z <= max_range)
            if is_good.mean() < 0.5 or np.ptp(z[is_good]) > 0.02 + 0.1 * z[is_good].min():
                continue
            mean = 1.0 / np.mean(1.0 / z[is_good])
            out[r, c] = [*(mean * rays[block][is_good].astype(np.float64).mean(axis=0)), mean, 0.0012 + 0.0019 * (mean - 0.4) ** 2]
    return out


def normals(points: np.ndarray) -> np.ndarray:
    """Normals of a grid of points by the cross product of the steps between neighbours."""
    out = np.full(points.shape[:2] + (3,), np.nan)
    for r in range(1, points.shape[0] - 1):
        for c in range(1, points.shape[1] - 1):
            x = points[r, c, :3]
            across, down = (points[r, c + 1] - points[r, c - 1])[:3], (points[r + 1, c] - points[r - 1, c])[:3]
            normal = np.cross(down, across)
            if abs(across[2]) < 0.15 * x[2] and abs(down[2]) < 0.15 * x[2] and normal.any():
                out[r, c] = -np.sign(normal @ x) * normal / np.linalg.norm(normal)
    return out


def sorted_points(image, sight, noise, stride, above, ground, side):
    """Band points, their height slices, floor marks, holes and tops per cell, one pixel at a time, heights counted from `ground`."""
    (depth, rays, T), (corner, cell, near, far, low, high, drop), (base, quadratic) = image, sight, noise
    n_band, layers = np.zeros((side, side), int), np.zeros((side, side), np.uint16)
    top, floor, hole = np.zeros((side, side), bool), np.zeros((side, side), int), np.zeros((side, side), int)

    def point(v, u):
        return T[:3, :3] @ (depth[v, u] * np.array([*rays[v, u].astype(float), 1.0])) + T[:3, 3]

    def at(xy):
        j, i = np.floor(xy / cell - corner).astype(int)
        return (i, j) if 0 <= i < side and 0 <= j < side else None

    def is_level(v, u, x, slope):
        """Upright surfaces rise from row to row by what the rows are apart."""
        if slope[2] >= 0 or v < above:
            return False
        row_apart = z * (T[2, :3] @ np.array([*rays[v - above, u].astype(float), 1.0]) - slope[2])
        return abs(point(v - above, u)[2] - x[2]) < 0.5 * row_apart

    for v in range(stride // 2, depth.shape[0], stride):
        for u in range(stride // 2, depth.shape[1], stride):
            z = float(depth[v, u])
            if not near <= z:
                continue
            x = point(v, u)
            slope = (x - T[:3, 3]) / z
            slack = 2.0 * abs(slope[2]) * (base + quadratic * (z - 0.4) ** 2)
            place = at(x[:2])
            is_level_here = is_level(v, u, x, slope)
            x[2] -= ground[place] if place else 0.0
            if x[2] < -drop - slack:
                height = 0.0
                for _ in range(4):
                    reach = (T[2, 3] - height) / -slope[2]
                    place = at(T[:2, 3] + reach * slope[:2])
                    before, height = height, float(ground[place]) if place else 0.0
                    if is_met := abs(height - before) <= low:
                        break
                if is_met and reach <= far and place:
                    hole[place] += 1
                continue
            if z > far or place is None:
                continue
            if x[2] >= high:
                top[place] |= x[2] < high + 0.3 and is_level_here
            elif x[2] >= low + slack:
                n_band[place] += 1
                layers[place] |= np.uint16(1 << int(16 * (x[2] - low) / (high - low)))
            elif x[2] > -low - slack and is_level_here:
                floor[place] = 2
                back = min(low - max(x[2], 0.0), -z * slope[2]) / -slope[2]
                steps = int(back * np.linalg.norm(slope[:2]) / cell)
                for s in range(1, steps + 1):
                    before = at(x[:2] - back * s / (steps + 1) * slope[:2])
                    if before and abs(ground[before] - ground[place]) <= low:
                        floor[before] = max(floor[before], 1)
    return n_band, layers, floor, hole, top


def crossed_slices(image, sight, noise, stride, ground, side):
    """The slices of the band that lines of sight cross, as a set of (row, column, slice), one step along one pixel's line at a time."""
    (depth, rays, T), (corner, cell, near, far, low, high, _), (base, quadratic) = image, sight, noise
    crossed = set()
    for v in range(stride // 2, depth.shape[0], stride):
        for u in range(stride // 2, depth.shape[1], stride):
            z = float(depth[v, u])
            if not near <= z:
                continue
            slope = T[:3, :3] @ np.array([*rays[v, u].astype(float), 1.0])
            ends = sorted((edge - T[2, 3]) / slope[2] for edge in (low + min(ground.min(), 0.0), high + max(ground.max(), 0.0)))
            first, last = max(near, ends[0]), min(far, z - 2.0 * (base + quadratic * (z - 0.4) ** 2) - cell, ends[1])
            if not first < last:
                continue
            n = int(np.ceil((last - first) * np.abs(slope[:2]).max() / cell)) + 1
            for t in first + (last - first) * (np.arange(n) + 0.5) / n:
                x = T[:3, 3] + t * slope
                j, i = np.floor(x[:2] / cell - corner).astype(int)
                if 0 <= i < side and 0 <= j < side:
                    k = int(np.floor(16 * (x[2] - ground[i, j] - low) / (high - low)))
                    if 0 <= k < 16:
                        crossed.add((i, j, k))
    return crossed


def is_clear(standing, is_open, face, around, ground, n, sight):
    """Follow the line from cell `n`'s floor to the camera, looking for something that hangs above it and may reach as far as the cell."""
    rows, columns, camera_x, camera_y, camera_z, low, high, reach = sight
    row, column = rows[n], columns[n]
    start, end = np.array([column + 0.5, row + 0.5]), np.array([camera_x, camera_y])
    steps = int(np.ceil(np.abs(end - start).max()))
    for s in range(steps + 1):
        t = s / steps if steps else 0.0
        height = ground[row, column] + t * (camera_z - ground[row, column])
        if height >= high + max(ground.max(), 0.0) or t * np.linalg.norm(end - start) > reach:
            return True
        j, i = np.floor(start + t * (end - start)).astype(int)
        if not (0 <= i < standing.shape[0] and 0 <= j < standing.shape[1]):
            return True
        height -= ground[i, j]
        if height >= high or (face[i, j] > 0 and around[row, column] != face[i, j]):
            continue
        k = int(16 * max(height - low, 0.0) / (high - low))
        above = {b for b in range(k + 3, 16) if standing[i, j] >> b & 1}
        beside = any(standing[i, j] >> b & 1 for b in range(max(k - 2, 0), min(k + 3, 16)))
        core = {b for b in above if b - 1 in above and (b + 1 in above or b == 15)}
        is_passed = bool(core) and all(is_open[row, column] >> b & 1 for b in core)
        if above and not beside and not is_passed:
            return False
    return True


def cheapest_cost(cost: np.ndarray, start: tuple[int, int], goal: tuple[int, int]) -> float:
    """Cost of the cheapest path of king's moves that cut no corner: Bellman-Ford to the end."""
    total = np.full(cost.shape, np.inf)
    total[start] = 0.0 if np.isfinite(cost[start]) else np.inf
    rows, columns = cost.shape
    while True:
        before = total.copy()
        for r in range(rows):
            for c in range(columns):
                for dr in (-1, 0, 1):
                    for dc in (-1, 0, 1):
                        r2, c2 = r + dr, c + dc
                        if 0 <= r2 < rows and 0 <= c2 < columns and np.isfinite([cost[r, c], cost[r2, c2], cost[r2, c], cost[r, c2]]).all():
                            total[r2, c2] = min(total[r2, c2], total[r, c] + np.hypot(dr, dc) * 0.5 * (cost[r, c] + cost[r2, c2]))
        if np.array_equal(total, before):
            return float(total[goal])


# --- estimation/minimal_solvers.py, estimation/pose_kernels.py, estimation/bundle_kernels.py


def p3p_distances(x: np.ndarray, ray: np.ndarray) -> list[np.ndarray]:
    """Distances along three rays to three points, by Grunert's quartic (R. Haralick et al., IJCV 1994, equation 9)."""
    y = ray / np.linalg.norm(ray, axis=1, keepdims=True)
    a2, b2, c2 = ((x[i] - x[j]) @ (x[i] - x[j]) for i, j in ((1, 2), (0, 2), (0, 1)))
    cos_a, cos_b, cos_c = y[1] @ y[2], y[0] @ y[2], y[0] @ y[1]
    q, r = (a2 - c2) / b2, (a2 + c2) / b2
    quartic = [
        (q - 1) ** 2 - 4 * c2 / b2 * cos_a**2,
        4 * (q * (1 - q) * cos_b - (1 - r) * cos_a * cos_c + 2 * c2 / b2 * cos_a**2 * cos_b),
        2 * (q**2 - 1 + 2 * q**2 * cos_b**2 + 2 * (1 - c2 / b2) * cos_a**2 - 4 * r * cos_a * cos_b * cos_c + 2 * (1 - a2 / b2) * cos_c**2),
        4 * (-q * (1 + q) * cos_b + 2 * a2 / b2 * cos_c**2 * cos_b - (1 - r) * cos_a * cos_c),
        (1 + q) ** 2 - 4 * a2 / b2 * cos_c**2,
    ]
    out = []
    for v in np.roots(quartic):
        if abs(v.imag) > 1e-6 or v.real <= 0:
            continue
        v = v.real
        u = ((-1 + q) * v**2 - 2 * q * cos_b * v + 1 + q) / (2 * (cos_c - v * cos_a))
        if u > 0:
            first = np.sqrt(b2 / (1 + v**2 - 2 * v * cos_b))
            out.append(first * np.array([1.0, u, v]))
    return out


def residual(T_cw: np.ndarray, x_w: np.ndarray, xy: np.ndarray, depth: float, sigma_px: float, sigma_z: float, camera) -> np.ndarray:
    """Prediction minus measurement in standard deviations: two numbers, or three where there is a depth."""
    x_c = T_cw[:3, :3] @ x_w + T_cw[:3, 3]
    u, v = camera.fx * x_c[0] / x_c[2] + camera.cx, camera.fy * x_c[1] / x_c[2] + camera.cy
    r = [(u - xy[0]) / sigma_px, (v - xy[1]) / sigma_px]
    return np.array(r if np.isnan(depth) else [*r, (x_c[2] - depth) / sigma_z])


def huber(chi2: float, limit: float) -> float:
    """Huber's cost of a squared residual."""
    return chi2 if chi2 <= limit else 2.0 * np.sqrt(limit * chi2) - limit


def bundle_cost(T_cw, x_w, seen, camera, limits=(np.inf, np.inf)) -> float:
    """Sum of the costs of all observations."""
    cost = 0.0
    for o, (k, lm) in enumerate(zip(seen.kf, seen.lm, strict=True)):
        r = residual(T_cw[k], x_w[lm], seen.xy[o], seen.depth[o], seen.sigma_px[o], seen.sigma_z[o], camera)
        cost += huber(r @ r, limits[len(r) - 2])
    return cost


def bundle_normal_equations(T_cw, x_w, seen, camera, limits=(np.inf, np.inf)) -> tuple[np.ndarray, np.ndarray]:
    """H = sum w J^T J and b = -sum w J^T r over all key frames, then all landmarks; J by central differences through the retraction."""
    from slamcli.geometry import se3

    n_pose = 6 * len(T_cw)
    H, b, h = np.zeros((n_pose + 3 * len(x_w),) * 2), np.zeros(n_pose + 3 * len(x_w)), 1e-6
    for o, (k, lm) in enumerate(zip(seen.kf, seen.lm, strict=True)):
        measured = (seen.xy[o], seen.depth[o], seen.sigma_px[o], seen.sigma_z[o], camera)
        r = residual(T_cw[k], x_w[lm], *measured)
        J = np.zeros((len(r), 9))
        for i, step in enumerate(h * np.eye(6)):
            J[:, i] = residual(se3.exp(step) @ T_cw[k], x_w[lm], *measured) - residual(se3.exp(-step) @ T_cw[k], x_w[lm], *measured)
        for i, step in enumerate(h * np.eye(3)):
            J[:, 6 + i] = residual(T_cw[k], x_w[lm] + step, *measured) - residual(T_cw[k], x_w[lm] - step, *measured)
        J /= 2.0 * h
        limit = limits[len(r) - 2]
        w = 1.0 if r @ r <= limit else np.sqrt(limit / (r @ r))
        rows = np.r_[6 * k : 6 * k + 6, n_pose + 3 * lm : n_pose + 3 * lm + 3]
        H[np.ix_(rows, rows)] += w * J.T @ J
        b[rows] -= w * J.T @ r
    return H, b


def ranked(T: np.ndarray, x: np.ndarray, xy: np.ndarray, camera, threshold_px: float) -> int:
    """The hypothesis (M, 3, 4) with the least truncated sum of squared reprojection errors, the first of equals."""
    score = []
    for pose in T:
        x_c = x @ pose[:, :3].T + pose[:, 3]
        error2 = ((camera.project(x_c) - xy) ** 2).sum(axis=1)
        error2[~(x_c[:, 2] > 0)] = np.inf
        score.append(np.minimum(error2 / threshold_px**2, 1.0).sum() if np.isfinite(pose).all() else np.inf)
    return int(np.argmin(score))


# --- vision/fast.py, quadtree.py, brief.py, filters.py, hamming.py, vocabulary.py

CIRCLE = list(
    zip([0, 1, 2, 3, 3, 3, 2, 1, 0, -1, -2, -3, -3, -3, -2, -1], [3, 3, 2, 1, 0, -1, -2, -3, -3, -3, -2, -1, 0, 1, 2, 3], strict=True)
)  # (dx, dy)


def fast_score(image: np.ndarray) -> np.ndarray:
    """The largest t for which nine in a row on the circle are all at least t brighter, or all at least t darker, than the centre."""
    score = np.zeros_like(image)
    height, width = image.shape
    for y in range(3, height - 3):
        for x in range(3, width - 3):
            difference = [int(image[y + dy, x + dx]) - int(image[y, x]) for dx, dy in CIRCLE]
            runs = [[difference[(start + k) % 16] for k in range(9)] for start in range(16)]
            score[y, x] = max(0, max(min(run) for run in runs), max(-max(run) for run in runs))
    return score


def local_maxima(score: np.ndarray, threshold: int) -> np.ndarray:
    """Scores above the threshold that no neighbour exceeds, and none later in reading order equals."""
    peak = np.zeros_like(score)
    for y in range(1, score.shape[0] - 1):
        for x in range(1, score.shape[1] - 1):
            around = score[y - 1 : y + 2, x - 1 : x + 2].ravel()
            later = around[5:]
            if score[y, x] > threshold and score[y, x] == around.max() and (later < score[y, x]).all():
                peak[y, x] = score[y, x]
    return peak


def cell_corners(peak: np.ndarray, border: int, cell: int, threshold: int, only_best: bool) -> list[tuple[int, int]]:
    """Corners (x, y) in reading order: per cell those above the threshold, else all, or the first of the best."""
    height, width = peak.shape
    chosen = []
    for top in range(border, height - border, cell):
        for left in range(border, width - border, cell):
            rows, columns = range(top, min(top + cell, height - border)), range(left, min(left + cell, width - border))
            inside = [(x, y) for y in rows for x in columns if peak[y, x] > 0]
            strong = [(x, y) for x, y in inside if peak[y, x] > threshold]
            weak = [max(inside, key=lambda at: peak[at[1], at[0]])] if inside and only_best else inside
            chosen += strong or weak
    return sorted(chosen, key=lambda at: (at[1], at[0]))


def quadtree(xy: np.ndarray, response: np.ndarray, root: tuple[int, int, int, int], wanted: int) -> list[int]:
    """Rows of the chosen points: nodes as lists of rows, split in rounds, the fullest first."""
    nodes = [(root, list(range(len(xy))))]
    while len(nodes) < wanted:
        before = len(nodes)
        for k in sorted(range(before), key=lambda k: -len(nodes[k][1])):
            box, rows = nodes[k]
            if len(rows) < 2 or len(nodes) >= wanted:
                break
            x, y = (box[0] + box[2]) // 2, (box[1] + box[3]) // 2
            quarters = [(box[0], box[1], x, y), (x, box[1], box[2], y), (box[0], y, x, box[3]), (x, y, box[2], box[3])]
            children = [(q, [r for r in rows if (xy[r][0] >= x, xy[r][1] >= y) == (c % 2 == 1, c >= 2)]) for c, q in enumerate(quarters)]
            children = [child for child in children if child[1]]
            nodes[k] = children[0]
            nodes += children[1:]
        if all(len(rows) < 2 for _, rows in nodes):
            break
    best = [max(rows, key=lambda r: (response[r], -r)) for _, rows in nodes if rows]
    while len(best) > wanted:
        k = min(range(len(best)), key=lambda k: response[best[k]])
        best[k] = best[-1]
        best.pop()
    return sorted(best)


def orientation(image: np.ndarray, x: int, y: int, half_width: np.ndarray) -> float:
    """Direction to the centroid of the disc."""
    m10 = m01 = 0
    for v in range(-15, 16):
        for u in range(-int(half_width[abs(v)]), int(half_width[abs(v)]) + 1):
            m10 += u * int(image[y + v, x + u])
            m01 += v * int(image[y + v, x + u])
    return float(np.arctan2(m01, m10))


def brief(smooth: np.ndarray, x: int, y: int, angle: float, pairs: np.ndarray) -> np.ndarray:
    """Rotated BRIEF of one point, (32,) uint8; sine and cosine in float32 as in OpenCV."""
    cos, sin = np.cos(np.float32(angle)), np.sin(np.float32(angle))
    bits = []
    for pair in pairs.astype(np.float32):
        greys = [smooth[y + int(np.rint(px * sin + py * cos)), x + int(np.rint(px * cos - py * sin))] for px, py in pair]
        bits.append(greys[0] < greys[1])
    return np.packbits(bits, bitorder="little")


def matches(desc_i, desc_j, may_compare, max_distance: int, ratio: float) -> list[tuple[int, int, int]]:
    """Each other's nearest among the pairs that may be compared, by distance and ratio, of equals the first: (i, j, distance)."""
    bits = np.unpackbits(desc_i, axis=1)[:, None] != np.unpackbits(desc_j, axis=1)[None]
    distance = np.where(may_compare, bits.sum(axis=2), 257)
    found = []
    for i in range(len(desc_i)):
        j = int(distance[i].argmin())
        d, others = int(distance[i, j]), np.delete(distance[i], j)
        second = int(others.min()) if len(others) else 257
        if d <= max_distance and d < ratio * second and int(distance[:, j].argmin()) == i:
            found.append((i, j, d))
    return found


def agreeing(turns: list[float]) -> list[bool]:
    """Whether a turn is in one of the three fullest of thirty bins that hold a tenth of the fullest or more."""
    bins = [int(np.floor(turn * 30 / (2 * np.pi) + 0.5)) % 30 for turn in turns]
    count = [bins.count(b) for b in range(30)]
    fullest = sorted(range(30), key=lambda b: -count[b])[:3]
    return [b in fullest and 10 * count[b] >= max(count) for b in bins]


def word_of(children: dict[int, list[int]], centre: np.ndarray, desc: np.ndarray) -> int:
    """The leaf reached by always going to the nearest child."""
    node = 0
    while children.get(node):
        node = min(children[node], key=lambda child: int(np.unpackbits(centre[child] ^ desc).sum()))
    return node


def similarity(a: dict[int, float], b: dict[int, float]) -> float:
    """[Z] (10)."""
    return 0.5 * sum(abs(a.get(w, 0)) + abs(b.get(w, 0)) - abs(a.get(w, 0) - b.get(w, 0)) for w in set(a) | set(b))
