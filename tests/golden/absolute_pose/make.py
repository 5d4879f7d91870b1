"""Camera poses from points and image points with outliers. Oracle: PoseLib's LO-RANSAC over P3P with its
refinement, on the plane at depth 1 (a pinhole camera of the given focal length)."""
import sys
from pathlib import Path
import numpy as np, poselib
HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE.parent))
from common import dump, versions
from scipy.spatial.transform import Rotation

FOCAL = 260.0                                       # pixels of an image 320 wide


def case(r, name, count, outliers, noise, planar=False):
    turn = r.normal(size=3); turn *= r.uniform(.1, 2.5) / np.linalg.norm(turn)
    R = Rotation.from_rotvec(turn).as_matrix(); C = r.normal(size=3) * 2   # world_from_camera
    plane = np.c_[r.uniform(-.6, .6, count), r.uniform(-.45, .45, count)]
    depth = r.uniform(1.5, 6, count)
    if planar: depth = 3 / (1 - .2 * plane[:, 0] - .1 * plane[:, 1])
    world = np.c_[plane, np.ones(count)] * depth[:, None] @ R.T + C
    seen = plane + r.normal(size=plane.shape) * noise / FOCAL
    wrong = r.permutation(count)[:int(outliers * count)]
    seen[wrong] = np.c_[r.uniform(-.6, .6, len(wrong)), r.uniform(-.45, .45, len(wrong))]
    threshold = 2.5 if noise else .5               # pixels
    camera = dict(model="SIMPLE_PINHOLE", width=320, height=240, params=[FOCAL, 0., 0.])
    found, info = poselib.estimate_absolute_pose(
        seen * FOCAL, world, camera,
        dict(max_error=threshold, min_iterations=1000, max_iterations=10000, seed=1),
        dict(loss_type="TRUNCATED", loss_scale=threshold, max_iterations=100, gradient_tol=1e-14, step_tol=1e-14))
    found = getattr(found, "pose", found)
    T = np.eye(4); T[:3, :3] = found.R.T; T[:3, 3] = -found.R.T @ found.t
    truth = np.eye(4); truth[:3, :3] = R; truth[:3, 3] = C
    off = np.linalg.norm(T[:3, 3] - C), Rotation.from_matrix(R.T @ T[:3, :3]).magnitude()
    print(name, off, sum(info["inliers"]))
    return dict(name=name, world=world, plane=seen, world_from_camera=T, truth=truth,
                inliers=int(np.sum(info["inliers"])), threshold_px=threshold, median_depth=float(np.median(depth)))


r = np.random.default_rng(20261)
cases = [case(r, "exact, no outliers", 40, 0, 0), case(r, "exact, half outliers", 100, .5, 0),
         case(r, "exact, 70 % outliers", 120, .7, 0), case(r, "exact, a plane, half outliers", 100, .5, 0, True),
         case(r, "0.3 pixels, half outliers", 120, .5, .3), case(r, "0.7 pixels, 30 % outliers", 120, .3, .7)]
dump(HERE / "expected.json", dict(versions=versions("poselib", "numpy", "scipy"), focal_px=FOCAL, cases=cases))
