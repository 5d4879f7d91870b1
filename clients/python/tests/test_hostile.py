"""A hostile server: every wait ends, and what cannot be understood is an `AnswerError`, never a wrong pose."""

import math
import threading
import time
from collections.abc import Callable, Iterator
from concurrent import futures
from contextlib import contextmanager
from typing import Any

import grpc
import numpy as np
import pytest
import seese3
from seese3.v1 import catalog_pb2, geometry_pb2, navigation_pb2, odometry_pb2

VIEW = np.array([1.0])
UNIT = geometry_pb2.Quaternion(w=1)
HERE = geometry_pb2.Pose(position=geometry_pb2.Vector3(), orientation=UNIT)


@contextmanager
def hostile(method: str, answer: Callable[[Any, Any], Any], deadline_s: float = 5.0) -> Iterator[seese3.Client]:
    """A client of a server that answers one method, by a message or, of a stream, by several."""
    service, name = method.split("/")
    is_stream = name == "Track"
    raw = [bytes, bytes]
    if is_stream:
        handler = grpc.stream_stream_rpc_method_handler(answer, *raw)
    else:
        handler = grpc.unary_unary_rpc_method_handler(answer, *raw)
    server = grpc.server(futures.ThreadPoolExecutor(4))
    server.add_generic_rpc_handlers([grpc.method_handlers_generic_handler(f"seese3.v1.{service}", {name: handler})])
    port = server.add_insecure_port("127.0.0.1:0")
    server.start()
    try:
        with seese3.Client(f"127.0.0.1:{port}", deadline_s=deadline_s, retries=0) as client:
            yield client
    finally:
        server.stop(None)


def always(message: Any) -> Callable[[Any, Any], bytes]:
    return lambda _request, _context: message.SerializeToString()


@pytest.mark.parametrize(
    "pose",
    [
        geometry_pb2.Pose(position=geometry_pb2.Vector3()),
        geometry_pb2.Pose(position=geometry_pb2.Vector3(), orientation=geometry_pb2.Quaternion(w=9, x=9)),
        geometry_pb2.Pose(position=geometry_pb2.Vector3(x=math.nan), orientation=UNIT),
        geometry_pb2.Pose(position=geometry_pb2.Vector3(x=math.inf), orientation=UNIT),
    ],
)
def test_no_pose_is_made_of_numbers_that_are_none(pose: geometry_pb2.Pose) -> None:
    frame = geometry_pb2.RetrievedFrame(frame_id=1, pose=pose)
    answer = navigation_pb2.NavigateResponse(steps=[navigation_pb2.NavigationStep(frames=[frame])])
    with hostile("NavigationService/Navigate", always(answer)) as client, pytest.raises(seese3.AnswerError):
        _ = client.navigate("r", 0, to=1).frame.pose
    with hostile("OdometryService/EstimateMotion", always(odometry_pb2.EstimateMotionResponse())) as client:
        with pytest.raises(seese3.AnswerError):
            client.motion(0, 1, room="r")


def test_a_list_without_an_end_ends() -> None:
    with hostile("CatalogService/ListRooms", always(catalog_pb2.ListRoomsResponse(next_page_token="1"))) as client:
        with pytest.raises(seese3.AnswerError, match="no end"):
            client.rooms()


def test_details_that_cannot_be_read_are_left_out() -> None:
    def refused(_request: bytes, context: Any) -> bytes:
        context.set_trailing_metadata([("grpc-status-details-bin", b"\xff\xff\xff")])
        context.abort(grpc.StatusCode.NOT_FOUND, "no such room")
        return b""

    with hostile("CatalogService/GetRoom", refused) as client:
        with pytest.raises(seese3.NotFoundError, match="no such room"):
            client.room("r")


def test_a_stream_that_is_not_answered_is_given_up() -> None:
    ends = threading.Event()

    def silent(_requests: Any, _context: Any) -> Iterator[bytes]:
        ends.wait()
        yield b""

    def only_started(_requests: Any, _context: Any) -> Iterator[bytes]:
        yield odometry_pb2.TrackResponse(started=odometry_pb2.TrackStarted()).SerializeToString()
        ends.wait()

    began = time.monotonic()
    with hostile("OdometryService/Track", silent, deadline_s=0.3) as client:
        with pytest.raises(seese3.DeadlineError), client.track(seese3.TrackConfig(room="r")):
            pass
    with hostile("OdometryService/Track", only_started) as client, client.track(seese3.TrackConfig(room="r")) as track:
        with pytest.raises(seese3.DeadlineError):
            track.step(VIEW, 0, deadline_s=0.3)
        assert track.last_sequence_number == 0, "the step did not happen"
    ends.set()
    assert time.monotonic() - began >= 0.6


def test_an_answer_to_another_frame_is_refused() -> None:
    def shifted(requests: Any, _context: Any) -> Iterator[bytes]:
        for number, _ in enumerate(requests):
            pose = geometry_pb2.Pose(position=geometry_pb2.Vector3(), orientation=UNIT)
            camera = odometry_pb2.TrackedBody(odom_pose=geometry_pb2.PoseWithCovariance(pose=pose))
            update = odometry_pb2.TrackUpdate(sequence_number=number - (number > 2), camera=camera)
            answer = odometry_pb2.TrackResponse(update=update) if number else odometry_pb2.TrackResponse()
            yield answer.SerializeToString()

    with hostile("OdometryService/Track", shifted) as client, client.track(seese3.TrackConfig(room="r")) as track:
        assert [track.step(VIEW, time).sequence_number for time in (1, 2)] == [1, 2]
        with pytest.raises(seese3.AnswerError, match="frame 2 where frame 3"):
            track.step(VIEW, 3)
        assert track.last_sequence_number == 2
