"""The node: subscriptions, publishers, services, and the thread that takes the server's answers.

It is a lifecycle node. Configured, it has its topics and a connection; active, it has a stream. With `autostart`, which is
the default, it becomes active by itself.
"""

import collections
import functools
import sys
import threading
import time

import grpc
import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import PoseWithCovarianceStamped, TransformStamped
from nav_msgs.msg import Odometry
from rcl_interfaces.msg import SetParametersResult
from rclpy.executors import ExternalShutdownException
from rclpy.lifecycle import LifecycleNode, TransitionCallbackReturn
from rclpy.parameter import Parameter
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import CameraInfo, CompressedImage, Image, Imu
from std_srvs.srv import Trigger
from tf2_ros import TransformBroadcaster

from . import answers, connection, requests
from .stream import SAMPLES, Stream
from .v1 import odometry_pb2

LEVELS = {"TRACKING": 0, "DEGRADED": 1, "RELOCALIZING": 1, "LOST": 2}
# What another sensor said so long ago says nothing of a frame, nanoseconds.
OLD_NS = requests.OLD_NS
# Images of several cameras belong together when they were taken within this time, nanoseconds.
TOGETHER_NS = 20_000_000
# What TF is published: odom -> base and map -> odom of the server; only map -> odom of the robot's own odometry, as AMCL
# does; or nothing.
TF = ("odom_and_map", "map_only", "none")
# Frames whose odometry is kept until their answers come.
MOST_DRIVEN = 100
# What may be set while the node is configured: the stream is opened again.
CHANGEABLE = ("room", "adapter")
PARAMETERS = {"autostart": True, "server": "127.0.0.1:50051", "room": "", "adapter": "", "camera_frame": "camera_optical_frame",
              "odom_frame": "odom", "map_frame": "map", "base_frame": "base_link", "tf": "odom_and_map", "tls_ca": "", "tls_cert": "", "tls_key": "",
              "token_file": "", "use_camera_info": False, "wheel_drift": 0.05,
              "use_wheel_covariance": False, "trust_odometry": False, "inertial": False, "depth": False,
              "depth_deviation": 0.005}


class Bridge(LifecycleNode):
    def __init__(self):
        super().__init__("seese3")
        self.given = {name: self.declare_parameter(name, plain).value for name, plain in PARAMETERS.items()}
        self.config = self.configuration()
        self.is_active, self.thread, self.channel, self.listened = False, None, None, []
        self.counts = {"images": 0, "updates": 0, "refusals": 0, "images not sent": 0, "requests dropped": 0, "images overtaken": 0,
                       "odometry begun anew": 0}
        self.wheels = requests.Wheels()
        # The last direction of gravity, with its stamp.
        self.gravity = None
        self.beside, self.gravity_of = {}, requests.Gravity()
        self.depth = None
        # Samples of the inertial sensor since the last frame.
        self.samples, self.last_sample_ns = collections.deque(maxlen=SAMPLES), 0
        # A frame that waits for its depths and the images of the other cameras.
        self.waiting, self.has_failed = None, False
        self.begins = threading.Event()
        if not self.given["use_camera_info"]:
            self.begins.set()

        if self.given["tf"] not in TF:
            raise ValueError(f"tf is {self.given['tf']!r}, and none of: {', '.join(TF)}")
        if self.given["tf"] == "map_only" and not self.has_base:
            raise ValueError("tf: map_only needs base_from_camera, and ~/wheels as the robot's odometry")
        # The robot's own odometry of the frames that have no answer yet, by their stamps.
        self.driven = collections.OrderedDict()
        self.add_on_set_parameters_callback(self.on_parameters)

    @property
    def has_base(self):
        return self.config.HasField("base_from_camera")

    # The lifecycle.

    def on_configure(self, state):
        """Connects, and makes the topics and services."""
        try:
            self.channel = connection.channel(self.given)
        except (OSError, ValueError) as error:
            self.get_logger().error(str(error))
            return TransitionCallbackReturn.FAILURE
        self.stream = Stream(self.channel, self.config, connection.metadata(self.given))
        self.odom = self.create_publisher(Odometry, "~/odom", 10)
        self.pose = self.create_publisher(PoseWithCovarianceStamped, "~/pose", 10)
        self.diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", 10)
        self.tf = TransformBroadcaster(self) if self.given["tf"] != "none" else None
        self.reset_service = self.create_service(Trigger, "~/reset", self.on_reset)
        self.subscribe(self.has_base)
        return TransitionCallbackReturn.SUCCESS

    def on_activate(self, state):
        """Opens the stream."""
        self.is_active = True
        self.thread = threading.Thread(target=self.follow, daemon=True)
        self.thread.start()
        return TransitionCallbackReturn.SUCCESS

    def on_deactivate(self, state):
        """Ends the stream. It is resumed when the node becomes active again."""
        self.stop()
        return TransitionCallbackReturn.SUCCESS

    def on_cleanup(self, state):
        """Removes the topics and the connection."""
        self.stop()
        self.destroy_service(self.reset_service)
        for subscription in self.listened:
            self.destroy_subscription(subscription)
        for publisher in (self.odom, self.pose, self.diagnostics):
            self.destroy_publisher(publisher)
        self.listened = []
        self.channel.close()
        self.channel = None
        return TransitionCallbackReturn.SUCCESS

    def on_shutdown(self, state):
        self.stop()
        if self.channel is not None:
            self.channel.close()
        return TransitionCallbackReturn.SUCCESS

    def stop(self):
        """Ends the stream and its thread."""
        self.is_active = False
        if self.thread is not None:
            self.stream.cancel()
            self.thread.join()
            self.thread = None

    # Services.

    def on_reset(self, request, response):
        """Restarts tracking: the camera was carried elsewhere."""
        response.success = self.is_active
        response.message = "tracking restarts" if self.is_active else "the node is not active"
        if self.is_active:
            self.offer(odometry_pb2.TrackRequest(reset=odometry_pb2.Reset()))
        return response

    def on_parameters(self, parameters):
        """Changes the room or the adapter: a stream in the new one begins."""
        other = [parameter.name for parameter in parameters if parameter.name not in CHANGEABLE]
        if other and self.channel is not None:
            reason = f"{', '.join(other)}: only {' and '.join(CHANGEABLE)} may be set while the node runs"
            return SetParametersResult(successful=False, reason=reason)
        for parameter in parameters:
            if parameter.name in CHANGEABLE:
                self.given[parameter.name] = parameter.value
                setattr(self.config, parameter.name, parameter.value)
        if self.channel is not None:
            self.stream.begin_anew()
        return SetParametersResult(successful=True, reason="")

    def numbers(self, name):
        """A parameter of numbers. It is declared by its type: the elements of an empty list have none."""
        return self.declare_parameter(name, Parameter.Type.DOUBLE_ARRAY).value

    def configuration(self):
        given = self.given
        config = odometry_pb2.TrackConfig(
            room=given["room"], adapter=given["adapter"], back_pressure=odometry_pb2.BACK_PRESSURE_NEWEST,
            frame_names=odometry_pb2.FrameNames(map=given["map_frame"], odom=given["odom_frame"], camera=given["camera_frame"],
                                          base=given["base_frame"]),
            base_from_camera=requests.mounting("base_from_camera", self.numbers("base_from_camera")),
            gravity_in_map=requests.direction("gravity_in_map", self.numbers("gravity_in_map")),
            trust_odometry=given["trust_odometry"])
        if given["inertial"]:
            pose = requests.mounting("base_from_imu", self.numbers("base_from_imu"))
            config.inertial_sensor.CopyFrom(odometry_pb2.InertialSensor(pose=pose))

        for name in self.declare_parameter("other_cameras", Parameter.Type.STRING_ARRAY).value or []:
            parameter = f"{name}.base_from_camera"
            pose = requests.mounting(parameter, self.numbers(parameter))
            if pose is None:
                raise ValueError(f"{parameter} must be given: x, y, z and the quaternion x, y, z, w")
            config.other_cameras.append(odometry_pb2.RigCamera(name=name, pose=pose))
        return config

    def subscribe(self, has_base):
        def listen(kind, topic, callback, qos=qos_profile_sensor_data):
            # Nothing is sent while the node is not active.
            def on_message(message):
                if self.is_active:
                    callback(message)

            self.listened.append(self.create_subscription(kind, topic, on_message, qos))

        compressed, raw = requests.view_of_compressed, requests.view_of_raw
        listen(CompressedImage, "~/image", functools.partial(self.on_image, compressed))
        listen(Image, "~/image_raw", functools.partial(self.on_image, raw))
        for other in self.config.other_cameras:
            callback = functools.partial(self.on_other_image, other.name)
            listen(CompressedImage, f"~/{other.name}/image", functools.partial(callback, compressed))
            listen(Image, f"~/{other.name}/image_raw", functools.partial(callback, raw))

        if self.given["depth"]:
            listen(Image, "~/depth", self.on_depth)

        listen(PoseWithCovarianceStamped, "/initialpose", self.on_initial_pose, 10)
        if self.given["use_camera_info"]:
            listen(CameraInfo, "~/camera_info", self.on_camera_info)
        if has_base:
            listen(Odometry, "~/wheels", self.on_wheels)
        if self.config.HasField("gravity_in_map") or self.given["inertial"]:
            listen(Imu, "~/imu", self.on_imu)

    # What sensors say.

    def view_of(self, reader, image):
        """The view of an image message, or None of one that cannot be read, which is said."""
        try:
            return reader(image)
        except ValueError as error:
            self.counts["images not sent"] += 1
            self.get_logger().warning(f"image not sent: {error}", throttle_duration_sec=1.0)
            self.report(1, f"image not sent: {error}", requests.nanoseconds(image.header.stamp))
            return None

    def on_image(self, reader, image):
        if (view := self.view_of(reader, image)) is None:
            return

        self.send_waiting()
        self.counts["images"] += 1
        stamp = requests.nanoseconds(image.header.stamp)
        frame = odometry_pb2.TrackFrame(timestamp_ns=stamp, sequence_number=self.counts["images"], view=view)
        while self.samples and self.samples[0].timestamp_ns <= stamp:
            frame.inertial_samples.append(self.samples.popleft())
        # The accelerometer of an inertial sensor also shows which way is down.
        has_gravity = self.config.HasField("gravity_in_map") and not self.given["inertial"]
        if has_gravity and self.gravity is not None and abs(self.gravity[0] - stamp) <= OLD_NS:
            frame.gravity.CopyFrom(self.gravity[1])
        self.waiting = frame
        self.send_complete()

    def on_other_image(self, name, reader, image):
        if (view := self.view_of(reader, image)) is None:
            return
        self.beside[name] = requests.nanoseconds(image.header.stamp), view
        self.send_complete()

    def on_depth(self, image):
        reader = functools.partial(requests.depth_image, deviation_m=self.given["depth_deviation"])
        if (depth := self.view_of(reader, image)) is not None:
            self.depth = requests.nanoseconds(image.header.stamp), depth
            self.send_complete()

    def depth_at(self, stamp):
        """The depths of an image taken at a time, or None."""
        is_of_image = self.depth is not None and abs(self.depth[0] - stamp) <= TOGETHER_NS
        return self.depth[1] if is_of_image else None

    def send_complete(self):
        """Sends the frame that waits if nothing is missing."""
        if self.waiting is None:
            return
        stamp = self.waiting.timestamp_ns
        has_views = len(self.views_beside(stamp)) == len(self.config.other_cameras)
        has_depth = not self.given["depth"] or self.depth_at(stamp) is not None
        if has_views and has_depth and not self.wheels.are_awaited(stamp):
            self.send_waiting()

    def views_beside(self, stamp):
        """What the other cameras saw at a time, by their names."""
        return {name: view for name, (other, view) in self.beside.items() if abs(other - stamp) <= TOGETHER_NS}

    def send_waiting(self):
        """Sends the frame that waits for wheels, depths and other cameras, with what has come: when all have, or at the
        next image."""
        if self.waiting is None:
            return
        stamp = self.waiting.timestamp_ns
        if (measured := self.wheels.at(stamp)) is not None:
            self.waiting.odometry.CopyFrom(measured)
            self.driven[stamp] = measured.pose
            while len(self.driven) > MOST_DRIVEN:
                self.driven.popitem(last=False)
        for name, view in self.views_beside(stamp).items():
            self.waiting.other_views.add(camera_name=name, view=view)
        if (depth := self.depth_at(stamp)) is not None:
            self.waiting.depth.CopyFrom(depth)
        self.offer(odometry_pb2.TrackRequest(frame=self.waiting))
        self.waiting = None

    def offer(self, request):
        if self.stream.offer(request):
            self.counts["requests dropped"] += 1

    def on_camera_info(self, info):
        if self.begins.is_set():
            return
        problem = "is not calibrated"
        try:
            camera = requests.camera(info)
        except ValueError as error:
            camera, problem = None, error
        if camera is None:
            self.get_logger().warning(f"camera_info: {problem}: fields of view are not compared")
        else:
            self.config.camera.intrinsics.CopyFrom(camera)
        self.begins.set()

    def on_wheels(self, message):
        measured = requests.measured_odometry(message, self.given["base_frame"], self.given["wheel_drift"],
                                              self.given["use_wheel_covariance"])
        self.wheels.add(requests.nanoseconds(message.header.stamp), measured)
        self.send_complete()

    def on_imu(self, imu):
        if self.given["inertial"]:
            sample = requests.inertial_sample(imu)
            if sample is not None and sample.timestamp_ns > self.last_sample_ns:
                self.samples.append(sample)
                self.last_sample_ns = sample.timestamp_ns
        if (measured := self.gravity_of.after(imu)) is not None:
            self.gravity = requests.nanoseconds(imu.header.stamp), measured

    def on_initial_pose(self, message):
        if message.header.frame_id not in ("", self.given["map_frame"]):
            self.get_logger().error(
                f"/initialpose is in {message.header.frame_id}, and must be in {self.given['map_frame']}: not sent")
            return
        has_base = self.config.HasField("base_from_camera")
        body = self.given["base_frame"] if has_base else self.given["camera_frame"]
        known = odometry_pb2.InitialPose(pose=requests.wire_pose(message.pose.pose, self.given["map_frame"], body))
        self.offer(odometry_pb2.TrackRequest(set_initial_pose=odometry_pb2.SetInitialPose(initial_pose=known)))

    # What the server says.

    def report(self, level, text, timestamp_ns):
        values = [KeyValue(key=key, value=str(value)) for key, value in self.counts.items()]
        message = DiagnosticArray(status=[
            DiagnosticStatus(level=bytes([level]), name="seese3: tracking", message=text, values=values)])
        answers.set_stamp(message.header, timestamp_ns, "")
        self.diagnostics.publish(message)

    def publish(self, update):
        self.odom.publish(answers.odometry_message(update, Odometry))
        if (message := answers.pose_message(update, PoseWithCovarianceStamped)) is not None:
            self.pose.publish(message)
        self.broadcast(update)
        name = answers.status_name(update)
        against = ", ".join(answers.sensor_names(update))
        text = f"{name}: {update.reason}" + (f" (contradicted: {against})" if against else "")
        self.report(LEVELS.get(name, 2), text, update.timestamp_ns)
        self.counts["updates"] += 1

    def broadcast(self, update):
        """Publishes TF."""
        if self.given["tf"] == "odom_and_map":
            self.tf.sendTransform(answers.transforms(update, TransformStamped))
        elif self.given["tf"] == "map_only":
            driven = self.driven.pop(update.timestamp_ns, None)
            found = answers.map_transform(update, driven, self.given["odom_frame"], TransformStamped)
            if found is not None:
                self.tf.sendTransform([found])

    def refused(self, refusal):
        reason = odometry_pb2.TrackRefusalReason.Name(refusal.reason).removeprefix("TRACK_REFUSAL_REASON_")
        if reason == "SUPERSEDED":
            # Frames that a newer one overtook are no fault.
            self.counts["images overtaken"] += refusal.frame_count
            return
        self.counts["refusals"] += 1
        text = f"refused, {reason}: {refusal.message}"
        self.get_logger().warning(text, throttle_duration_sec=1.0)
        self.report(1, text, refusal.timestamp_ns)

    def follow(self):
        """Takes the server's answers while the node is active; what nobody expected ends the node, so that it is started
        again."""
        try:
            self.take_answers()
        except Exception as error:
            self.get_logger().fatal(f"{type(error).__name__}: {error}")
            self.has_failed = True
            rclpy.try_shutdown()
            raise

    def take_answers(self):
        while rclpy.ok() and self.is_active and not self.begins.wait(timeout=1.0):
            self.get_logger().warning("waiting for camera_info", throttle_duration_sec=10.0)

        while rclpy.ok() and self.is_active:
            try:
                for answer in self.stream.answers():
                    kind = answer.WhichOneof("answer")
                    if kind == "update":
                        self.publish(answer.update)
                    elif kind == "refusal":
                        self.refused(answer.refusal)
            except grpc.RpcError as error:
                if not rclpy.ok() or not self.is_active:
                    return
                if self.stream.was_cancelled():
                    continue
                text = f"{error.code().name}: {error.details()}"
                self.get_logger().warning(text)
                self.report(2, text, self.get_clock().now().nanoseconds)
                # Only these say that the token is at fault.
                if self.stream.token and error.code() in (grpc.StatusCode.INVALID_ARGUMENT, grpc.StatusCode.FAILED_PRECONDITION):
                    self.stream.token = b""
                    self.counts["odometry begun anew"] += 1
                    self.get_logger().error("the stream cannot be resumed: odometry begins anew")
                time.sleep(1.0)


def main():
    rclpy.init()
    node = Bridge()
    try:
        if node.given["autostart"]:
            node.has_failed = node.trigger_configure() != TransitionCallbackReturn.SUCCESS
            if not node.has_failed:
                node.trigger_activate()
        if not node.has_failed:
            rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        rclpy.try_shutdown()
        node.stop()
        node.destroy_node()
    # What starts nodes again tells by this that it should.
    sys.exit(1 if node.has_failed else 0)


if __name__ == "__main__":
    main()
