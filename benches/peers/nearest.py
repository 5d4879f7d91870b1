"""The ten nearest of stored latents, by what one would install instead: NumPy, faiss, usearch.

    python nearest.py [ROWS]
    python nearest.py ROWS approximate

Latents of 20 coordinates, as in `cargo bench --bench hot_paths -- scan`: a smooth path of six coordinates, bent. Prints the
median time of a query in microseconds, with the 10 and 90 % quantiles, one thread each. `approximate` searches the latents of
`cargo bench --bench serving -- frames` by the graphs of faiss and usearch, and prints their recall of the ten nearest, too. Needs
numpy, faiss-cpu and usearch.
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


def recording(rows):
    """A path that covers more of the room the longer it is."""
    t = np.arange(rows, dtype=np.float32)[:, None, None] / 50
    axis = np.arange(6)
    column = np.arange(WIDTH)[None, :, None]
    return np.concatenate([np.sin(some / (axis**2 + 2.618) * (1 + column / 7) + axis).sum(axis=2).astype(np.float32)
                           for some in np.array_split(t, max(1, rows // 10_000))])


def approximate(rows):
    latents = recording(rows)
    random = np.random.default_rng(3)
    queries = latents[np.arange(201) * 7_919 % rows] + random.uniform(-0.3, 0.3, (201, WIDTH)).astype(np.float32)
    flat = faiss.IndexFlatL2(WIDTH)
    flat.add(latents)
    truth = flat.search(queries, NEAREST)[1]

    graph = faiss.IndexHNSWFlat(WIDTH, 16)
    graph.hnsw.efConstruction = 200
    began = time.perf_counter()
    graph.add(latents)
    print(f"faiss HNSW, M 16: built in {time.perf_counter() - began:.0f} s by all threads")
    began = time.perf_counter()
    other = usearch.index.Index(ndim=WIDTH, metric="l2sq", dtype="f32", connectivity=16, expansion_add=200)
    other.add(np.arange(rows), latents)
    print(f"usearch, M 16: built in {time.perf_counter() - began:.0f} s by all threads, {other.memory_usage / rows:.0f} bytes a row")

    faiss.omp_set_num_threads(1)
    for effort in (16, 64, 256):
        graph.hnsw.efSearch = effort
        other.expansion_search = effort
        searches = {
            "faiss HNSW": lambda query: graph.search(query[None], NEAREST)[1][0],
            "usearch": lambda query: other.search(query, NEAREST, threads=1).keys,
        }
        for name, search in searches.items():
            found, times = [], []
            for query in queries:
                began = time.perf_counter()
                found.append(search(query))
                times.append((time.perf_counter() - began) * 1e6)
            recall = np.mean([len({*map(int, a)} & {*map(int, b)}) / NEAREST for a, b in zip(found, truth)])
            print(f"{name}, ef {effort}: {np.median(times):.0f} us, recall {recall:.4f}")


def main():
    rows = int(sys.argv[1]) if len(sys.argv) > 1 else 5000
    if "approximate" in sys.argv:
        approximate(rows)
        return
    faiss.omp_set_num_threads(1)
    latents = path(rows)
    query = (0.4 * latents[rows // 3] + 0.6 * latents[rows // 2])[None]
    flat = faiss.IndexFlatL2(WIDTH)
    flat.add(latents)

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
