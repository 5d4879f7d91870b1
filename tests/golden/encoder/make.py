"""Tiny ONNX models and what they must give. Oracle: the arithmetic of each layer written out in NumPy, float64.
Second way: onnx's own reference evaluator. Original; needs numpy, onnx, safetensors (versions in expected.json)."""
import json
from pathlib import Path
import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper
from onnx.reference import ReferenceEvaluator
from safetensors.numpy import save_file

HERE = Path(__file__).resolve().parent
H, W, C, T = 6, 8, 4, 4
r = np.random.default_rng(3)
K = r.normal(size=(C, 3, 3, 3)).astype(np.float32)
B = r.normal(size=C).astype(np.float32)


def tensor(name, shape):
    return helper.make_tensor_value_info(name, TensorProto.FLOAT, shape)


def save(name, nodes, weights, inputs, outputs):
    graph = helper.make_graph(nodes, name, inputs, outputs, [numpy_helper.from_array(v, k) for k, v in weights.items()])
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], producer_name="seese3-golden")
    model.ir_version = 8
    onnx.checker.check_model(model)
    onnx.save(model, HERE / f"{name}.onnx")
    return ReferenceEvaluator(model)


# image [batch, 3, 6, 8] -> conv stride 2 -> `hidden` (not declared) -> relu -> map, tokens, vector
nodes = [
    helper.make_node("Conv", ["image", "K", "B"], ["hidden"], pads=[1, 1, 1, 1], strides=[2, 2]),
    helper.make_node("Relu", ["hidden"], ["map"]),
    helper.make_node("Reshape", ["map", "flat"], ["flattened"]),
    helper.make_node("Transpose", ["flattened"], ["tokens"], perm=[0, 2, 1]),
    helper.make_node("ReduceMean", ["map"], ["vector"], axes=[2, 3], keepdims=0),
    helper.make_node("Unsqueeze", ["vector", "second"], ["class"]),
    helper.make_node("Concat", ["class", "tokens"], ["classed"], axis=1),
]
weights = {"K": K, "B": B, "flat": np.array([0, C, -1], np.int64), "second": np.array([1], np.int64)}
image_model = save("image", nodes, weights, [tensor("image", ["batch", 3, H, W])],
                   [tensor("map", ["batch", C, H // 2, W // 2]), tensor("tokens", ["batch", H * W // 4, C]), tensor("vector", ["batch", C]),
                    tensor("classed", ["batch", H * W // 4 + 1, C])])
# clips: one wants [batch, T, 3, H, W], the other [batch, 3, T, H, W]; both give the mean colour of each image, (batch, T, 3)
by_time = save("clip_time_first", [helper.make_node("ReduceMean", ["clip"], ["colours"], axes=[3, 4], keepdims=0)], {},
               [tensor("clip", ["batch", T, 3, H, W])], [tensor("colours", ["batch", T, 3])])
by_colour = save("clip_colour_first", [helper.make_node("ReduceMean", ["clip"], ["means"], axes=[3, 4], keepdims=0),
                                       helper.make_node("Transpose", ["means"], ["colours"], perm=[0, 2, 1])], {},
                 [tensor("clip", ["batch", 3, T, H, W])], [tensor("colours", ["batch", T, 3])])

# outputs whose first axis is not the batch, and one without axes
save("turned", [helper.make_node("ReduceMean", ["image"], ["means"], axes=[3], keepdims=0),
                helper.make_node("Transpose", ["means"], ["turned"], perm=[2, 0, 1]),
                helper.make_node("ReduceMean", ["image"], ["scalar"], keepdims=0)], {},
     [tensor("image", ["batch", 3, H, W])], [tensor("turned", [H, "batch", 3]), tensor("scalar", [])])
# a model that takes two images at a time, neither one nor as many as come
save("pairs", [helper.make_node("ReduceMean", ["image"], ["vector"], axes=[2, 3], keepdims=0)], {},
     [tensor("image", [2, 3, H, W])], [tensor("vector", [2, 3])])
# the same model as torch.onnx.export leaves it: weights in a file beside it, and shapes of inner values with a named batch
beside = onnx.load(HERE / "image.onnx")
beside.graph.value_info.append(tensor("hidden", ["batch", C, H // 2, W // 2]))
onnx.save_model(beside, HERE / "beside.onnx", save_as_external_data=True, location="beside.bin", size_threshold=100)
# weights in another file, which is not there
outside = onnx.load(HERE / "image.onnx")
for weight in outside.graph.initializer:
    if weight.name == "K":
        weight.ClearField("raw_data")
        weight.data_location = TensorProto.EXTERNAL
        weight.external_data.add(key="location", value="outside.bin")
(HERE / "outside.onnx").write_bytes(outside.SerializeToString())


def conv(x):
    x = np.pad(x.astype(np.float64), ((0, 0), (0, 0), (1, 1), (1, 1)))
    y = np.zeros((len(x), C, H // 2, W // 2))
    for i in range(H // 2):
        for j in range(W // 2):
            y[:, :, i, j] = np.einsum("ncab,kcab->nk", x[:, :, 2 * i:2 * i + 3, 2 * j:2 * j + 3], K.astype(np.float64)) + B
    return y


pixels = r.integers(0, 256, size=(5, H, W, 3), dtype=np.uint8)
x = ((pixels.astype(np.float32) / np.float32(255) - np.float32(0.5)) / np.float32(0.25)).transpose(0, 3, 1, 2)
hidden = conv(x)
relu = np.maximum(hidden, 0)
tokens = relu.reshape(5, C, -1).transpose(0, 2, 1)
grid = np.stack([relu[:, :, 0:2, 0:2].mean((2, 3)), relu[:, :, 0:2, 2:4].mean((2, 3)),
                 relu[:, :, 1:3, 0:2].mean((2, 3)), relu[:, :, 1:3, 2:4].mean((2, 3))], 2)      # 3 rows into 2 overlap
clip = np.stack([x[[0, 0, 0, 1]], x[[0, 0, 1, 2]], x[[0, 1, 2, 3]], x[[1, 2, 3, 4]], x[[2, 3, 4, 4]]])  # around each frame
colours = clip.mean((3, 4), dtype=np.float64)
out = {"pixels": pixels, "hidden_mean": hidden.mean((2, 3)), "map_mean": relu.mean((2, 3)), "map_grid2x2": grid.reshape(5, -1),
       "vector": relu.mean((2, 3)),
       "clip_colours_mean": colours.mean(1)}
ref = dict(zip(["map", "tokens", "vector", "classed"], image_model.run(None, {"image": x})))
assert np.abs(ref["map"] - relu).max() < 1e-5 and np.abs(ref["tokens"] - tokens).max() < 1e-5
assert np.abs(ref["classed"] - np.concatenate([relu.mean((2, 3))[:, None], tokens], 1)).max() < 1e-5
assert np.abs(by_time.run(None, {"clip": clip})[0] - colours).max() < 1e-6
assert np.abs(by_colour.run(None, {"clip": np.ascontiguousarray(clip.transpose(0, 2, 1, 3, 4))})[0] - colours).max() < 1e-6
save_file({k: np.ascontiguousarray(v if v.dtype == np.uint8 else v.astype(np.float32)) for k, v in out.items()}, HERE / "expected.safetensors")
json.dump({"versions": {"numpy": np.__version__, "onnx": onnx.__version__}, "preparation": "(v / 255 - 0.5) / 0.25",
           "clip": "four frames around each, the anchor third; the ends stand in for what is missing"}, open(HERE / "expected.json", "w"), indent=1)
