"""The ten nearest of stored latents, by what one would install instead: NumPy, faiss, usearch.

    python nearest.py [ROWS]

Latents of 20 coordinates, as in `cargo bench --bench hot_paths -- scan`: a smooth path of six coordinates, bent. Prints the
median time of a query in microseconds, with the 10 and 90 % quantiles, one thread each. Needs numpy, faiss-cpu and usearch.
"""

import sys
import time

import faiss
import numpy as np
import usearch.index

WIDTH, NEAREST, ROUNDS = 20, 10, 2000


def path(rows):
    t = np.arange(rows)[:, None, None] / 50
    axis = np.arange(6)
    column = np.arange(WIDTH)[None, :, None]
    return np.sin(t / (axis + 2) * (1 + column / 7) + axis).sum(axis=2).astype(np.float32)


def main():
    rows = int(sys.argv[1]) if len(sys.argv) > 1 else 5000
    latents = path(rows)
    query = (0.4 * latents[rows // 3] + 0.6 * latents[rows // 2])[None]
    flat = faiss.IndexFlatL2(WIDTH)
    flat.add(latents)
    faiss.omp_set_num_threads(1)

    def numpy():
        squares = ((latents - query) ** 2).sum(axis=1)
        nearest = np.argpartition(squares, NEAREST)[:NEAREST]
        return nearest[np.argsort(squares[nearest])]

    peers = {
        "NumPy": numpy,
        "faiss IndexFlatL2": lambda: flat.search(query, NEAREST)[1][0],
        "usearch exact": lambda: usearch.index.search(
            latents, query[0], NEAREST, usearch.index.MetricKind.L2sq, exact=True, threads=1
        ).keys,
    }
    first = None
    for name, search in peers.items():
        found = [int(frame) for frame in search()]
        first = first or found
        times = []
        for _ in range(ROUNDS):
            began = time.perf_counter()
            search()
            times.append((time.perf_counter() - began) * 1e6)
        low, middle, high = np.quantile(times, [0.1, 0.5, 0.9])
        same = "the same frames" if found == first else f"other frames: {found}"
        print(f"{name}: {middle:.1f} [{low:.1f}, {high:.1f}] us, {same}")


main()
