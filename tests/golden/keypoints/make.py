"""Keypoints of head outputs. Oracle: the definition in NumPy and SciPy, float64.
Usage: make.py [MODEL IMAGE]; with XFeat's model and an image, also the keypoints of the image, by onnxruntime."""
import sys
from pathlib import Path
import numpy as np
from scipy.ndimage import map_coordinates, maximum_filter
HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE.parent))
from common import dump, versions


def keypoints(positions, reliability, descriptors, most):
    """Position in pixels from the top left corner, score and unit descriptor of each keypoint, the best score first."""
    positions, reliability, descriptors = [np.float64(x) for x in (positions, reliability, descriptors)]
    _, h, w = positions.shape
    # Channel 8 i + j of a cell is its pixel in row i and column j; channel 64 is "no keypoint".
    p = np.zeros((8 * h, 8 * w))
    for i in range(8):
        for j in range(8): p[i::8, j::8] = positions[8 * i + j]
    is_best = (p == maximum_filter(p, size=5)) & (p > .02)
    is_best[:2] = is_best[-2:] = False; is_best[:, :2] = is_best[:, -2:] = False
    y, x = np.nonzero(is_best)
    cells = np.array([(y + .5) / 8 - .5, (x + .5) / 8 - .5])
    def at(map_): return map_coordinates(map_, cells, order=1, mode="nearest")
    score = p[y, x] * at(reliability[0])
    logs = np.log(p + 1e-4)
    def peak(a, b, c):
        # The parabola through (-1, a), (0, b) and (1, c), by least squares.
        quadratic, linear, _ = np.linalg.solve(np.array([[1., -1, 1], [0, 0, 1], [1, 1, 1]]), np.array([a, b, c]))
        return np.clip(-linear / (2 * quadratic), -.5, .5)
    dx = peak(logs[y, x - 1], logs[y, x], logs[y, x + 1]); dy = peak(logs[y - 1, x], logs[y, x], logs[y + 1, x])
    unit = descriptors / np.linalg.norm(descriptors, axis=0)
    d = np.stack([at(channel) for channel in unit], 1); d /= np.linalg.norm(d, axis=1)[:, None]
    order = np.argsort(-score)[:most]
    return dict(points=np.stack([x + .5 + dx, y + .5 + dy], 1)[order], scores=score[order], descriptors=d[order])


r = np.random.default_rng(8)
h, w = 6, 8
logits = r.normal(size=(65, h, w)) * 2; logits[64] += 3
positions = (np.exp(logits) / np.exp(logits).sum(0)).astype(np.float32)
reliability = r.uniform(.05, 1, (1, h, w)).astype(np.float32)
descriptors = r.normal(size=(8, h, w)).astype(np.float32)
for name in ("positions", "reliability", "descriptors"): np.save(HERE / f"{name}.npy", globals()[name])
dump(HERE / "expected.json", dict(versions=versions("numpy", "scipy"), **keypoints(positions, reliability, descriptors, 600)))

if len(sys.argv) > 2:
    import onnxruntime
    from PIL import Image
    image = np.asarray(Image.open(sys.argv[2]).convert("RGB").resize((320, 240), Image.BILINEAR), np.float32)
    session = onnxruntime.InferenceSession(sys.argv[1])
    names = [output.name for output in session.get_outputs()]; print(names)
    outputs = session.run(["kpt", "heat", "fusion"], {"image": image.transpose(2, 0, 1)[None] / 255})
    found = keypoints(*[output[0] for output in outputs], 600)
    print(len(found["scores"]), found["scores"][[0, -1]])
    dump(HERE / "image.json", dict(versions=versions("numpy", "scipy", "onnxruntime", "pillow"), image=Path(sys.argv[2]).name,
                                        points=found["points"].round(3), scores=found["scores"].round(5)))
