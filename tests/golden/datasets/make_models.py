"""Tiny rooms of six frames as COLMAP, nerfstudio, KITTI and EuRoC write them, with the poses that a reader must return.
Oracle: COLMAP's own library (pycolmap) writes the model; the other files are written by NumPy and SciPy from the definition of each format. The expected poses are those that the files were made from.
Run: python make_models.py (pycolmap 4.2.1, numpy, scipy, pillow)."""
import json
from pathlib import Path

import numpy as np
import pycolmap
from PIL import Image
from scipy.spatial.transform import Rotation

HERE = Path(__file__).resolve().parent
COUNT = 6

# world_from_camera, x right, y down, z forward: a made-up motion with all axes in it.
POSES = np.tile(np.eye(4), (COUNT, 1, 1))
POSES[:, :3, :3] = Rotation.from_rotvec(0.3 * np.random.default_rng(3).standard_normal((COUNT, 3))).as_matrix()
POSES[:, :3, 3] = np.random.default_rng(4).standard_normal((COUNT, 3))


def image(path):
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.full((6, 8, 3), 90, np.uint8)).save(path, optimize=True)


# COLMAP: frames 0, 1, 10 and 2 in the order of letters; the last one's file is missing.
names = [f"img_{n}.png" for n in (0, 1, 2, 3, 10, 11)]
for name in names[:-1]:
    image(HERE / "colmap/images" / name)
model = pycolmap.Reconstruction()
model.add_camera_with_trivial_rig(pycolmap.Camera(model="SIMPLE_RADIAL", width=8, height=6, params=[7.5, 4, 3, 0.01], camera_id=1))
for number, (name, pose) in enumerate(zip(names, POSES), 1):
    inverse = np.linalg.inv(pose)
    frame = pycolmap.Image(name=name, camera_id=1, image_id=number)
    frame.points2D = pycolmap.Point2DList([pycolmap.Point2D(np.array([1.0, 2.0]))] * (number % 3))
    model.add_image_with_trivial_frame(frame, pycolmap.Rigid3d(pycolmap.Rotation3d(inverse[:3, :3]), inverse[:3, 3]))
for kind, write in (("sparse/0", model.write_binary), ("text", model.write_text)):
    folder = HERE / "colmap" / kind
    folder.mkdir(parents=True, exist_ok=True)
    write(str(folder))
    for file in folder.iterdir():
        if file.stem not in ("cameras", "images"):
            file.unlink()

# nerfstudio: OpenGL's axes, frames out of order.
frames = []
for number in (4, 0, 2, 5, 1, 3):
    image(HERE / f"transforms/images/f{number + 8}.png")
    matrix = POSES[number] @ np.diag([1.0, -1.0, -1.0, 1.0])
    frames.append({"file_path": f"./images/f{number + 8}.png", "transform_matrix": matrix.tolist()})
transforms = {"w": 8, "h": 6, "fl_x": 7.5, "fl_y": 7.5, "cx": 4.0, "cy": 3.0, "frames": frames}
(HERE / "transforms/transforms.json").write_text(json.dumps(transforms, indent=1))

# KITTI.
for number in range(COUNT):
    image(HERE / f"kitti/image_2/{number:06d}.png")
np.savetxt(HERE / "kitti/poses.txt", POSES[:, :3].reshape(COUNT, 12), fmt="%.12e")
np.savetxt(HERE / "kitti/times.txt", 0.1 * np.arange(COUNT))

# EuRoC: the body's poses 3 ms after the images; the last image has none.
mav = HERE / "euroc/mav0"
body_from_camera = np.eye(4)
body_from_camera[:3, :3] = Rotation.from_euler("xyz", [90, 10, 80], degrees=True).as_matrix()
body_from_camera[:3, 3] = [0.1, -0.2, 0.05]
stamps = [10**18 + 50_000_000 * number for number in range(COUNT)]
for stamp in stamps:
    image(mav / f"cam0/data/{stamp}.png")
(mav / "cam0/data.csv").write_text("#timestamp [ns],filename\r\n" + "".join(f"{s},{s}.png\r\n" for s in stamps))
numbers = ", ".join(repr(float(x)) for x in body_from_camera.reshape(-1))
(mav / "cam0/sensor.yaml").write_text(
    f"sensor_type: camera\nT_BS:\n  cols: 4\n  rows: 4\n  data: [{numbers}]\nrate_hz: 20\n"
    "resolution: [8, 6]\ncamera_model: pinhole\nintrinsics: [7.5, 7.5, 4.0, 3.0] #fu, fv, cu, cv\n")
rows = ["#timestamp, p_RS_R_x [m], ...\n"]
for stamp, pose in list(zip(stamps, POSES))[:-1]:
    body = pose @ np.linalg.inv(body_from_camera)
    x, y, z, w = Rotation.from_matrix(body[:3, :3]).as_quat()
    rows.append(",".join(map(repr, map(float, [*body[:3, 3], w, x, y, z, 0, 0, 0]))))
    rows[-1] = f"{stamp + 3_000_000},{rows[-1]}\n"
(mav / "state_groundtruth_estimate0").mkdir(parents=True, exist_ok=True)
(mav / "state_groundtruth_estimate0/data.csv").write_text("".join(rows))

(HERE / "expected_models.json").write_text(json.dumps({"world_from_camera": POSES.reshape(COUNT, 16).tolist()}, indent=1))
