"""The classical peer of the two-view reader: SIFT, an essential matrix, and the true length.

    seese3 export numpy --store STORE --room ROOM --out FOLDER
    python two_view_sift.py FOLDER --stride 10 [--width 320] [--focal WIDTHS] [--every N]
    python two_view_sift.py FOLDER --stride 9 --drift [--sequence 1]

Reads the pairs that `seese3 evaluate motion --stride 10` reads, or every N-th of them, and prints the same errors: medians and
90 % quantiles in meters and degrees. SIFT (2,000 features, ratio test at 0.8) and MAGSAC with a threshold
of one pixel in 640; a pair with fewer than 8 matches or inliers counts as no motion. An essential matrix
has no scale: the true length of the translation is given to it. Also prints the median times of one thread. Needs numpy and
opencv-python-headless.

With --drift it composes the motions of successive pairs of a sequence, and prints the mean drift of the path as
`seese3 evaluate odometry` does: over parts of 0.5, 1, 2 and 4 m, per meter.
"""

import argparse
import json
import pathlib
import time

import cv2
import numpy as np


def angle(rotation):
    return np.degrees(np.arccos(np.clip((np.trace(rotation) - 1) / 2, -1, 1)))


def relative(first, second):
    """The second camera in the frame of the first."""
    return np.linalg.inv(first) @ second


def read(first, second, camera, width, true_length):
    """Rotation and translation from two sets of keypoints, or none."""
    (points, descriptors), (other_points, other_descriptors) = first, second
    if descriptors is None or other_descriptors is None:
        return None
    pairs = cv2.BFMatcher().knnMatch(descriptors, other_descriptors, k=2)
    good = [p[0] for p in pairs if len(p) == 2 and p[0].distance < 0.8 * p[1].distance]
    if len(good) < 8:
        return None
    x = np.float64([points[m.queryIdx].pt for m in good])
    y = np.float64([other_points[m.trainIdx].pt for m in good])
    essential, inliers = cv2.findEssentialMat(
        x, y, camera, cv2.USAC_MAGSAC, 0.999, width / 640
    )
    if essential is None or essential.shape != (3, 3) or inliers.sum() < 8:
        return None
    _, rotation, translation, _ = cv2.recoverPose(essential, x, y, camera, mask=inliers)

    # recoverPose gives second_from_first: x2 = R x1 + t.
    motion = np.eye(4)
    motion[:3, :3] = rotation.T
    motion[:3, 3] = true_length * (-rotation.T @ translation)[:, 0]
    return motion


def drift(truth, estimated):
    """Mean errors of the position, percent, and of the rotation, degrees per meter, over parts of a path."""
    steps = [np.linalg.norm(b[:3, 3] - a[:3, 3]) for a, b in zip(truth, truth[1:])]
    way = np.concatenate([[0.0], np.cumsum(steps)])
    errors = []
    for start in range(len(truth)):
        for length in (0.5, 1.0, 2.0, 4.0):
            end = int(np.searchsorted(way, way[start] + length))
            if end < len(truth):
                off = relative(relative(estimated[start], estimated[end]), relative(truth[start], truth[end]))
                errors.append(np.array([100 * np.linalg.norm(off[:3, 3]), angle(off[:3, :3])]) / (way[end] - way[start]))
    return np.mean(errors, axis=0)


def main():
    options = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    options.add_argument("folder", type=pathlib.Path)
    options.add_argument("--stride", type=int, default=10)
    options.add_argument("--width", type=int, default=0, help="resize images to this width")
    options.add_argument("--focal", type=float, help="focal length in image widths")
    options.add_argument("--every", type=int, default=1, help="read every so many pairs")
    options.add_argument("--drift", action="store_true", help="compose the motions of successive pairs")
    options.add_argument("--sequence", type=int, default=0, help="the sequence of --drift")
    given = options.parse_args()

    bundle = json.loads((given.folder / "bundle.json").read_text())
    poses = np.load(given.folder / "poses.npy")
    root = pathlib.Path(bundle["images_root"])
    root = root if root.is_absolute() else given.folder / root
    sequences = bundle["sequences"] or [0] * len(poses)
    stated = bundle.get("camera")
    if stated is None and given.focal is None:
        raise SystemExit("the room states no camera: give --focal, fx in pixels over the image's width")
    if stated and stated["distortion"]["model"] != "none":
        raise SystemExit("the room's camera has a distorted lens, which this program does not undistort")
    fx, fy = (given.focal, given.focal) if given.focal else stated["focal"]

    cv2.setNumThreads(1)
    sift = cv2.SIFT_create(2000)
    found = {}
    times = {"detecting in an image": [], "matching and fitting of a pair": []}

    def features(row):
        if row not in found:
            image = cv2.imread(str(root / bundle["images"][row]), cv2.IMREAD_GRAYSCALE)
            if given.width:
                size = (given.width, round(image.shape[0] * given.width / image.shape[1]))
                image = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
            began = time.perf_counter()
            found[row] = (*sift.detectAndCompute(image, None), image.shape)
            times["detecting in an image"].append(time.perf_counter() - began)
            found.pop(row - 200, None)
        return found[row]

    errors, still, failed = [], [], 0
    rows = range(0, len(poses) - given.stride, given.every)
    if given.drift:
        rows = range(sequences.index(given.sequence), len(poses) - given.stride, given.stride)
        rows = [row for row in rows if sequences[row] == given.sequence]
    path = [np.eye(4)]
    for row in rows:
        if sequences[row] != sequences[row + given.stride]:
            continue
        truth = relative(poses[row], poses[row + given.stride])
        *first, (height, width) = features(row)
        *second, _ = features(row + given.stride)
        # OpenCV puts the center of the first pixel at (0, 0), the room at (0.5, 0.5).
        x, y = np.multiply(stated["center"], width) - 0.5 if stated else ((width - 1) / 2, (height - 1) / 2)
        camera = np.array([[fx * width, 0, x], [0, fy * width, y], [0, 0, 1.0]])
        began = time.perf_counter()
        motion = read(first, second, camera, width, np.linalg.norm(truth[:3, 3]))
        times["matching and fitting of a pair"].append(time.perf_counter() - began)
        failed += motion is None
        path.append(path[-1] @ (np.eye(4) if motion is None else motion))
        off = relative(np.eye(4) if motion is None else motion, truth)
        errors.append((np.linalg.norm(off[:3, 3]), angle(off[:3, :3])))
        still.append((np.linalg.norm(truth[:3, 3]), angle(truth[:3, :3])))

    print(f"{len(errors)} pairs, {failed} without an answer")
    print(", ".join(f"{what} {1000 * np.median(seconds):.1f} ms" for what, seconds in times.items()))
    if given.drift:
        truth = [poses[rows[0] + given.stride * step] for step in range(len(path))]
        percent, degrees = drift(truth, path)
        print(f"SIFT, with the true lengths: drift {percent:.1f} %, {degrees:.2f} degrees per meter")
        return
    print("motion by                          median m  90 % m  median °  90 % °")
    for name, rows in (("SIFT, with the true length", errors), ("no motion", still)):
        meters, degrees = np.array(rows).T
        q = lambda values, share: np.quantile(values, share)
        print(
            f"{name:34} {q(meters, .5):8.4f} {q(meters, .9):7.3f}"
            f" {q(degrees, .5):9.2f} {q(degrees, .9):7.1f}"
        )


if __name__ == "__main__":
    main()
