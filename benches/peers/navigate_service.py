"""Navigate as one would write it first: grpcio, NumPy and faiss.

    python navigate_service.py STORE PORT

Serves the room and the adapter `bench` of a store that `cargo bench --bench serving -- make` made. It answers
Navigate and BatchNavigate for features and twists, in an open loop, by inverse Poincaré in the homogeneous
reading, as seese3 does. Needs numpy, faiss-cpu, safetensors, and the package seese3 for the messages.
"""

import concurrent.futures
import math
import pathlib
import sys

import faiss
import grpc
import numpy as np
from safetensors.numpy import load_file
from seese3.v1 import geometry_pb2, navigation_pb2


def gelu(x):
    erf = np.vectorize(math.erf)
    return 0.5 * x * (1 + erf(x / math.sqrt(2)))


class Adapter:
    """φ and the inverse of W."""

    def __init__(self, tensors):
        self.phi = [tensors[f"phi.{name}"].astype(np.float64) for name in
                    ("0.weight", "0.bias", "1.weight", "1.bias", "3.weight", "3.bias")]
        self.inverse = np.linalg.pinv(tensors["W.weight"].astype(np.float64), rcond=1e-5)
        self.deviation = tensors["target.deviation"]

    def embed(self, features):
        first, bias, scale, shift, second, last = self.phi
        hidden = features @ first.T + bias
        hidden = hidden - hidden.mean(axis=-1, keepdims=True)
        hidden = hidden / np.sqrt(hidden.var(axis=-1, keepdims=True) + 1e-5) * scale + shift
        return gelu(hidden) @ second.T + last

    def step(self, twist):
        return self.inverse @ (twist / self.deviation)


class Service:
    def __init__(self, store):
        def stored(kind, pattern):
            (file,) = pathlib.Path(store, kind, "bench", "objects").glob(pattern)
            return load_file(file)

        self.adapter = Adapter(stored("adapters", "weights-*.safetensors"))
        features = stored("rooms", "features-*.safetensors")["features"]
        self.poses = stored("rooms", "frames-*.safetensors")["world_from_camera"]
        self.index = faiss.IndexFlatL2(self.adapter.inverse.shape[0])
        self.index.add(self.adapter.embed(features.astype(np.float64)).astype(np.float32))

    def answer(self, request):
        latent = self.adapter.embed(np.array([request.source.feature.values]))[0]
        response = navigation_pb2.NavigateResponse()
        for twist in request.motion.twists.twists:
            motion = np.array([twist.linear.x, twist.linear.y, twist.linear.z,
                               twist.angular.x, twist.angular.y, twist.angular.z])
            step = self.adapter.step(motion / request.steps)
            path = latent + np.outer(np.arange(1, request.steps + 1), step)
            latent = path[-1]
            squares, frames = self.index.search(path.astype(np.float32), max(request.top_k, 1))
            for number, (point, row, found) in enumerate(zip(path, np.sqrt(squares), frames), 1):
                wire = response.steps.add(step=number)
                wire.latent.values.extend(point)
                for distance, frame in zip(row, found):
                    position = self.poses[frame][:3, 3]
                    where = geometry_pb2.Vector3(x=position[0], y=position[1], z=position[2])
                    wire.frames.add(frame_id=frame, distance=distance, pose=geometry_pb2.Pose(position=where))
        return response

    def navigate(self, request, context):
        return self.answer(request)

    def batch_navigate(self, request, context):
        response = navigation_pb2.BatchNavigateResponse()
        for one in request.requests:
            response.results.add(response=self.answer(one))
        return response


def main():
    store, port = sys.argv[1:]
    faiss.omp_set_num_threads(1)
    server = grpc.server(concurrent.futures.ThreadPoolExecutor(max_workers=2))
    service = Service(store)
    methods = {"Navigate": service.navigate, "BatchNavigate": service.batch_navigate}
    handlers = {
        name: grpc.unary_unary_rpc_method_handler(
            method,
            request_deserializer=getattr(navigation_pb2, f"{name}Request").FromString,
            response_serializer=getattr(navigation_pb2, f"{name}Response").SerializeToString,
        )
        for name, method in methods.items()
    }
    handler = grpc.method_handlers_generic_handler("seese3.v1.NavigationService", handlers)
    server.add_generic_rpc_handlers((handler,))
    server.add_insecure_port(f"127.0.0.1:{port}")
    server.start()
    print("serving", flush=True)
    server.wait_for_termination()


main()
