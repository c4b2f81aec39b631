"""Rosbags of boxes as other programs write them: mcap's writer, and rosbags' own."""

from types import SimpleNamespace

import numpy as np
from mcap_ros2.writer import Writer as McapWriter
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

SEPARATOR = "=" * 80
PARTS = {
    "std_msgs/Header": "builtin_interfaces/Time stamp\nstring frame_id",
    "builtin_interfaces/Time": "int32 sec\nuint32 nanosec",
    "geometry_msgs/Point": "float64 x\nfloat64 y\nfloat64 z",
    "geometry_msgs/Vector3": "float64 x\nfloat64 y\nfloat64 z",
    "geometry_msgs/Quaternion": "float64 x\nfloat64 y\nfloat64 z\nfloat64 w",
    "geometry_msgs/Pose": "geometry_msgs/Point position\ngeometry_msgs/Quaternion orientation",
    "geometry_msgs/PoseWithCovariance": "geometry_msgs/Pose pose\nfloat64[36] covariance",
    "geometry_msgs/PoseStamped": "std_msgs/Header header\ngeometry_msgs/Pose pose",
    "vision_msgs/ObjectHypothesis": "string class_id\nfloat64 score",
    "vision_msgs/ObjectHypothesisWithPose": (
        "vision_msgs/ObjectHypothesis hypothesis\ngeometry_msgs/PoseWithCovariance pose"
    ),
    "vision_msgs/BoundingBox3D": "geometry_msgs/Pose center\ngeometry_msgs/Vector3 size",
    "vision_msgs/Detection3D": (
        "std_msgs/Header header\nvision_msgs/ObjectHypothesisWithPose[] results\n"
        "vision_msgs/BoundingBox3D bbox\nstring id"
    ),
    "vision_msgs/Detection3DArray": (
        "std_msgs/Header header\nvision_msgs/Detection3D[] detections"
    ),
    "vision_msgs/Point2D": "float64 x\nfloat64 y",
    "vision_msgs/Pose2D": "vision_msgs/Point2D position\nfloat64 theta",
    "vision_msgs/BoundingBox2D": "vision_msgs/Pose2D center\nfloat64 size_x\nfloat64 size_y",
    "vision_msgs/Detection2D": (
        "std_msgs/Header header\nvision_msgs/ObjectHypothesisWithPose[] results\n"
        "vision_msgs/BoundingBox2D bbox\nstring id"
    ),
    "vision_msgs/Detection2DArray": (
        "std_msgs/Header header\nvision_msgs/Detection2D[] detections"
    ),
    "unique_identifier_msgs/UUID": "uint8[16] uuid",
    "autoware_perception_msgs/ObjectClassification": "uint8 label\nfloat32 probability",
    "geometry_msgs/Point32": "float32 x\nfloat32 y\nfloat32 z",
    "geometry_msgs/Polygon": "geometry_msgs/Point32[] points",
    "autoware_perception_msgs/Shape": (
        "uint8 type\ngeometry_msgs/Polygon footprint\ngeometry_msgs/Vector3 dimensions"
    ),
    "autoware_perception_msgs/TrackedObjectKinematics": (
        "geometry_msgs/PoseWithCovariance pose_with_covariance\nuint8 orientation_availability\n"
        "bool is_stationary"
    ),
    "autoware_perception_msgs/TrackedObject": (
        "unique_identifier_msgs/UUID object_id\nfloat32 existence_probability\n"
        "autoware_perception_msgs/ObjectClassification[] classification\n"
        "autoware_perception_msgs/TrackedObjectKinematics kinematics\n"
        "autoware_perception_msgs/Shape shape"
    ),
    "autoware_perception_msgs/TrackedObjects": (
        "std_msgs/Header header\nautoware_perception_msgs/TrackedObject[] objects"
    ),
}


def definition(kind):
    """A type's definition with those of all it holds, as bags store it."""
    needed, open_kinds = {}, [kind]
    while open_kinds:
        one = open_kinds.pop()
        needed[one] = PARTS[one]
        for line in PARTS[one].splitlines():
            inner = line.split()[0].split("[")[0]
            if inner in PARTS and inner not in needed:
                open_kinds.append(inner)
    first = needed.pop(kind)
    return "\n".join([first, *(f"{SEPARATOR}\nMSG: {n}\n{text}" for n, text in needed.items())])


def header(time_ns, frame):
    sec, nanosec = divmod(time_ns, 1_000_000_000)
    return {"stamp": {"sec": sec, "nanosec": nanosec}, "frame_id": frame}


def pose(place, yaw):
    turn = {"x": 0.0, "y": 0.0, "z": float(np.sin(yaw / 2)), "w": float(np.cos(yaw / 2))}
    return {"position": dict(zip("xyz", map(float, place), strict=True)), "orientation": turn}


def covariant(place, yaw):
    return {"pose": pose(place, yaw), "covariance": np.zeros(36)}


def size(length, width, height):
    return {"x": length, "y": width, "z": height}


def detection_3d(time_ns, place, yaw, *, name="car", score=0.9, who="", frame="base_link"):
    guess = {"hypothesis": {"class_id": name, "score": score}, "pose": covariant(place, yaw)}
    bbox = {"center": pose(place, yaw), "size": size(4.2, 1.8, 1.5)}
    return {"header": header(time_ns, frame), "results": [guess], "bbox": bbox, "id": who}


def detection_2d(time_ns, left, top, *, who=""):
    guess = {
        "hypothesis": {"class_id": "car", "score": 0.9},
        "pose": covariant((0.0, 0.0, 0.0), 0.0),
    }
    centre = {"position": {"x": left + 30.0, "y": top + 20.0}, "theta": 0.0}
    bbox = {"center": centre, "size_x": 60.0, "size_y": 40.0}
    return {"header": header(time_ns, "camera"), "results": [guess], "bbox": bbox, "id": who}


def tracked_object(place, yaw, *, who):
    return {
        "object_id": {"uuid": np.full(16, who, dtype=np.uint8)},
        "existence_probability": 0.8,
        "classification": [{"label": 1, "probability": 1.0}],
        "kinematics": {
            "pose_with_covariance": covariant(place, yaw),
            "orientation_availability": 2,
            "is_stationary": False,
        },
        "shape": {"type": 0, "footprint": {"points": []}, "dimensions": size(4.2, 1.8, 1.5)},
    }


def _attributes(value):
    """For mcap's writer, which takes attributes."""
    if isinstance(value, dict):
        return SimpleNamespace(**{name: _attributes(each) for name, each in value.items()})
    if isinstance(value, np.ndarray):
        return value.tolist()
    return [_attributes(each) for each in value] if isinstance(value, list) else value


def write_mcap(path, topics):
    """``topics``: type and messages ``(time_ns, message)`` by name."""
    with path.open("wb") as stream, McapWriter(stream) as writer:
        for topic, (kind, messages) in topics.items():
            package, name = kind.split("/")
            schema = writer.register_msgdef(f"{package}/msg/{name}", definition(kind))
            for time_ns, message in messages:
                writer.write_message(
                    topic, schema, _attributes(message), log_time=time_ns, publish_time=time_ns
                )
    return path


def write_rosbag2(path, topics, *, storage=StoragePlugin.SQLITE3):
    """The same as a folder of ROS 2."""
    store = get_typestore(Stores.ROS2_HUMBLE)
    types = {}
    for kind, text in PARTS.items():
        package, name = kind.split("/")
        if not package.startswith(("std", "builtin", "geometry", "unique")):
            types.update(get_types_from_msg(text, f"{package}/msg/{name}"))
    store.register(types)

    def made(kind, value):
        fields = store.fielddefs[kind][1]
        given = {name: _made(store, made, of, value[name]) for name, of in fields}
        return store.types[kind](**given)

    with Writer(path, version=9, storage_plugin=storage) as writer:
        for topic, (kind, messages) in topics.items():
            full = kind.replace("/", "/msg/")
            connection = writer.add_connection(topic, full, typestore=store)
            for time_ns, message in messages:
                data = store.serialize_cdr(made(full, message), full)
                writer.write(connection, time_ns, data)
    return path


def _made(store, made, of, value):
    _, detail = of
    if isinstance(value, dict):
        return made(detail, value)
    if isinstance(value, list):
        (inner, name), _ = detail
        return [made(name, each) for each in value] if inner == 2 else value
    return value
