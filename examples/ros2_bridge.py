"""A ROS 2 node that has a SeeSE3 server follow a camera.

Subscribes to sensor_msgs/CompressedImage on ~/image (the server runs with --encoder), publishes nav_msgs/Odometry on ~/odom,
geometry_msgs/PoseWithCovarianceStamped on ~/pose, diagnostic_msgs/DiagnosticStatus on ~/status, and TF map -> odom -> camera.

    python -m grpc_tools.protoc -I proto --python_out=. --grpc_python_out=. proto/seese3/v1/*.proto
    PYTHONPATH=. python examples/ros2_bridge.py --ros-args -p server:=127.0.0.1:50051 -p room:=kitchen -p adapter:=robot

Frames are named as REP-105 says; the camera's axes are the optical ones (x right, y down, z forward).
"""

import queue
import threading
import time

from seese3.v1 import geometry_pb2, odometry_pb2, odometry_pb2_grpc

# What ROS takes for unknown: the twist is read from two poses, and its errors were not measured.
UNKNOWN = 9999.0
LEVELS = {"TRACKING": 0, "DEGRADED": 1, "RELOCALIZING": 1, "LOST": 2}


def set_pose(target, pose):
    """A wire pose into a geometry_msgs/Pose or, by its other names, a geometry_msgs/Transform."""
    position = target.position if hasattr(target, "position") else target.translation
    orientation = target.orientation if hasattr(target, "orientation") else target.rotation
    position.x, position.y, position.z = pose.position.x, pose.position.y, pose.position.z
    for axis in "wxyz":
        setattr(orientation, axis, getattr(pose.orientation, axis))


def set_stamp(header, timestamp_ns, frame_id):
    header.stamp.sec, header.stamp.nanosec = divmod(timestamp_ns, 1_000_000_000)
    header.frame_id = frame_id


def odometry_message(update, Odometry):
    """nav_msgs/Odometry: the pose in odom, the twist in the camera's own frame."""
    message = Odometry()
    pose = update.odom_from_camera
    set_stamp(message.header, update.timestamp_ns, pose.parent_frame)
    message.child_frame_id = pose.child_frame
    set_pose(message.pose.pose, pose)
    message.pose.covariance = list(update.odom_from_camera_covariance)
    message.twist.covariance = [UNKNOWN if place % 7 == 0 else 0.0 for place in range(36)]
    if update.HasField("body_velocity"):
        for part in ("linear", "angular"):
            for axis in "xyz":
                setattr(getattr(message.twist.twist, part), axis, getattr(getattr(update.body_velocity, part), axis))
    return message


def pose_message(update, PoseWithCovarianceStamped):
    """geometry_msgs/PoseWithCovarianceStamped in map, or None while no place is known."""
    if not update.HasField("map_from_camera"):
        return None
    message = PoseWithCovarianceStamped()
    set_stamp(message.header, update.timestamp_ns, update.map_from_camera.parent_frame)
    set_pose(message.pose.pose, update.map_from_camera)
    message.pose.covariance = list(update.map_from_camera_covariance)
    return message


def transforms(update, TransformStamped):
    """TF of odom and, while a place is known, of map."""
    found = []
    for field in ("odom_from_camera", "map_from_odom"):
        if update.HasField(field):
            pose, message = getattr(update, field), TransformStamped()
            set_stamp(message.header, update.timestamp_ns, pose.parent_frame)
            message.child_frame_id = pose.child_frame
            set_pose(message.transform, pose)
            found.append(message)
    return found


class Stream:
    """Frames in, answers out; goes on with the last token when the server goes away."""

    def __init__(self, channel, config):
        self.stub, self.config, self.token = odometry_pb2_grpc.OdometryServiceStub(channel), config, b""
        self.frames = queue.Queue(maxsize=8)

    def requests(self, frames):
        resumed = odometry_pb2.TrackConfig(resume_token=self.token)
        yield odometry_pb2.TrackRequest(config=resumed if self.token else self.config)
        while (frame := frames.get()) is not None:
            yield odometry_pb2.TrackRequest(frame=frame)

    def offer(self, frame):
        """Takes a frame; the oldest that waits goes when there is no room."""
        while True:
            try:
                return self.frames.put_nowait(frame)
            except queue.Full:
                try:
                    self.frames.get_nowait()
                except queue.Empty:
                    pass

    def answers(self):
        """Updates until the call ends. Every call has a queue of its own: an old one must not take a new one's frames."""
        frames = self.frames = queue.Queue(maxsize=8)
        try:
            for answer in self.stub.Track(self.requests(frames)):
                self.token = answer.resume_token
                if answer.WhichOneof("answer") == "update":
                    yield answer.update
        finally:
            # Ends the requests of the call that is over.
            while frames.full():
                frames.get_nowait()
            frames.put_nowait(None)


def main():
    import grpc
    import rclpy
    from diagnostic_msgs.msg import DiagnosticStatus
    from geometry_msgs.msg import PoseWithCovarianceStamped, TransformStamped
    from nav_msgs.msg import Odometry
    from rclpy.node import Node
    from sensor_msgs.msg import CompressedImage
    from tf2_ros import TransformBroadcaster

    rclpy.init()
    node = Node("seese3")
    given = {name: node.declare_parameter(name, plain).value for name, plain in
             [("server", "127.0.0.1:50051"), ("room", ""), ("adapter", ""), ("camera_frame", "camera_optical_frame")]}
    config = odometry_pb2.TrackConfig(
        room=given["room"], adapter=given["adapter"], back_pressure=odometry_pb2.BACK_PRESSURE_NEWEST,
        frames=odometry_pb2.FrameNames(camera=given["camera_frame"]))
    stream = Stream(grpc.insecure_channel(given["server"]), config)
    odom = node.create_publisher(Odometry, "~/odom", 10)
    pose = node.create_publisher(PoseWithCovarianceStamped, "~/pose", 10)
    status = node.create_publisher(DiagnosticStatus, "~/status", 10)
    tf = TransformBroadcaster(node)
    count = 0

    def on_image(image):
        nonlocal count
        count += 1
        stamp = image.header.stamp.sec * 1_000_000_000 + image.header.stamp.nanosec
        view = geometry_pb2.View(image=bytes(image.data))
        stream.offer(odometry_pb2.TrackFrame(timestamp_ns=stamp, sequence=count, view=view))

    def follow():
        while rclpy.ok():
            try:
                for update in stream.answers():
                    odom.publish(odometry_message(update, Odometry))
                    if (message := pose_message(update, PoseWithCovarianceStamped)) is not None:
                        pose.publish(message)
                    tf.sendTransform(transforms(update, TransformStamped))
                    name = odometry_pb2.TrackStatus.Name(update.status).removeprefix("TRACK_STATUS_")
                    level = bytes([LEVELS.get(name, 3)])
                    status.publish(DiagnosticStatus(level=level, name="seese3", message=f"{name}: {update.reason}"))
            except grpc.RpcError as error:
                node.get_logger().warning(f"{error.code().name}: {error.details()}")
                if error.code() not in (grpc.StatusCode.UNAVAILABLE, grpc.StatusCode.CANCELLED):
                    stream.token = b""
                time.sleep(1.0)

    node.create_subscription(CompressedImage, "~/image", on_image, 10)
    threading.Thread(target=follow, daemon=True).start()
    rclpy.spin(node)


if __name__ == "__main__":
    main()
