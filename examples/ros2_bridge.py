"""A ROS 2 node that has a SeeSE3 server follow a camera.

Subscribes to sensor_msgs/CompressedImage on ~/image with the QoS of sensor data (the server runs with --encoder), to
geometry_msgs/PoseWithCovarianceStamped on /initialpose ("2D Pose Estimate" in RViz) and, as another sensor's odometry, to
nav_msgs/Odometry on ~/wheels. Publishes nav_msgs/Odometry on ~/odom, geometry_msgs/PoseWithCovarianceStamped on ~/pose,
diagnostic_msgs/DiagnosticArray on /diagnostics, and TF.

    python -m grpc_tools.protoc -I proto --python_out=. --grpc_python_out=. proto/seese3/v1/*.proto
    PYTHONPATH=. python examples/ros2_bridge.py --ros-args -p server:=127.0.0.1:50051 -p room:=kitchen -p adapter:=robot \
        -p base_from_camera:="[0.2, 0.0, 0.4, -0.5, 0.5, -0.5, 0.5]"

Frames are named as REP-105 says. With base_from_camera (x, y, z and the quaternion x, y, z, w of the optical frame in base_link)
poses and TF are those of base_link, which may have no other parent than odom. Without it they are the camera's, whose axes are
the optical ones (x right, y down, z forward), and TF is only published if publish_tf is set: a camera frame that a robot
description holds has a parent already. TF map -> odom and ~/pose are published while the camera is TRACKING or DEGRADED.

With camera (width, height and focal length in pixels: width, height and K[0] of CameraInfo) a room that was mapped with another field
of view is refused.

The wheels' frame is base_link, and base_from_camera is needed for them. When a stream cannot be resumed, odometry begins
anew; that is logged as an error, and /diagnostics counts it.
"""

import queue
import threading
import time

from seese3.v1 import geometry_pb2, odometry_pb2, odometry_pb2_grpc

# What ROS takes for unknown: the errors of velocities are not reported.
UNKNOWN = 9999.0
LEVELS = {"TRACKING": 0, "DEGRADED": 1, "RELOCALIZING": 1, "LOST": 2}
LOCALIZED = ("TRACKING", "DEGRADED")
# Wheels that said nothing for so long say nothing of a frame, nanoseconds.
OLD_NS = 50_000_000


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


def wire_pose(pose, parent, child):
    """A geometry_msgs/Pose as a wire pose."""
    found = geometry_pb2.Pose(parent_frame=parent, child_frame=child)
    for axis in "xyz":
        setattr(found.position, axis, getattr(pose.position, axis))
    for axis in "wxyz":
        setattr(found.orientation, axis, getattr(pose.orientation, axis))
    return found


def mounting(numbers):
    """base_from_camera of seven numbers, or None of none."""
    if not numbers:
        return None
    if len(numbers) != 7:
        raise ValueError("base_from_camera must be x, y, z and the quaternion x, y, z, w")
    x, y, z, qx, qy, qz, qw = numbers
    return geometry_pb2.Pose(position=geometry_pb2.Vector3(x=x, y=y, z=z),
                             orientation=geometry_pb2.Quaternion(x=qx, y=qy, z=qz, w=qw))


def pinhole(numbers):
    """A camera of its width, height and focal length in pixels, as CameraInfo has them, or None of none."""
    if not numbers:
        return None
    if len(numbers) != 3:
        raise ValueError("camera must be width, height and focal length in pixels")
    width, height, focal = numbers
    return geometry_pb2.Pinhole(width=width, height=height, focal=focal)


def status_name(update):
    return odometry_pb2.TrackStatus.Name(update.status).removeprefix("TRACK_STATUS_")


def body_of(update):
    """The names of the fields of the base, where it is known, else of the camera: in odom, in map, its covariance, its velocity."""
    if update.HasField("odom_from_base"):
        return "odom_from_base", "map_from_base", "map_from_base_covariance", "base_velocity"
    return "odom_from_camera", "map_from_camera", "map_from_camera_covariance", "body_velocity"


def odometry_message(update, Odometry):
    """nav_msgs/Odometry: the pose in odom, the twist in the body's own frame."""
    message = Odometry()
    in_odom, _, _, velocity = body_of(update)
    pose = getattr(update, in_odom)
    set_stamp(message.header, update.timestamp_ns, pose.parent_frame)
    message.child_frame_id = pose.child_frame
    set_pose(message.pose.pose, pose)
    # The camera's, which differs from the base's by the lever of the mounting alone.
    message.pose.covariance = list(update.odom_from_camera_covariance)
    message.twist.covariance = [UNKNOWN if place % 7 == 0 else 0.0 for place in range(36)]
    if update.HasField(velocity):
        for part in ("linear", "angular"):
            for axis in "xyz":
                setattr(getattr(message.twist.twist, part), axis, getattr(getattr(getattr(update, velocity), part), axis))
    return message


def pose_message(update, PoseWithCovarianceStamped):
    """geometry_msgs/PoseWithCovarianceStamped in map, or None while the camera is not localized."""
    _, in_map, covariance, _ = body_of(update)
    if not update.HasField(in_map) or status_name(update) not in LOCALIZED:
        return None
    message, pose = PoseWithCovarianceStamped(), getattr(update, in_map)
    set_stamp(message.header, update.timestamp_ns, pose.parent_frame)
    set_pose(message.pose.pose, pose)
    message.pose.covariance = list(getattr(update, covariance))
    return message


def transforms(update, TransformStamped):
    """TF of odom and, while the camera is localized, of map."""
    fields = [body_of(update)[0]] + (["map_from_odom"] if status_name(update) in LOCALIZED else [])
    found = []
    for field in fields:
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
        while (request := frames.get()) is not None:
            yield request

    def offer(self, request):
        """Takes a request; the oldest that waits goes when there is no room."""
        while True:
            try:
                return self.frames.put_nowait(request)
            except queue.Full:
                try:
                    self.frames.get_nowait()
                except queue.Empty:
                    pass

    def answers(self):
        """Answers until the call ends. Every call has a queue of its own: an old one must not take a new one's frames."""
        frames = self.frames = queue.Queue(maxsize=8)
        try:
            for answer in self.stub.Track(self.requests(frames)):
                self.token = answer.resume_token or self.token
                yield answer
        finally:
            # Ends the requests of the call that is over.
            while frames.full():
                frames.get_nowait()
            frames.put_nowait(None)


def main():
    import grpc
    import rclpy
    from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
    from geometry_msgs.msg import PoseWithCovarianceStamped, TransformStamped
    from nav_msgs.msg import Odometry
    from rclpy.executors import ExternalShutdownException
    from rclpy.node import Node
    from rclpy.parameter import Parameter
    from rclpy.qos import qos_profile_sensor_data
    from sensor_msgs.msg import CompressedImage
    from tf2_ros import TransformBroadcaster

    rclpy.init()
    node = Node("seese3")
    given = {name: node.declare_parameter(name, plain).value for name, plain in
             [("server", "127.0.0.1:50051"), ("room", ""), ("adapter", ""), ("camera_frame", "camera_optical_frame"),
              ("base_frame", "base_link"), ("publish_tf", False),
              ("wheel_drift", 0.05)]}
    # Declared by its type: the elements of an empty list have none.
    base_from_camera = mounting(node.declare_parameter("base_from_camera", Parameter.Type.DOUBLE_ARRAY).value)
    config = odometry_pb2.TrackConfig(
        room=given["room"], adapter=given["adapter"], back_pressure=odometry_pb2.BACK_PRESSURE_NEWEST,
        frames=odometry_pb2.FrameNames(camera=given["camera_frame"], base=given["base_frame"]),
        base_from_camera=base_from_camera,
        camera=pinhole(node.declare_parameter("camera", Parameter.Type.DOUBLE_ARRAY).value))
    channel = grpc.insecure_channel(given["server"])
    stream = Stream(channel, config)
    odom = node.create_publisher(Odometry, "~/odom", 10)
    pose = node.create_publisher(PoseWithCovarianceStamped, "~/pose", 10)
    diagnostics = node.create_publisher(DiagnosticArray, "/diagnostics", 10)
    tf = TransformBroadcaster(node) if base_from_camera is not None or given["publish_tf"] else None
    counts = {"images": 0, "updates": 0, "refusals": 0, "odometry begun anew": 0}
    wheels = None

    def on_image(image):
        counts["images"] += 1
        stamp = image.header.stamp.sec * 1_000_000_000 + image.header.stamp.nanosec
        view = geometry_pb2.View(image=bytes(image.data))
        frame = odometry_pb2.TrackFrame(timestamp_ns=stamp, sequence=counts["images"], view=view)
        if wheels is not None and abs(wheels[0] - stamp) <= OLD_NS:
            frame.odometry.CopyFrom(wheels[1])
        stream.offer(odometry_pb2.TrackRequest(frame=frame))

    def on_wheels(message):
        nonlocal wheels
        stamp = message.header.stamp.sec * 1_000_000_000 + message.header.stamp.nanosec
        measured = odometry_pb2.MeasuredOdometry(
            pose=wire_pose(message.pose.pose, "", given["base_frame"]),
            translation_share=given["wheel_drift"], rotation_share=given["wheel_drift"])
        wheels = stamp, measured

    def on_initial_pose(message):
        body = given["base_frame"] if base_from_camera is not None else given["camera_frame"]
        known = odometry_pb2.InitialPose(pose=wire_pose(message.pose.pose, "map", body))
        stream.offer(odometry_pb2.TrackRequest(set_initial_pose=odometry_pb2.SetInitialPose(initial_pose=known)))

    def report(level, text, timestamp_ns):
        values = [KeyValue(key=key, value=str(value)) for key, value in counts.items()]
        message = DiagnosticArray(status=[
            DiagnosticStatus(level=bytes([level]), name="seese3: tracking", message=text, values=values)])
        set_stamp(message.header, timestamp_ns, "")
        diagnostics.publish(message)

    def publish(update):
        counts["updates"] += 1
        odom.publish(odometry_message(update, Odometry))
        if (message := pose_message(update, PoseWithCovarianceStamped)) is not None:
            pose.publish(message)
        if tf is not None:
            tf.sendTransform(transforms(update, TransformStamped))
        name = status_name(update)
        report(LEVELS.get(name, 3), f"{name}: {update.reason}", update.timestamp_ns)

    def refused(refusal):
        counts["refusals"] += 1
        reason = odometry_pb2.TrackRefusalReason.Name(refusal.reason).removeprefix("TRACK_REFUSAL_REASON_")
        # Frames that a newer one overtook are no fault.
        if reason != "SUPERSEDED":
            node.get_logger().warning(f"refused, {reason}: {refusal.message}", throttle_duration_sec=1.0)
            report(1, f"refused, {reason}: {refusal.message}", refusal.timestamp_ns)

    def follow():
        while rclpy.ok():
            try:
                for answer in stream.answers():
                    kind = answer.WhichOneof("answer")
                    if kind == "update":
                        publish(answer.update)
                    elif kind == "refusal":
                        refused(answer.refusal)
            except grpc.RpcError as error:
                node.get_logger().warning(f"{error.code().name}: {error.details()}")
                if stream.token and error.code() not in (grpc.StatusCode.UNAVAILABLE, grpc.StatusCode.CANCELLED):
                    stream.token = b""
                    counts["odometry begun anew"] += 1
                    node.get_logger().error("the stream cannot be resumed: odometry begins anew")
                time.sleep(1.0)

    node.create_subscription(CompressedImage, "~/image", on_image, qos_profile_sensor_data)
    node.create_subscription(PoseWithCovarianceStamped, "/initialpose", on_initial_pose, 10)
    if base_from_camera is not None:
        node.create_subscription(Odometry, "~/wheels", on_wheels, qos_profile_sensor_data)
    threading.Thread(target=follow, daemon=True).start()
    try:
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        # Ends the call, and with it the thread.
        channel.close()
        node.destroy_node()
        rclpy.try_shutdown()


if __name__ == "__main__":
    main()
