"""A peer of matched views: SIFT, VLAD, points triangulated with the known poses, and PoseLib.

    python peer.py             fails if a module is missing
    python peer.py REQUEST     prints a line of JSON for each query: world_from_camera, or null

REQUEST is a JSON file: `camera` (lengths in image widths), `mapped` (image and world_from_camera)
and `queries` (image). Poses are 3x4 matrices by rows; cameras look along z, with y down.
"""

import json
import sys

try:
    import cv2
    import numpy as np
    import poselib
except ImportError as error:
    sys.exit(str(error))

WIDTH = 640  # wider images are reduced to this width
FEATURES = 2000  # keypoints of an image
RATIO = 0.8  # Lowe's ratio test
CENTERS = 64  # of VLAD
RETRIEVED = (4, 10)  # mapped frames that a query is matched with; more if there is no answer
NEIGHBORS = 10  # mapped frames that a mapped frame is matched with ...
NEIGHBOR_STEP = 3  # ... every third of the most similar ones, for baselines of several lengths
MAX_ERROR_PX = 4.0  # of a triangulated point in the images that it is triangulated from
MIN_ANGLE_RAD = np.radians(1.5)  # between two rays of a point, as in COLMAP
MIN_INLIERS = 30  # different keypoints of the query that agree with an answer


class Frame:
    """SIFT features of an image. `rays` are undistorted, on the plane at depth 1."""

    def __init__(self, sift, camera, file):
        image = cv2.imread(file, cv2.IMREAD_GRAYSCALE)
        if image is None:
            sys.exit(f"{file} is not an image that OpenCV reads")
        if image.shape[1] > WIDTH:
            height = round(image.shape[0] * WIDTH / image.shape[1])
            image = cv2.resize(image, (WIDTH, height), interpolation=cv2.INTER_AREA)

        keypoints, descriptors = sift.detectAndCompute(image, None)
        # The center of the first pixel is (0, 0) in OpenCV, and (0.5, 0.5) in the request.
        points = np.array([keypoint.pt for keypoint in keypoints]).reshape(-1, 2) + 0.5
        self.rays = undistorted(points / image.shape[1], camera)
        descriptors = np.zeros((0, 128), np.float32) if descriptors is None else descriptors
        # RootSIFT: unit vectors, whose distance is Hellinger's.
        sums = np.maximum(descriptors.sum(1, keepdims=True), 1e-9)
        self.descriptors = np.sqrt(descriptors / sums)


def undistorted(points, camera):
    """Rays (n, 2) of image points (n, 2)."""
    if len(points) == 0:
        return points
    (fx, fy), (cx, cy) = camera["focal"], camera["center"]
    matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    lens = camera["distortion"]
    undistort = cv2.fisheye.undistortPoints if lens["model"] == "kannala_brandt" else cv2.undistortPoints
    coefficients = np.array(lens.get("coefficients", [0.0] * 4))
    return undistort(points[:, None], matrix, coefficients).reshape(-1, 2)


def match(a, b):
    """Pairs (rows of a, rows of b) of mutually nearest descriptors that pass the ratio test."""
    if len(a) < 2 or len(b) < 2:
        return np.zeros((2, 0), int)
    cosines = a @ b.T
    rows = np.arange(len(a))
    best = cosines.argmax(1)
    is_mutual = cosines.argmax(0)[best] == rows
    first = cosines[rows, best]
    cosines[rows, best] = -1
    second = cosines.max(1)
    # Squared distances of unit vectors are 2 - 2 cos.
    is_clear = (1 - first) < RATIO**2 * (1 - second)
    kept = np.flatnonzero(is_mutual & is_clear)
    return np.stack([kept, best[kept]])


def vlad(descriptors, centers):
    """VLAD: unit vector of the differences from the nearest centers."""
    nearest = (descriptors @ centers.T - (centers**2).sum(1) / 2).argmax(1)
    sums = np.zeros_like(centers)
    np.add.at(sums, nearest, descriptors - centers[nearest])
    sums /= np.maximum(np.linalg.norm(sums, axis=1, keepdims=True), 1e-9)
    return sums.ravel() / np.sqrt(len(centers))


def triangulated(frame, pose, others, focal_px):
    """World points (n, 3) of a frame's keypoints, NaN where there are none.

    `others` are (frame, pose, matches) of the neighbors. A point is the one nearest to its rays,
    weighted by inverse squared depth, so that angles count.
    """
    views = [(frame.rays, pose, np.tile(np.arange(len(frame.rays)), (2, 1)))]
    views += [(other.rays, pose, matches) for other, pose, matches in others]
    shape = (len(views), len(frame.rays))
    seen = np.zeros(shape, bool)
    rays = np.zeros((*shape, 2))
    for view, (other_rays, _, (ours, theirs)) in enumerate(views):
        seen[view, ours] = True
        rays[view, ours] = other_rays[theirs]

    rotations = np.stack([pose[:, :3] for _, pose, _ in views])
    centers = np.stack([pose[:, 3] for _, pose, _ in views])
    local = np.concatenate([rays, np.ones((*shape, 1))], 2)
    directions = np.einsum("vij,vnj->vni", rotations, local)
    directions /= np.linalg.norm(directions, axis=2, keepdims=True)
    projectors = np.eye(3) - directions[..., :, None] * directions[..., None, :]

    weights = seen.astype(float)
    for step in range(4):
        normal = np.einsum("vn,vnij->nij", weights, projectors) + 1e-9 * np.eye(3)
        right = np.einsum("vn,vnij,vj->ni", weights, projectors, centers)
        points = np.linalg.solve(normal, right[..., None])[..., 0]
        in_camera = np.einsum("vij,vni->vnj", rotations, points - centers[:, None])
        depth = np.where(in_camera[..., 2] > 1e-6, in_camera[..., 2], np.inf)
        errors = focal_px * np.linalg.norm(in_camera[..., :2] / depth[..., None] - rays, axis=2)
        is_good = seen & np.isfinite(depth) & (errors < MAX_ERROR_PX)
        # The last two steps leave out views that disagree with the first ones.
        weights = np.where(is_good if step > 1 else seen, 1 / depth**2, 0)
        weights /= np.maximum(weights.max(0), 1e-30)

    cosines = np.where(is_good, np.einsum("vni,ni->vn", directions, directions[0]), 1).min(0)
    is_point = is_good[0] & (is_good.sum(0) > 1) & (cosines < np.cos(MIN_ANGLE_RAD))
    return np.where(is_point[:, None], points, np.nan)


def mapped_points(frames, poses, similarity, focal_px):
    """The points of all mapped frames."""
    order = np.argsort(-similarity, axis=1)[:, 1 : 1 + NEIGHBORS * NEIGHBOR_STEP : NEIGHBOR_STEP]
    pairs = {tuple(sorted((a, int(b)))) for a in range(len(frames)) for b in order[a]}
    others = [[] for _ in frames]
    for a, b in pairs:
        matches = match(frames[a].descriptors, frames[b].descriptors)
        others[a].append((frames[b], poses[b], matches))
        others[b].append((frames[a], poses[a], matches[::-1]))
    return [triangulated(*of, focal_px) for of in zip(frames, poses, others)]


def located(query, frames, points, similar, camera):
    """world_from_camera of a query, or None."""
    seen, found = [np.zeros(0, int)], [np.zeros((0, 3))]
    for row in similar:
        ours, theirs = match(query.descriptors, frames[row].descriptors)
        is_mapped = np.isfinite(points[row][theirs, 0])
        seen.append(ours[is_mapped])
        found.append(points[row][theirs[is_mapped]])
    seen, found = np.concatenate(seen), np.concatenate(found)
    if len(np.unique(seen)) < MIN_INLIERS:
        return None

    width, height = camera["width"], camera["height"]
    center = np.array([width, height]) / 2
    pinhole = {"model": "SIMPLE_PINHOLE", "width": width, "height": height}
    pinhole["params"] = [camera["focal_px"], *center]
    pixels = query.rays[seen] * camera["focal_px"] + center
    pose, report = poselib.estimate_absolute_pose(pixels, found, pinhole, {}, {})
    if len(np.unique(seen[np.asarray(report["inliers"], bool)])) < MIN_INLIERS:
        return None
    return np.column_stack([pose.R.T, -pose.R.T @ pose.t])


def main():
    with open(sys.argv[1], encoding="utf-8") as file:
        request = json.load(file)
    camera = request["camera"]
    # Undistorted rays are given to PoseLib as pixels of a pinhole of this focal length.
    camera["width"], camera["height"] = WIDTH, round(WIDTH * camera["height"])
    camera["focal_px"] = WIDTH * sum(camera["focal"]) / 2
    sift = cv2.SIFT_create(nfeatures=FEATURES, enable_precise_upscale=True)

    frames = [Frame(sift, camera, frame["image"]) for frame in request["mapped"]]
    poses = [np.array(frame["world_from_camera"]) for frame in request["mapped"]]
    sample = np.concatenate([frame.descriptors for frame in frames])
    sample = np.random.default_rng(0).permutation(sample)[:20_000]
    cv2.setRNGSeed(0)
    criteria = (cv2.TERM_CRITERIA_MAX_ITER, 20, 0)
    count = min(CENTERS, len(sample))
    centers = cv2.kmeans(sample, count, None, criteria, 1, cv2.KMEANS_PP_CENTERS)[2]

    global_features = np.stack([vlad(frame.descriptors, centers) for frame in frames])
    similarity = global_features @ global_features.T
    np.fill_diagonal(similarity, np.inf)
    points = mapped_points(frames, poses, similarity, camera["focal_px"])

    for query in request["queries"]:
        query = Frame(sift, camera, query["image"])
        similar = np.argsort(-global_features @ vlad(query.descriptors, centers))
        pose = None
        for count in RETRIEVED:
            if pose is None:
                pose = located(query, frames, points, similar[:count], camera)
        print(json.dumps(None if pose is None else pose.tolist()), flush=True)


if len(sys.argv) > 1:
    main()
