"""Requests on the wire from Python's values. A `ValueError` names the argument to change."""

from __future__ import annotations

import hashlib
import os
import uuid
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, TypeAlias

import numpy as np
import numpy.typing as npt

from .answers import Camera, FeatureSource
from .geometry import real, wire_pose, wire_twist, wire_vector
from .v1 import catalog_pb2, evaluation_pb2, geometry_pb2, localization_pb2, navigation_pb2, odometry_pb2
from .views import Latent, View, png, wire_view
from .words import Fusion, InverseVariant, StepMode, enum_value

# The approximate size of one message of an upload, bytes.
UPLOAD_BYTES = 1 << 20

Bytes: TypeAlias = "bytes | str | os.PathLike[str]"


def count(number: int | None, argument: str) -> Any:
    """A number that is counted from 0: a frame's row, steps, frames."""
    if number is not None and not 0 <= number < 1 << 32:
        raise ValueError(f"{argument}: {number} is not a number from 0 to 2³² - 1")
    return number


def names(given: Sequence[str] | str) -> Sequence[str]:
    """Names, of which one may be given alone."""
    return [given] if isinstance(given, str) else given


def wire_views(views: Sequence[View]) -> list[geometry_pb2.View]:
    """Views on the wire. One view alone is refused: the bytes of an image are a sequence too, of numbers."""
    if isinstance(views, (bytes, str, os.PathLike)):
        raise TypeError(f"views: is a sequence of views, not {type(views).__name__}; put one into a list")
    return [wire_view(view) for view in views]


def step_mode(word: str | None) -> Any:
    return enum_value(navigation_pb2.StepMode, "STEP_MODE_", word, "step_mode")


def split_value(word: str | None) -> Any:
    """The value of a split; "fold1" and "fold_1" are the same."""
    if isinstance(word, str) and word.startswith("fold") and word[4:].isdigit():
        word = f"fold_{word[4:]}"
    return enum_value(geometry_pb2.Split, "SPLIT_", word, "split")


def wire_camera(camera: Camera | None) -> geometry_pb2.CameraIntrinsics | None:
    if camera is None:
        return None
    model = enum_value(geometry_pb2.DistortionModel, "DISTORTION_MODEL_", camera.distortion_model, "distortion_model")
    return geometry_pb2.CameraIntrinsics(
        width=camera.width,
        height=camera.height,
        fx=camera.fx,
        fy=camera.fy,
        cx=camera.cx,
        cy=camera.cy,
        distortion_model=model,
        distortion=camera.distortion,
    )


def wire_view_camera(camera: Camera | str | None) -> geometry_pb2.ViewCamera | None:
    """The camera of a request's images: stated, or "mapping" for the camera that mapped the room."""
    if camera is None:
        return None
    if isinstance(camera, str):
        if camera != "mapping":
            raise ValueError(f'camera: must be a Camera or "mapping", got {camera!r}')
        return geometry_pb2.ViewCamera(mapping_camera=geometry_pb2.MappingCamera())
    return geometry_pb2.ViewCamera(intrinsics=wire_camera(camera))


def requested_motion(
    to: int | None, twist: npt.ArrayLike | None, pose: npt.ArrayLike | None
) -> navigation_pb2.RequestedMotion:
    """A motion by the frame at its end, as one twist (6,) or several (n, 6), or by the pose at its end."""
    if (to is not None) + (twist is not None) + (pose is not None) != 1:
        raise ValueError("give exactly one of to (a frame's row), twist and pose")
    if to is not None:
        return navigation_pb2.RequestedMotion(target_frame_id=count(to, "to"))
    if pose is not None:
        return navigation_pb2.RequestedMotion(target_pose=wire_pose(pose))

    assert twist is not None
    twists = real(twist, "twist")
    if twists.ndim not in (1, 2):
        raise ValueError(f"twist: is (6,), or several (n, 6), not {twists.shape}")
    if twists.ndim == 1:
        return navigation_pb2.RequestedMotion(twist=wire_twist(twists))
    return navigation_pb2.RequestedMotion(twists=navigation_pb2.TwistList(twists=[wire_twist(row) for row in twists]))


@dataclass(frozen=True, eq=False)
class NavigationQuery:
    """One navigation: from a view, by a motion. See `Client.navigate` for what the arguments mean."""

    source: View
    to: int | None = None
    twist: npt.ArrayLike | None = None
    pose: npt.ArrayLike | None = None
    source_pose: npt.ArrayLike | None = None
    steps: int | None = None
    step_mode: StepMode | None = None
    inverse_variant: InverseVariant | None = None
    navigator: str | None = None
    top_k: int | None = None
    exclude_source: bool = False
    exclude_radius: int = 0

    def request(
        self, room: str, adapter: str | None, room_revision: int | None = None, adapter_revision: int | None = None
    ) -> navigation_pb2.NavigateRequest:
        return navigation_pb2.NavigateRequest(
            room=room,
            room_revision=room_revision,
            adapter=adapter,
            adapter_revision=adapter_revision,
            source=wire_view(self.source),
            source_pose=None if self.source_pose is None else wire_pose(self.source_pose),
            motion=requested_motion(self.to, self.twist, self.pose),
            steps=count(self.steps, "steps"),
            step_mode=step_mode(self.step_mode),
            inverse_variant=enum_value(
                navigation_pb2.InverseVariant, "INVERSE_VARIANT_", self.inverse_variant, "inverse_variant"
            ),
            navigator=self.navigator,
            top_k=count(self.top_k, "top_k"),
            exclude_source=self.exclude_source,
            exclude_radius=count(self.exclude_radius, "exclude_radius"),
        )


@dataclass(frozen=True, eq=False)
class LocalizationQuery:
    """One view to localize. See `Client.localize` for what the arguments mean."""

    view: View
    rooms: Sequence[str] | str = ()
    room_revisions: Mapping[str, int] | None = None
    adapter: str | None = None
    adapter_revision: int | None = None
    top_k: int | None = None
    camera: Camera | Literal["mapping"] | None = None

    def request(self) -> localization_pb2.LocalizeRequest:
        return localization_pb2.LocalizeRequest(
            rooms=names(self.rooms),
            room_revisions=self.room_revisions,
            adapter=self.adapter,
            adapter_revision=self.adapter_revision,
            view=wire_view(self.view),
            top_k=count(self.top_k, "top_k"),
            camera=wire_view_camera(self.camera),
        )


@dataclass(frozen=True, eq=False)
class InitialPose:
    """A known pose of the camera or of the robot's base.

    Attributes:
        pose: The pose in the map, (4, 4).
        position_deviation_m: The standard deviation of the position along each axis, meters; None for 0.1.
        rotation_deviation_rad: The standard deviation of the rotation about each axis, radians; None for 0.1.
        child_frame: The coordinate frame whose pose it is: the name of the camera (the default) or the base.
    """

    pose: npt.ArrayLike
    position_deviation_m: float | None = None
    rotation_deviation_rad: float | None = None
    child_frame: str = ""

    def message(self) -> odometry_pb2.InitialPose:
        return odometry_pb2.InitialPose(
            pose=wire_pose(self.pose, child_frame=self.child_frame),
            position_deviation_m=self.position_deviation_m,
            rotation_deviation_rad=self.rotation_deviation_rad,
        )


@dataclass(frozen=True, eq=False)
class RigCamera:
    """Another camera on the robot.

    Attributes:
        name: Its name, which `other_views` of a step use.
        pose: Its pose (4, 4) in the frame of the base or, without `base_from_camera`, of the stream's own camera.
        intrinsics: Its intrinsics, if they are known.
        time_offset_ns: The time from the middle of the exposure of the stream's own view to that of this camera's
            view, nanoseconds.
    """

    name: str
    pose: npt.ArrayLike
    intrinsics: Camera | None = None
    time_offset_ns: int = 0


@dataclass(frozen=True, eq=False)
class InertialSensor:
    """A gyroscope and an accelerometer on the robot. Noise applies to each axis; None selects the server's default.

    Attributes:
        pose: The pose (4, 4) of their axes in the frame of the base or, without `base_from_camera`, of the camera.
        gyroscope_noise: White noise of the gyroscope, rad/s/√Hz.
        accelerometer_noise: White noise of the accelerometer, m/s²/√Hz.
        gyroscope_bias_deviation: Standard deviation of the gyroscope's bias at the beginning, rad/s.
        accelerometer_bias_deviation: Standard deviation of the accelerometer's bias at the beginning, m/s².
        gyroscope_bias_walk: Random walk of the gyroscope's bias, rad/s²/√Hz.
        accelerometer_bias_walk: Random walk of the accelerometer's bias, m/s³/√Hz.
        time_offset_ns: Is added to the timestamps of the samples to get those of the images, nanoseconds.
    """

    pose: npt.ArrayLike | None = None
    gyroscope_noise: float | None = None
    accelerometer_noise: float | None = None
    gyroscope_bias_deviation: float | None = None
    accelerometer_bias_deviation: float | None = None
    gyroscope_bias_walk: float | None = None
    accelerometer_bias_walk: float | None = None
    time_offset_ns: int = 0

    def message(self) -> odometry_pb2.InertialSensor:
        noises = {name: getattr(self, name) for name in self.__dataclass_fields__ if name != "pose"}
        return odometry_pb2.InertialSensor(pose=None if self.pose is None else wire_pose(self.pose), **noises)


@dataclass(frozen=True, eq=False)
class InertialSamples:
    """Samples of an inertial sensor in its axes: times (n,) in ns, angular velocities (n, 3) in rad/s, and
    accelerations (n, 3) in m/s², which are 9.8 upwards at rest."""

    timestamps_ns: Sequence[int] | npt.NDArray[np.int64]
    angular_velocity: npt.ArrayLike
    linear_acceleration: npt.ArrayLike

    def messages(self) -> list[odometry_pb2.InertialSample]:
        integers(self.timestamps_ns, "inertial.timestamps_ns", range(-(1 << 63), 1 << 63))
        count = len(self.timestamps_ns)
        columns = []
        for argument in ("angular_velocity", "linear_acceleration"):
            values = real(getattr(self, argument), f"inertial.{argument}")
            if values.shape != (count, 3):
                raise ValueError(f"inertial.{argument}: is {values.shape}, not ({count}, 3)")
            columns.append(values)
        rows = zip(self.timestamps_ns, *columns, strict=True)
        return [
            odometry_pb2.InertialSample(
                timestamp_ns=int(time), angular_velocity=wire_vector(rate), linear_acceleration=wire_vector(force)
            )
            for time, rate, force in rows
        ]


@dataclass(frozen=True, eq=False)
class TrackConfig:
    """The configuration of a tracking stream. None selects the server's default.

    Attributes:
        room: The room; None to find it from the first frames, among `rooms`.
        rooms: The rooms that the camera may be in; () for all. Refused together with `room`.
        room_revisions: The revisions of rooms that are not the current ones, by name of the room.
        adapter: The adapter; None for the default of the rooms. Images of rooms with keypoints need none.
        adapter_revision: The revision of `adapter`; None for the current one.
        initial_pose: The pose at the first frame; None to find it from the first frames. Needs `room`.
        keyframe_motion_norm: A new keyframe is taken after a motion of at least this norm, meters and radians mixed.
        keyframe_interval: The interval of keyframes in sequence numbers; None for 30.
        fusion: "anchors" (the default): located views correct the drift; "none": pure dead reckoning, which needs an
            initial pose.
        newest_only: Whether frames that arrive faster than they can be answered are dropped for newer ones.
        token_every: Every n-th answer carries the token with which a cut stream resumes, at least 1.
        base_from_camera: The pose of the camera in the frame of the robot's base, (4, 4). With it, answers also have
            the poses of the base.
        camera: The camera, or "mapping" for the one that mapped the rooms. In a room with keypoints, the focal length
            of an unknown camera is estimated from the first images.
        gravity_in_map: The direction of gravity in the room's world frame, (3,) of any length. Needs `room`.
        other_cameras: Other cameras on the robot, at most 8.
        inertial_sensor: A gyroscope and an accelerometer on the robot.
        trust_odometry: Whether the odometry of the steps is used where images or the gyroscope contradict it, and
            carries the pose where no view is located.
        time_offset_ns: The time from a frame's timestamp to the start of its exposure, nanoseconds. Only the
            integration of inertial samples uses it.
    """

    room: str | None = None
    rooms: Sequence[str] | str = ()
    room_revisions: Mapping[str, int] | None = None
    adapter: str | None = None
    adapter_revision: int | None = None
    initial_pose: InitialPose | None = None
    keyframe_motion_norm: float | None = None
    keyframe_interval: int | None = None
    fusion: Fusion | None = None
    newest_only: bool = False
    token_every: int = 1
    base_from_camera: npt.ArrayLike | None = None
    camera: Camera | Literal["mapping"] | None = None
    gravity_in_map: npt.ArrayLike | None = None
    other_cameras: Sequence[RigCamera] = ()
    inertial_sensor: InertialSensor | None = None
    trust_odometry: bool = False
    time_offset_ns: int = 0

    def message(self) -> odometry_pb2.TrackConfig:
        if self.token_every < 1:
            raise ValueError("token_every: a stream that can resume needs a token now and then; give 1 or more")
        keyframes = None
        if self.keyframe_motion_norm is not None or self.keyframe_interval is not None:
            keyframes = odometry_pb2.KeyframePolicy(
                motion_norm=self.keyframe_motion_norm, sequence_interval=self.keyframe_interval
            )
        others = [
            odometry_pb2.RigCamera(
                name=other.name,
                pose=wire_pose(other.pose),
                intrinsics=wire_camera(other.intrinsics),
                time_offset_ns=other.time_offset_ns,
            )
            for other in self.other_cameras
        ]
        pressure = odometry_pb2.BACK_PRESSURE_NEWEST if self.newest_only else odometry_pb2.BACK_PRESSURE_UNSPECIFIED
        return odometry_pb2.TrackConfig(
            room=self.room,
            rooms=names(self.rooms),
            room_revisions=self.room_revisions,
            adapter=self.adapter,
            adapter_revision=self.adapter_revision,
            initial_pose=self.initial_pose.message() if self.initial_pose else None,
            keyframes=keyframes,
            fusion=enum_value(odometry_pb2.Fusion, "FUSION_", self.fusion, "fusion"),
            back_pressure=pressure,
            token_every=self.token_every,
            base_from_camera=None if self.base_from_camera is None else wire_pose(self.base_from_camera),
            camera=wire_view_camera(self.camera),
            gravity_in_map=None if self.gravity_in_map is None else wire_vector(self.gravity_in_map),
            other_cameras=others,
            inertial_sensor=self.inertial_sensor.message() if self.inertial_sensor else None,
            trust_odometry=self.trust_odometry,
            time_offset_ns=self.time_offset_ns,
        )


@dataclass(frozen=True, eq=False)
class Odometry:
    """The odometry of another sensor at a frame, for instance of wheels.

    Attributes:
        pose: The pose in the sensor's own odometry frame, (4, 4). It may drift and must not jump.
        child_frame: The coordinate frame whose pose it is: the name of the camera or the base. Empty for the base
            with `base_from_camera`, else the camera.
        translation_share: The standard deviation of a translation along each axis, meters per meter traveled; None
            for 0.05.
        rotation_share: The standard deviation of a rotation about each axis, radians per radian of rotation and per
            meter traveled; None for 0.05.
        velocity_covariance: The covariance (6, 6) of the independent error of the velocity since the last frame, on
            (v, ω) in the body frame, m²/s² and rad²/s², as `twist.covariance` of ROS.
    """

    pose: npt.ArrayLike
    child_frame: str = ""
    translation_share: float | None = None
    rotation_share: float | None = None
    velocity_covariance: npt.ArrayLike | None = None


@dataclass(frozen=True, eq=False)
class Gravity:
    """The direction of gravity measured on the robot.

    Attributes:
        direction: The direction (3,), of any length; at rest it is opposite to the measured acceleration.
        coordinate_frame: The coordinate frame of the direction: the name of the camera or the base. Empty for the
            base with `base_from_camera`, else the camera.
        deviation_rad: The standard deviation about each axis, radians; None for 0.03.
    """

    direction: npt.ArrayLike
    coordinate_frame: str = ""
    deviation_rad: float | None = None


@dataclass(frozen=True, eq=False)
class DepthImage:
    """Depths (h, w) of an image along its optical axis, in meters; those that are not finite, or 0, are unknown.

    They are registered to the image: the same optical center, lens, orientation and aspect ratio. `deviation_m` is the
    standard deviation of a depth of 1 m; that of a depth z is z² times it. For stereo it is that of the disparity in
    pixels, over the focal length in pixels and the baseline in meters.
    """

    depths: npt.ArrayLike
    deviation_m: float | None = None

    def message(self) -> odometry_pb2.DepthImage:
        depths = real(self.depths, "depth.depths")
        if depths.ndim != 2 or 0 in depths.shape:
            raise ValueError(f"depth.depths: is {depths.shape}, not (height, width)")
        millimeters = np.nan_to_num(np.round(depths * 1000), nan=0, posinf=0, neginf=0)
        millimeters[(millimeters < 0) | (millimeters > np.iinfo(np.uint16).max)] = 0
        return odometry_pb2.DepthImage(png=png(millimeters.astype(np.uint16)), deviation_m=self.deviation_m)


def track_frame(
    view: View,
    timestamp_ns: int,
    sequence_number: int,
    odometry: Odometry | None,
    gravity: Gravity | None,
    other_views: dict[str, View],
    inertial: InertialSamples | None,
    exposure_ns: int,
    depth: DepthImage | None,
) -> odometry_pb2.TrackRequest:
    """A frame of a tracking stream."""
    measured = None
    if odometry is not None:
        noise = odometry.velocity_covariance
        covariance = None if noise is None else real(noise, "odometry.velocity_covariance")
        if covariance is not None and covariance.shape != (6, 6):
            raise ValueError(f"odometry.velocity_covariance: is {covariance.shape}, not (6, 6)")
        measured = odometry_pb2.MeasuredOdometry(
            pose=wire_pose(odometry.pose, child_frame=odometry.child_frame),
            translation_share=odometry.translation_share,
            rotation_share=odometry.rotation_share,
            velocity_covariance=None if covariance is None else covariance.ravel().tolist(),
        )
    down = None
    if gravity is not None:
        down = odometry_pb2.MeasuredGravity(
            direction=wire_vector(gravity.direction),
            coordinate_frame=gravity.coordinate_frame,
            deviation_rad=gravity.deviation_rad,
        )
    others = [odometry_pb2.OtherView(camera_name=name, view=wire_view(other)) for name, other in other_views.items()]
    return odometry_pb2.TrackRequest(
        frame=odometry_pb2.TrackFrame(
            timestamp_ns=timestamp_ns,
            sequence_number=sequence_number,
            view=wire_view(view),
            odometry=measured,
            gravity=down,
            other_views=others,
            inertial_samples=inertial.messages() if inertial else None,
            exposure_ns=exposure_ns,
            depth=depth.message() if depth else None,
        )
    )


@dataclass(frozen=True, eq=False)
class Prediction:
    """What a navigator of one's own answers to a pair of frames: a latent (k,) to retrieve by, or a frame's row."""

    source: int
    target: int
    latent: npt.ArrayLike | Latent | None = None
    frame: int | None = None
    last_step_frame: int | None = None

    def __post_init__(self) -> None:
        if (self.latent is None) == (self.frame is None):
            raise ValueError("a prediction is exactly one of latent and frame")

    def message(self) -> evaluation_pb2.Prediction:
        latent = self.latent
        if latent is not None and not isinstance(latent, Latent):
            latent = Latent(real(latent, "latent"))
        return evaluation_pb2.Prediction(
            source_frame_id=count(self.source, "source"),
            target_frame_id=count(self.target, "target"),
            latent=None if latent is None else latent.message(),
            retrieved_frame_id=count(self.frame, "frame"),
            last_step_frame_id=count(self.last_step_frame, "last_step_frame"),
        )


def predictions(
    given: Sequence[Prediction] | None,
    sources: npt.ArrayLike | None,
    targets: npt.ArrayLike | None,
    latents: npt.ArrayLike | None,
    frames: npt.ArrayLike | None,
) -> list[evaluation_pb2.Prediction]:
    """Predictions on the wire, from objects or from arrays."""
    arrays = (sources, targets, latents, frames)
    if given is not None:
        if any(array is not None for array in arrays):
            raise ValueError("give predictions, or sources and targets with latents or frames; not both")
        return [one.message() for one in given]
    if sources is None or targets is None or (latents is None) == (frames is None):
        raise ValueError("give predictions, or sources, targets and exactly one of latents and frames")

    ends = [_rows(sources, "sources"), _rows(targets, "targets")]
    found = _rows(frames, "frames") if frames is not None else real(latents, "latents")  # type: ignore[arg-type]
    if latents is not None and found.ndim != 2:
        raise ValueError(f"latents: are (n, k), not {found.shape}")
    if not len(ends[0]) == len(ends[1]) == len(found):
        lengths = f"{len(ends[0])}, {len(ends[1])} and {len(found)}"
        raise ValueError(f"sources, targets and predictions have different lengths: {lengths}")
    rows = zip(*ends, found, strict=True)
    if latents is not None:
        return [Prediction(int(source), int(target), latent=one).message() for source, target, one in rows]
    return [Prediction(int(source), int(target), frame=int(one)).message() for source, target, one in rows]


def _rows(values: npt.ArrayLike, argument: str) -> npt.NDArray[np.int64]:
    rows = np.asarray(values)
    if rows.ndim != 1 or not (np.issubdtype(rows.dtype, np.integer) or rows.size == 0):
        raise ValueError(f"{argument}: are whole numbers (n,), not {rows.dtype} of shape {rows.shape}")
    return rows.astype(np.int64)


def integers(values: Any, argument: str, within: range) -> None:
    """Refuses what is no list of whole numbers within a range."""
    if values is None:
        return
    for row, value in enumerate(values):
        if not isinstance(value, (int, np.integer)) or isinstance(value, bool) or int(value) not in within:
            raise ValueError(
                f"{argument}: row {row} is {value!r}, and no whole number from {within.start} to {within.stop - 1}"
            )


def new_id() -> str:
    """A request id, by which a change that is sent again is known as the same one."""
    return uuid.uuid4().hex


def feature_source(source: FeatureSource) -> catalog_pb2.FeatureSource:
    """A feature source on the wire."""
    words = ("layer_index_base", "final_norm")
    plain = {name: getattr(source, name) for name in FeatureSource.__dataclass_fields__ if name not in words}
    base = enum_value(catalog_pb2.LayerIndexBase, "LAYER_INDEX_BASE_", source.layer_index_base, "layer_index_base")
    norm = enum_value(catalog_pb2.FinalNorm, "FINAL_NORM_", source.final_norm, "final_norm")
    return catalog_pb2.FeatureSource(layer_index_base=base, final_norm=norm, **plain)


@dataclass(frozen=True, eq=False)
class Upload:
    """A room to upload: poses world_from_camera (n, 4, 4), and features (n, d) by their sources or n images."""

    poses: npt.ArrayLike
    features: Sequence[tuple[FeatureSource, npt.NDArray[np.floating]]] = ()
    images: Sequence[Bytes] = ()
    timestamps_ns: Sequence[int] | npt.NDArray[np.int64] | None = None
    names: Sequence[str] = ()
    segments: Sequence[int] | npt.NDArray[np.integer] | None = None

    def __post_init__(self) -> None:
        poses = real(self.poses, "poses").astype("<f8")
        if poses.ndim != 3 or poses.shape[1:] != (4, 4) or len(poses) == 0:
            raise ValueError(f"poses: are (n, 4, 4) with at least one frame, not {poses.shape}")
        counts = {"images": self.images, "names": self.names}
        counts |= {"timestamps_ns": self.timestamps_ns, "segments": self.segments}  # type: ignore[dict-item]
        for argument, values in counts.items():
            if values is not None and len(values) not in (0, len(poses)):
                raise ValueError(f"{argument}: has {len(values)} entries, there are {len(poses)} poses")
        integers(self.timestamps_ns, "timestamps_ns", range(-(1 << 63), 1 << 63))
        integers(self.segments, "segments", range(1 << 32))
        for row, name in enumerate(self.names):
            if not isinstance(name, str):
                raise ValueError(f"names: row {row} is {name!r}, and no text")
        for row, image in enumerate(self.images):
            if not isinstance(image, (bytes, str, os.PathLike)):
                raise ValueError(f"images: row {row} is {image!r}, and neither bytes nor a path")
            if not isinstance(image, bytes) and not Path(image).is_file():
                raise ValueError(f"images: row {row}, {image}, is no file")
        for source, rows in self.features:
            if np.asarray(rows).shape != (len(poses), source.dim):
                shape = np.asarray(rows).shape
                raise ValueError(f"features: {source.name!r} is ({len(poses)}, {source.dim}), not {shape}")
        object.__setattr__(self, "poses", poses)

    def messages(self, room: catalog_pb2.RoomUpload) -> Iterator[catalog_pb2.UploadRoomRequest]:
        """The messages of the upload, the description first and the checksum last."""
        yield catalog_pb2.UploadRoomRequest(room=room)
        digest = hashlib.sha256()
        poses = np.asarray(self.poses)
        for rows in self._batches():
            batch = self._batch(slice(rows.start, rows.stop))
            for content in (batch.poses, *batch.features, *batch.images):
                digest.update(content)
            yield catalog_pb2.UploadRoomRequest(frames=batch)

        end = catalog_pb2.UploadEnd(frame_count=len(poses), sha256=digest.digest())
        yield catalog_pb2.UploadRoomRequest(end=end)

    def _batches(self) -> Iterator[range]:
        count = len(np.asarray(self.poses))
        if self.images:
            # An image may have several megabytes.
            yield from (range(row, row + 1) for row in range(count))
            return
        bytes_per_frame = 128 + sum(4 * source.dim for source, _ in self.features)
        size = max(1, UPLOAD_BYTES // bytes_per_frame)
        yield from (range(start, min(start + size, count)) for start in range(0, count, size))

    def _batch(self, rows: slice) -> catalog_pb2.FrameBatch:
        poses = np.asarray(self.poses)[rows]
        return catalog_pb2.FrameBatch(
            poses=poses.tobytes(),
            features=[np.asarray(values)[rows].astype("<f4").tobytes() for _, values in self.features],
            images=[image if isinstance(image, bytes) else Path(image).read_bytes() for image in self.images[rows]],
            timestamps_ns=[] if self.timestamps_ns is None else [int(time) for time in self.timestamps_ns[rows]],
            frame_names=self.names[rows],
            segments=[] if self.segments is None else [int(number) for number in self.segments[rows]],
        )
