"""Checks what the README and the docs claim against the JSON that the program wrote. No packages needed but pandas, for one of them."""

import array
import ast
import json
import pathlib
import sys

# PyTorch, 200 epochs, seeds 0 to 4 (docs/reference.md): R², Hit@0.1 of inverse Poincaré and its deviation.
REFERENCE = {
    ("effnet", 10, "pairs"): (0.789, 0.996, 0.0),
    ("effnet", 20, "pairs"): (0.938, 0.989, 0.0),
    ("effnet", 40, "pairs"): (0.981, 0.930, 0.013),
    ("xfeat", 10, "pairs"): (0.933, 1.000, 0.0),
    ("xfeat", 20, "pairs"): (0.978, 0.993, 0.0),
    ("xfeat", 40, "pairs"): (0.991, 0.928, 0.010),
}
TIME_SPLIT = {
    ("effnet", 10): -9.30, ("effnet", 20): -7.25, ("effnet", 40): -9.79,
    ("xfeat", 10): -3.58, ("xfeat", 20): -2.74, ("xfeat", 40): -4.28,
}


def rows(path):
    table = json.loads(pathlib.Path(path).read_text())
    return {row["name"]: row for row in table["navigators"]}


def demo(path):
    """Inverse Poincaré above Identity at ε 0.1 and 0.2, paired, and its interval above the rate of a random frame."""
    table = rows(path)
    for epsilon in ("0.1", "0.2"):
        inverse = [table[f"inverse-poincare-{reading}"] for reading in ("affine", "homogeneous")]
        over = min(row["hit_over_identity"][epsilon]["low"] for row in inverse)
        low = min(row["hit"][epsilon]["low"] for row in inverse)
        random = table["random"]["hit"][epsilon]["rate"]
        print(f"Hit@{epsilon}: inverse over identity from {over:+.3f}; inverse from {low:.3f}, random {random:.3f}")
        assert over > 0.0, f"the interval of the difference to identity contains 0 at {epsilon}"
        assert low > random, f"the interval contains the rate of random frames at {epsilon}"


def kitchen(folder):
    """Mean test R² within 0.02 and Hit@0.1 within two deviations (at least 0.02) of the reference."""
    for (features, stride, split), (r2, hit, deviation) in REFERENCE.items():
        runs = json.loads((folder / f"{features}-{stride}-{split}.json").read_text())["runs"]
        found_r2 = sum(run["test"]["r2"]["overall"] for run in runs) / len(runs)
        found_hit = sum(run["inverse_poincare_affine"]["hit"]["0.1"]["rate"] for run in runs) / len(runs)
        print(f"{features} {stride} {split}: R² {found_r2:.3f} (reference {r2}), Hit@0.1 {found_hit:.3f} ({hit})")
        assert abs(found_r2 - r2) <= 0.02
        assert abs(found_hit - hit) <= max(0.02, 2 * deviation)
    for (features, stride), reference in TIME_SPLIT.items():
        runs = json.loads((folder / f"{features}-{stride}-time.json").read_text())["runs"]
        found = sum(run["test"]["r2"]["overall"] for run in runs) / len(runs)
        print(f"{features} {stride} time: R² {found:.2f} (reference {reference}; out of distribution, not gated)")


def two_views(folder):
    """The motion between two photographs is read better than as none, in metres and in degrees (docs/two-views.md)."""
    for stride in (1, 2, 4):
        found = json.loads((folder / f"motion-{stride}.json").read_text())
        for unit in ("translation_m", "rotation_deg"):
            for share in ("median", "p90"):
                ours, still = (found[row][unit][share] for row in ("two_view", "no_motion"))
                print(f"stride {5 * stride}, {unit} {share}: {ours:.3f}, no motion {still:.3f}")
                assert ours < still
        degrees = found["two_view"]["rotation_deg"]["median"]
        assert degrees < 0.3 * found["no_motion"]["rotation_deg"]["median"] or stride == 1, degrees


def localization(folder):
    """A fitted adapter is nowhere farther from the truth than the nearest frame, and XFeat's target (docs/localization.md)."""
    for features in ("effnet", "xfeat"):
        for mapped in ("every", "blocks", "dense"):
            found = json.loads((folder / f"located-{features}-{mapped}.json").read_text())
            ours, nearest = (found[row]["translation_m"]["median"] for row in ("ours", "nearest_frame"))
            print(f"{features} {mapped}: ours {ours:.4f} m, nearest frame {nearest:.4f} m, of {found['n']} views")
            assert ours <= nearest
            if (features, mapped) == ("xfeat", "every"):
                assert ours <= 0.02 and found["ours"]["rotation_deg"]["median"] <= 0.8


def npy(path):
    """Rows of a float32 NumPy file (n, d) in C order."""
    content = path.read_bytes()
    size = int.from_bytes(content[8:10], "little")
    header = ast.literal_eval(content[10:10 + size].decode())
    assert header["descr"] == "<f4" and not header["fortran_order"], header
    (count, columns), numbers = header["shape"], array.array("f", content[10 + size:])
    return [numbers[row * columns:(row + 1) * columns] for row in range(count)]


# Our features of the kitchen, its published ones, and how far a row may be from its own, of its length.
FEATURES = [
    ("effnetlite0-block14-mean", "effnetlite0_block14_gap", 0.025),
    ("xfeat-block4-grid2x2", "xfeat_block4_p2x2", 0.01),
    ("xfeat-block5-grid4x4", "xfeat_block5_p4x4", 0.01),
    ("pixels", "pixels_rgb16x12", 0.003),
]


def features(ours, published):
    """Every photograph's features are the published ones, but for the JPEG decoder and the resize filter's rounding."""
    for name, reference, bound in FEATURES:
        found, expected = npy(ours / f"features_{name}.npy"), npy(published / f"features_{reference}.npy")
        assert len(found) == len(expected) == 1000
        off = []
        for a, b in zip(found, expected):
            off.append((sum((x - y) ** 2 for x, y in zip(a, b)) / sum(y * y for y in b)) ** 0.5)
        off.sort()
        print(f"{name}: median {100 * off[500]:.2f} %, at most {100 * off[-1]:.2f} % of a feature's length off")
        assert off[-1] <= bound


def sweep(file, count):
    """pandas opens a sweep's table: a row a run, every one with scores."""
    try:
        import pandas
    except ImportError:
        print("SKIPPED the sweep's table: no pandas")
        return
    table = pandas.read_parquet(file)
    print(table.groupby(["geo_dim", "charts", "loss"])["r2_overall"].agg(["mean", "std", "count"]))
    assert len(table) == count and table["key"].is_unique and (table["failure"] == "").all()
    assert table["r2_overall"].notna().all() and set(table["geo_dim"]) == {10, 20}


if __name__ == "__main__":
    if sys.argv[1] == "demo":
        demo(sys.argv[2])
    elif sys.argv[1] == "sweep":
        sweep(sys.argv[2], int(sys.argv[3]))
    elif sys.argv[1] == "features":
        features(pathlib.Path(sys.argv[2]), pathlib.Path(sys.argv[3]))
    elif sys.argv[1] == "two_views":
        two_views(pathlib.Path(sys.argv[2]))
    elif sys.argv[1] == "localization":
        localization(pathlib.Path(sys.argv[2]))
    else:
        kitchen(pathlib.Path(sys.argv[2]))
