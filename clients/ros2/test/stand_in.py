"""Stands in for ROS where there is none: message classes by the definitions that the library rosbags has of a ROS 2
distribution, and so much of rclpy as the bridge uses. The variable ROS_DISTRO names the distribution, humble or jazzy. A
test publishes by calling Node.deliver and reads Node.published."""

import os
import sys
import types

import numpy
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.base import Nodetype

STORE = get_typestore({"humble": Stores.ROS2_HUMBLE, "jazzy": Stores.ROS2_JAZZY}[os.environ.get("ROS_DISTRO", "humble")])
MESSAGES = {
    "diagnostic_msgs": ["DiagnosticArray", "DiagnosticStatus", "KeyValue"],
    "geometry_msgs": ["PoseWithCovarianceStamped", "TransformStamped"],
    "nav_msgs": ["Odometry"],
    "sensor_msgs": ["CameraInfo", "CompressedImage", "Image", "Imu"],
}


def plain(kind):
    """The value of a field that nobody set, as ROS has it."""
    node, detail = kind
    if node == Nodetype.BASE:
        return {"string": "", "bool": False}.get(detail[0], 0.0 if "float" in detail[0] else 0)
    if node == Nodetype.NAME:
        return message_class(detail)()
    if node == Nodetype.SEQUENCE:
        return []
    return [plain(detail[0]) for _ in range(detail[1])]


CLASSES = {}


def message_class(name):
    """A message class whose fields may be left out, as those of ROS."""
    if name not in CLASSES:
        fields = STORE.fielddefs[name][1]

        def init(self, **given):
            for field, kind in fields:
                setattr(self, field, given.pop(field) if field in given else plain(kind))
            assert not given, f"{name} has no {list(given)}"

        CLASSES[name] = type(name.split("/")[-1], (), {"__init__": init, "type_name": name})
    return CLASSES[name]


def to_bag(message):
    """A message as rosbags writes it."""
    def field(kind, value):
        node, detail = kind
        if node == Nodetype.NAME:
            return to_bag(value)
        if node in (Nodetype.ARRAY, Nodetype.SEQUENCE):
            inner = detail[0]
            if inner[0] == Nodetype.NAME:
                return [to_bag(item) for item in value]
            if inner[1][0] == "string":
                return list(value)
            name = {"octet": "uint8", "byte": "uint8", "char": "uint8", "bool": "bool"}.get(inner[1][0], inner[1][0])
            if isinstance(value, (bytes, bytearray)):
                return numpy.frombuffer(bytes(value), numpy.uint8)
            return numpy.asarray(value, dtype=name)
        # ROS takes a byte as bytes of length one, rosbags as a number.
        return value[0] if isinstance(value, bytes) else value

    fields = STORE.fielddefs[message.type_name][1]
    return STORE.types[message.type_name](**{name: field(kind, getattr(message, name)) for name, kind in fields})


class Logger:
    def __init__(self):
        self.lines = []

    def _write(self, text, **_):
        self.lines.append(text)

    warning = error = fatal = info = _write


class Publisher:
    def __init__(self):
        self.messages = []

    def publish(self, message):
        # As ROS does, which refuses a message whose fields have other types.
        self.messages.append(STORE.deserialize_cdr(
            STORE.serialize_cdr(to_bag(message), message.type_name), message.type_name))


class Value:
    def __init__(self, value):
        self.value = value


class Node:
    """A lifecycle node whose parameters a test sets in Node.given before it is made."""

    given = {}

    def __init__(self, name):
        self.name, self.published, self.subscribed, self.logger = name, {}, {}, Logger()
        self.services, self.set_parameters_callback = {}, None

    def declare_parameter(self, name, plain_value):
        return Value(Node.given.get(name, None if isinstance(plain_value, str) and plain_value.startswith("type ") else plain_value))

    def create_publisher(self, _, topic, __):
        self.published[topic] = Publisher()
        return self.published[topic]

    def create_subscription(self, kind, topic, callback, _):
        self.subscribed[topic] = kind, callback
        return topic

    def create_service(self, kind, name, callback):
        self.services[name] = kind, callback
        return name

    def call(self, name):
        """Calls a service, and returns its response."""
        kind, callback = self.services[name]
        return callback(kind.Request(), kind.Response())

    def add_on_set_parameters_callback(self, callback):
        self.set_parameters_callback = callback

    def set_parameters(self, **values):
        """What `ros2 param set` does."""
        return self.set_parameters_callback([types.SimpleNamespace(name=name, value=value) for name, value in values.items()])

    def trigger_configure(self):
        return self.on_configure(None)

    def trigger_activate(self):
        return self.on_activate(None)

    def trigger_deactivate(self):
        return self.on_deactivate(None)

    def trigger_cleanup(self):
        return self.on_cleanup(None)

    def destroy_service(self, name):
        del self.services[name]

    def destroy_subscription(self, topic):
        del self.subscribed[topic]

    def destroy_publisher(self, publisher):
        self.published = {topic: other for topic, other in self.published.items() if other is not publisher}

    def deliver(self, topic, message):
        """What a subscription to a topic gets; nothing where there is none."""
        if topic in self.subscribed:
            self.subscribed[topic][1](message)

    def get_logger(self):
        return self.logger

    def get_clock(self):
        return types.SimpleNamespace(now=lambda: types.SimpleNamespace(nanoseconds=0))

    def destroy_node(self):
        pass


class Broadcaster:
    def __init__(self, node):
        self.node, self.sent = node, []
        node.broadcaster = self

    def sendTransform(self, messages):  # noqa: N802, the name that tf2 has
        for message in messages:
            STORE.serialize_cdr(to_bag(message), message.type_name)
        self.sent.append(messages)


def install():
    """Puts the stand-ins where the bridge imports them from."""
    is_up = {"up": True}
    modules = {
        "rclpy": {"init": lambda: None, "ok": lambda: is_up["up"], "spin": lambda node: None,
                  "try_shutdown": lambda: is_up.update(up=False)},
        "rclpy.executors": {"ExternalShutdownException": type("ExternalShutdownException", (Exception,), {})},
        "rclpy.lifecycle": {"LifecycleNode": Node, "TransitionCallbackReturn": types.SimpleNamespace(
            SUCCESS="success", FAILURE="failure")},
        "rcl_interfaces": {}, "rcl_interfaces.msg": {"SetParametersResult": types.SimpleNamespace},
        "std_srvs": {}, "std_srvs.srv": {"Trigger": types.SimpleNamespace(
            Request=types.SimpleNamespace, Response=types.SimpleNamespace)},
        "rclpy.parameter": {"Parameter": types.SimpleNamespace(
            Type=types.SimpleNamespace(DOUBLE_ARRAY="type double array", STRING_ARRAY="type string array"))},
        "rclpy.qos": {"qos_profile_sensor_data": "sensor data"},
        "tf2_ros": {"TransformBroadcaster": Broadcaster},
    }
    for package, names in MESSAGES.items():
        modules[package] = {}
        modules[f"{package}.msg"] = {name: message_class(f"{package}/msg/{name}") for name in names}
    for name, content in modules.items():
        module = types.ModuleType(name)
        module.__dict__.update(content)
        sys.modules[name] = module
