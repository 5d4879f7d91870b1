"""M1 to M3 by scikit-learn and scikit-dimension.

    python probes.py [ROWS COLUMNS]

The data of `cargo bench --bench hot_paths -- probes`: a smooth path bent into many columns, with noise. M1: cosine neighbors among features
and Euclidean ones among nine numbers, k = 10, without 10 frames to each side. M2: TwoNN and MLE over 20 neighbors. M3: ridge
regression from differences at stride 10. The libraries choose their
threads. Prints the median of three runs in milliseconds. Needs numpy, scikit-learn
and scikit-dimension.
"""

import sys
import time

import numpy as np
import skdim
from sklearn.linear_model import Ridge
from sklearn.neighbors import NearestNeighbors

K, GAP, STRIDE = 10, 10, 10


def bent_path(rows, columns):
    t = np.arange(rows)[:, None] / rows
    c = np.arange(columns)[None, :]
    noise = np.random.default_rng(5).uniform(-0.05, 0.05, (rows, columns))
    return (np.sin(40 * t * (1 + c % 7) + c) + noise).astype(np.float32)


def mutual(features, poses):
    def neighbors(rows, metric):
        wanted = K + 2 * GAP + 1
        found = NearestNeighbors(n_neighbors=wanted, metric=metric).fit(rows).kneighbors(rows, return_distance=False)
        for row, frames in enumerate(found):
            yield {*frames[np.abs(frames - row) > GAP][:K]}

    pairs = zip(neighbors(features, "cosine"), neighbors(poses, "euclidean"))
    return np.mean([len(a & b) / K for a, b in pairs])


def dimension(features):
    return skdim.id.TwoNN().fit(features).dimension_, skdim.id.MLE().fit(features, n_neighbors=20).dimension_


def regression(features, poses):
    motions = poses[STRIDE:, :6] - poses[:-STRIDE, :6]
    moved = features[STRIDE:].astype(np.float64) - features[:-STRIDE]
    part = len(moved) * 4 // 5
    return Ridge(alpha=1.0).fit(moved[:part], motions[:part]).score(moved[part:], motions[part:])


def main():
    rows, columns = (int(word) for word in sys.argv[1:]) if len(sys.argv) == 3 else (5_000, 768)
    features, poses = bent_path(rows, columns), bent_path(rows, 9).astype(np.float64)
    for name, probe in {
        "M1": lambda: mutual(features, poses),
        "M2": lambda: dimension(features),
        "M3": lambda: regression(features, poses),
    }.items():
        times = []
        for _ in range(3):
            began = time.perf_counter()
            probe()
            times.append((time.perf_counter() - began) * 1e3)
        print(f"{name}, {rows} x {columns}: {sorted(times)[1]:.0f} [{min(times):.0f}, {max(times):.0f}] ms")


main()
