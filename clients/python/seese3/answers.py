"""What a server answers, as dataclasses of NumPy arrays.

What a server left out is None here, and never 0: an absent R² is no R² of 0. Shapes and units are those of `geometry`;
covariances of motions are on (v, ω), in the body frame of the first camera. Times are whole nanoseconds. Pictures and
tables need the extras `seese3[plots]` and `seese3[pandas]`.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from datetime import datetime, timezone
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from . import errors
from .errors import understood
from .geometry import Array, covariance_matrix, pose_matrix, twist_vector
from .v1 import catalog_pb2, evaluation_pb2, geometry_pb2, localization_pb2, navigation_pb2, odometry_pb2
from .views import Feature, Latent

if TYPE_CHECKING:
    import pandas


def _known(message: Any, field: str) -> Any:
    """An optional number, or None if it is absent."""
    return getattr(message, field) if message.HasField(field) else None


def _word(enum: Any, value: int, prefix: str) -> str:
    """A value of an enum as a word: TRACK_STATUS_LOST is "lost"."""
    try:
        name: str = enum.Name(value)
    except ValueError:
        # Of a server that is newer than this package.
        return f"unknown_{value}"
    return name.removeprefix(prefix).lower()


@dataclass(frozen=True)
class Revision:
    """A published version of a room or an adapter, which never changes."""

    name: str
    revision: int

    @classmethod
    @understood
    def of(cls, message: geometry_pb2.Revision) -> Revision:
        return cls(message.name, message.revision)


def _revision(message: Any, field: str) -> Revision | None:
    return Revision.of(getattr(message, field)) if message.HasField(field) else None


@dataclass(frozen=True, eq=False)
class PoseError:
    """How far an answer is from what was recorded. `within` says of each threshold ε whether the error met it."""

    translation_m: float
    rotation_rad: float
    twist_norm: float
    within: dict[float, bool]

    @classmethod
    @understood
    def of(cls, message: Any, field: str) -> PoseError | None:
        if not message.HasField(field):
            return None
        error = getattr(message, field)
        within = {check.threshold: check.met for check in error.thresholds}
        return cls(error.translation_m, error.rotation_rad, error.twist_norm, within)


@dataclass(frozen=True, eq=False)
class Frame:
    """A stored frame that was retrieved. `pose` is its world_from_camera, (4, 4); `distance` that of latents."""

    id: int
    distance: float
    pose: Array
    name: str | None
    timestamp_ns: int | None

    @classmethod
    @understood
    def of(cls, message: geometry_pb2.RetrievedFrame) -> Frame:
        return cls(
            message.frame_id,
            message.distance,
            pose_matrix(message.pose),
            message.frame_name or None,
            _known(message, "timestamp_ns"),
        )


@dataclass(frozen=True)
class FeatureSource:
    """How a set of features was made; what is not known is "unspecified"."""

    name: str
    dim: int
    encoder: str = "unspecified"
    layer: str = "unspecified"
    pooling: str = "unspecified"
    preprocess: str = "unspecified"
    base: str = "unspecified"
    norm: str = "unspecified"

    @classmethod
    @understood
    def of(cls, message: catalog_pb2.FeatureSource) -> FeatureSource:
        fields = cls.__dataclass_fields__
        return cls(**{name: getattr(message, name) for name in fields})


@dataclass(frozen=True)
class Camera:
    """A camera, in pixels or in any other unit of length in the image.

    `fy` is `fx` by default, and the principal point the middle of the image. The upper left corner of the image is at
    (0, 0): add 0.5 to the cx and cy of OpenCV and ROS. `distortion_model` is None, "brown_conrady" with at most 5
    coefficients k1, k2, p1, p2, k3, or "kannala_brandt" with 4; they are those of OpenCV.
    """

    width: float
    height: float
    fx: float
    fy: float | None = None
    cx: float | None = None
    cy: float | None = None
    distortion_model: str | None = None
    distortion: Sequence[float] = ()

    def __post_init__(self) -> None:
        # Not a number is outside every range.
        if not (0 < self.width < float("inf") and 0.1 <= self.height / self.width <= 10):
            raise ValueError(f"camera: images of {self.width} x {self.height} are none of a camera")
        for focal in (self.fx, self.fx if self.fy is None else self.fy):
            if not 0.1 <= focal / self.width <= 10:
                raise ValueError(f"camera: a focal length of {focal} is none for a width of {self.width}")
        for name, value, size in (("cx", self.cx, self.width), ("cy", self.cy, self.height)):
            if value is not None and not 0 <= value <= size:
                raise ValueError(f"camera: {name} = {value} is outside of the image, 0 to {size}")

        model, count = self.distortion_model, len(self.distortion)
        counts = {None: range(1), "brown_conrady": range(6), "kannala_brandt": range(4, 5)}
        if model not in counts:
            raise ValueError(f"camera: distortion_model {model!r} is none of {', '.join(map(repr, counts))}")
        if count not in counts[model]:
            raise ValueError(f"camera: distortion has {count} coefficients, which the model {model!r} does not take")
        object.__setattr__(self, "distortion", tuple(map(float, self.distortion)))

    @classmethod
    @understood
    def of(cls, message: geometry_pb2.CameraIntrinsics) -> Camera:
        has_model = message.distortion_model != geometry_pb2.DISTORTION_MODEL_UNSPECIFIED
        return cls(
            message.width,
            message.height,
            message.fx,
            message.fy or None,
            _known(message, "cx"),
            _known(message, "cy"),
            _word(geometry_pb2.DistortionModel, message.distortion_model, "DISTORTION_MODEL_") if has_model else None,
            message.distortion,
        )


@dataclass(frozen=True, eq=False)
class Room:
    """A room that is served. `adapters` fit its features, the default first."""

    revision: Revision
    frame_count: int
    adapters: tuple[str, ...]
    features: tuple[FeatureSource, ...]
    format: str
    licence: str
    worst_rotation_deviation: float
    created: datetime
    camera: Camera | None

    @property
    def name(self) -> str:
        return self.revision.name

    @classmethod
    @understood
    def of(cls, message: catalog_pb2.Room) -> Room:
        return cls(
            Revision.of(message.revision),
            message.frame_count,
            tuple(message.adapters),
            tuple(map(FeatureSource.of, message.features)),
            message.format,
            message.licence,
            message.worst_rotation_deviation,
            message.create_time.ToDatetime(timezone.utc),
            Camera.of(message.camera) if message.HasField("camera") else None,
        )


@dataclass(frozen=True)
class MotionScores:
    """R² of predicted motions over `n` pairs; None where the true motions do not vary, or nothing was held out."""

    n: int
    overall: float | None
    translation: float | None
    rotation: float | None
    direction: float | None
    magnitude: float | None
    still_components: int

    @classmethod
    @understood
    def of(cls, message: catalog_pb2.MotionScores) -> MotionScores:
        return cls(
            n=message.n,
            overall=_known(message, "overall"),
            translation=_known(message, "translation"),
            rotation=_known(message, "rotation"),
            direction=_known(message, "direction"),
            magnitude=_known(message, "magnitude"),
            still_components=message.still_components,
        )


@dataclass(frozen=True, eq=False)
class Adapter:
    """A trained adapter that is served, with how it was trained and its R²."""

    revision: Revision
    source: FeatureSource
    latent_dim: int
    charts: int
    training_rooms: tuple[Revision, ...]
    calibration_rooms: tuple[Revision, ...]
    preset: str
    split: str
    stride: int
    loss: str
    mixing: str
    seed: int
    test: MotionScores
    train: MotionScores
    train_mean_r2: float | None
    target_mean: Array
    target_deviation: Array
    singular_values: Array
    navigators: tuple[str, ...]
    created: datetime

    @property
    def name(self) -> str:
        return self.revision.name

    @classmethod
    @understood
    def of(cls, message: catalog_pb2.Adapter) -> Adapter:
        return cls(
            revision=Revision.of(message.revision),
            source=FeatureSource.of(message.source),
            latent_dim=message.latent_dim,
            charts=message.charts,
            training_rooms=tuple(map(Revision.of, message.training_rooms)),
            calibration_rooms=tuple(map(Revision.of, message.calibration_rooms)),
            preset=message.preset,
            split=message.split,
            stride=message.stride,
            loss=message.loss,
            mixing=message.mixing,
            seed=message.seed,
            test=MotionScores.of(message.test),
            train=MotionScores.of(message.train),
            train_mean_r2=_known(message, "train_mean_r2"),
            target_mean=twist_vector(message.target_mean),
            target_deviation=twist_vector(message.target_deviation),
            singular_values=np.array(message.singular_values),
            navigators=tuple(message.navigators),
            created=message.create_time.ToDatetime(timezone.utc),
        )


@dataclass(frozen=True, eq=False)
class RoomFrames:
    """The frames of a room, a row each. `neighbours` are (row, motion) of the frames near each one, the nearest first;
    `thumbnails` are JPEG files. What was not asked for, or is not known, is None."""

    room: Revision
    poses: Array
    names: tuple[str, ...] | None
    timestamps_ns: npt.NDArray[np.int64] | None
    sequences: npt.NDArray[np.int64]
    neighbours: tuple[tuple[tuple[int, Array], ...], ...] | None
    thumbnails: tuple[bytes, ...] | None

    def __len__(self) -> int:
        return len(self.poses)

    @classmethod
    @understood
    def of(
        cls,
        room: geometry_pb2.Revision,
        frames: Sequence[catalog_pb2.RoomFrame],
        with_neighbours: bool,
        with_thumbnails: bool,
    ) -> RoomFrames:
        times = [frame.timestamp_ns for frame in frames if frame.HasField("timestamp_ns")]
        names = tuple(frame.frame_name for frame in frames)
        return cls(
            room=Revision.of(room),
            poses=np.array([pose_matrix(frame.pose) for frame in frames]).reshape(-1, 4, 4),
            names=names if any(names) else None,
            timestamps_ns=np.array(times, dtype=np.int64) if times and len(times) == len(frames) else None,
            sequences=np.array([frame.sequence for frame in frames], dtype=np.int64),
            neighbours=tuple(
                tuple((near.frame_id, twist_vector(near.motion)) for near in frame.neighbours) for frame in frames
            )
            if with_neighbours
            else None,
            thumbnails=tuple(frame.thumbnail for frame in frames) if with_thumbnails else None,
        )


@dataclass(frozen=True)
class Publication:
    """What became of an upload: the revision, whether it is new, and whether it is served.

    `revision` is None if the upload was only validated.
    """

    revision: Revision | None
    created: bool
    served: bool

    @classmethod
    @understood
    def of(cls, message: Any) -> Publication:
        return cls(_revision(message, "revision"), message.created, message.served)


@dataclass(frozen=True)
class Default:
    """What an operator chose for a room or an adapter: its revision, the adapter that answers in it, or both.

    `kind` is "room" or "adapter", and says what `name` is the name of.
    """

    kind: str
    name: str
    revision: int | None
    adapter: str | None

    @classmethod
    @understood
    def of(cls, message: catalog_pb2.Default) -> Default:
        collection, _, name = message.name.partition("/")
        adapter = message.adapter.removeprefix("adapters/") or None
        return cls(collection.removesuffix("s"), name, _known(message, "revision"), adapter)


@dataclass(frozen=True, eq=False)
class KeypointMatches:
    """The matches of a view's keypoints with those of a room.

    `inliers` of the view's `keypoints` agree with the pose; `frame_ids` are the stored frames with agreeing keypoints.
    """

    inliers: int
    keypoints: int
    frame_ids: tuple[int, ...]

    @classmethod
    @understood
    def of(cls, message: Any) -> KeypointMatches | None:
        if not message.HasField("matches"):
            return None
        matches = message.matches
        return cls(matches.inliers, matches.keypoints, tuple(matches.frame_ids))


@dataclass(frozen=True, eq=False)
class FittedEstimate:
    """Details of a pose by the adapter that is fitted to the room: the nearest frame, and the gains of the motion
    from it to the view."""

    frame_id: int
    distance: float
    translation_reader: str
    translation_gain: float
    rotation_reader: str
    rotation_gain: float

    @classmethod
    @understood
    def of(cls, message: Any) -> FittedEstimate | None:
        if not message.HasField("fitted"):
            return None
        return cls(**{name: getattr(message.fitted, name) for name in cls.__dataclass_fields__})


@dataclass(frozen=True, eq=False)
class Place:
    """A frame of a room that looks like the view. `error` is there if the view is a stored frame itself."""

    room: Revision
    frame: Frame
    error: PoseError | None


@dataclass(frozen=True, eq=False)
class Localization:
    """The estimated pose of a view, world_from_camera (4, 4), in the world frame of `room`.

    `pose` is None if the view is not in the map; `reason` then states why. `covariance` (6, 6) is in ROS order: x, y,
    z, and rotations about the axes of the world frame; None if the errors of the method were not measured. `novelty`
    above 1 means not in the map. `method` is "matched_keypoints", "fitted_adapter", "similar_frames", "nearest_frame"
    or "recorded"; None without a pose. `places` are the stored frames most similar to the view, the best first.
    """

    pose: Array | None
    covariance: Array | None
    room: Revision
    novelty: float | None
    method: str | None
    reason: str | None
    matches: KeypointMatches | None
    fitted: FittedEstimate | None
    places: tuple[Place, ...]
    adapter: Revision | None
    room_count: int

    @classmethod
    @understood
    def of(cls, message: localization_pb2.LocalizeResponse) -> Localization:
        places = tuple(
            Place(Revision.of(place.room), Frame.of(place.frame), PoseError.of(place, "error"))
            for place in message.places
        )
        return cls(
            *_pose_with_covariance(message),
            Revision.of(message.room),
            _known(message, "novelty"),
            _method(message.method),
            message.reason or None,
            KeypointMatches.of(message),
            FittedEstimate.of(message),
            places,
            Revision.of(message.adapter) if message.HasField("adapter") else None,
            message.room_count,
        )


def _pose_with_covariance(message: Any) -> tuple[Array | None, Array | None]:
    if not message.HasField("pose"):
        return None, None
    return pose_matrix(message.pose.pose), covariance_matrix(message.pose.covariance)


def _method(value: int) -> str | None:
    if value == localization_pb2.LOCALIZATION_METHOD_UNSPECIFIED:
        return None
    return _word(localization_pb2.LocalizationMethod, value, "LOCALIZATION_METHOD_")


@dataclass(frozen=True, eq=False)
class RoomMatch:
    """How well views match one room. `pose`, `covariance`, `novelty`, `method`, `matches` and `fitted` are those of
    the newest view, as in Localization. `distance` and `distance_ratio` compare the latents of all views with the
    room; a ratio above 1 means that they look like another place. Both are None without an adapter."""

    room: Revision
    pose: Array | None
    covariance: Array | None
    novelty: float | None
    method: str | None
    matches: KeypointMatches | None
    fitted: FittedEstimate | None
    distance: float | None
    distance_ratio: float | None
    frames: tuple[Frame, ...]

    @classmethod
    @understood
    def of(cls, message: localization_pb2.RoomMatch) -> RoomMatch:
        return cls(
            Revision.of(message.room),
            *_pose_with_covariance(message),
            _known(message, "novelty"),
            _method(message.method),
            KeypointMatches.of(message),
            FittedEstimate.of(message),
            _known(message, "distance"),
            _known(message, "distance_ratio"),
            tuple(map(Frame.of, message.frames)),
        )


@dataclass(frozen=True, eq=False)
class Relocalization:
    """In which room, and where in it, a camera is. If `ambiguous`, `reason` says why not to rely on it."""

    adapter: Revision | None
    rooms: tuple[RoomMatch, ...]
    room_count: int
    margin: float | None
    ambiguous: bool
    reason: str | None

    @classmethod
    @understood
    def of(cls, message: localization_pb2.RelocalizeResponse) -> Relocalization:
        return cls(
            Revision.of(message.adapter) if message.HasField("adapter") else None,
            tuple(map(RoomMatch.of, message.rooms)),
            message.room_count,
            _known(message, "margin"),
            message.ambiguous,
            message.reason or None,
        )


@dataclass(frozen=True, eq=False)
class Step:
    """One step of a navigation: the frames nearest to what was imagined, the best first."""

    step: int
    frames: tuple[Frame, ...]
    requested_pose: Array | None
    error: PoseError | None
    latent: Latent

    @classmethod
    @understood
    def of(cls, message: navigation_pb2.NavigationStep) -> Step:
        return cls(
            message.step,
            tuple(map(Frame.of, message.frames)),
            pose_matrix(message.requested_pose) if message.HasField("requested_pose") else None,
            PoseError.of(message, "error"),
            Latent(np.array(message.latent.values)),
        )


@dataclass(frozen=True, eq=False)
class Navigation:
    """Where a motion leads, step by step. `displacement` is the whole motion (6,), each of `steps` a part of it."""

    room: Revision
    adapter: Revision
    mode: str
    reading: str
    navigator: str
    exact: bool
    _message: navigation_pb2.NavigateResponse = field(repr=False)

    # Of a batch, most callers look at the last frame of each answer: what they do not look at is not made.

    @cached_property
    def steps(self) -> tuple[Step, ...]:
        return tuple(map(Step.of, self._message.steps))

    @cached_property
    def displacement(self) -> Array:
        return twist_vector(self._message.displacement)

    @cached_property
    def frame(self) -> Frame:
        """The frame at which the navigation ends."""
        return Frame.of(self._message.steps[-1].frames[0])

    @classmethod
    @understood
    def of(cls, message: navigation_pb2.NavigateResponse) -> Navigation:
        return cls(
            Revision.of(message.room),
            Revision.of(message.adapter),
            _word(navigation_pb2.Mode, message.mode, "MODE_"),
            _word(navigation_pb2.Reading, message.reading, "READING_"),
            message.navigator,
            message.exact,
            message,
        )


def batch_of(message: navigation_pb2.BatchNavigateResponse) -> list[Navigation | errors.RefusedError]:
    """The answers of a batch in its order; a request that failed has its exception in its place."""
    return [
        Navigation.of(result.response)
        if result.HasField("response")
        else errors.refused_part(result.failure.code, result.failure.message)
        for result in message.results
    ]


@dataclass(frozen=True, eq=False)
class WayStep:
    """One hop of a way to a goal. The one of number 0 stands for the start, whose believed pose it has."""

    step: int
    frame: Frame | None
    motion: Array
    distance_remaining_m: float
    rotation_remaining_rad: float
    recoveries: int
    start_pose: Array | None
    start_covariance: Array | None
    out_of_distribution: float | None

    @classmethod
    @understood
    def of(cls, message: navigation_pb2.NavigateToFeedback) -> WayStep:
        start = message.start if message.HasField("start") else None
        return cls(
            message.current_step,
            Frame.of(message.current) if message.HasField("current") else None,
            twist_vector(message.motion),
            message.distance_remaining_m,
            message.rotation_remaining_rad,
            message.number_of_recoveries,
            pose_matrix(start.pose) if start else None,
            covariance_matrix(start.pose_covariance) if start else None,
            _known(start, "out_of_distribution") if start else None,
        )


@dataclass(frozen=True, eq=False)
class Way:
    """A way to a goal. `outcome` is "reached", "stuck", "steps_spent", "start_unknown" or "goal_not_mapped"."""

    room: Revision
    adapter: Revision
    steps: tuple[WayStep, ...]
    outcome: str
    message: str
    needed_step: float | None
    arrival_probability: float | None

    @classmethod
    @understood
    def of(cls, steps: Iterable[WayStep], message: navigation_pb2.NavigateToResult) -> Way:
        return cls(
            Revision.of(message.room),
            Revision.of(message.adapter),
            tuple(steps),
            _word(navigation_pb2.NavigateToOutcome, message.outcome, "NAVIGATE_TO_OUTCOME_"),
            message.message,
            _known(message, "needed_step"),
            _known(message, "arrival_probability"),
        )


@dataclass(frozen=True, eq=False)
class Motion:
    """The motion (6,) from one view to another.

    `reader` is "adapter", "two_view" (matched keypoints), or "none": the views have too little in common.
    """

    twist: Array
    covariance: Array | None
    true_motion: Array | None
    error: PoseError | None
    reader: str
    adapter: Revision | None

    @classmethod
    @understood
    def of(cls, message: odometry_pb2.EstimateMotionResponse) -> Motion:
        if not message.HasField("motion"):
            raise ValueError("it has no motion")
        return cls(
            twist_vector(message.motion),
            covariance_matrix(message.covariance),
            twist_vector(message.true_motion) if message.HasField("true_motion") else None,
            PoseError.of(message, "error"),
            _word(odometry_pb2.MotionReader, message.reader, "MOTION_READER_"),
            _revision(message, "adapter"),
        )


@dataclass(frozen=True, eq=False)
class Encoding:
    """The latents (n, k) of views, and their features (n, d) if they were asked for."""

    adapter: Revision
    latents: Array
    features: tuple[Feature | None, ...] | None

    @classmethod
    @understood
    def of(cls, message: odometry_pb2.EncodeResponse, with_features: bool) -> Encoding:
        latents = np.array([view.latent.values for view in message.views])
        if not with_features:
            return cls(Revision.of(message.adapter), latents, None)
        features = tuple(
            Feature(np.array(view.feature.values, dtype=np.float32), view.feature.source_name)
            if view.HasField("feature")
            else None
            for view in message.views
        )
        return cls(Revision.of(message.adapter), latents, features)


@dataclass(frozen=True)
class TrackStart:
    """What a tracking stream was opened with, the server's choices included.

    - `adapter`: None if the stream tracks by matched keypoints alone.
    - `room`: None if it is not known yet, and the camera has to be found.
    - `keyframe_displacement`, `keyframe_frames`: a new keyframe is taken after a motion of this norm, metres and
      radians mixed, and after the time of so many frames.
    - `calibration_rooms`: in how many rooms the covariances were calibrated.
    - `has_visual_odometry`: whether the motion between images is measured; not of features and latents.
    """

    adapter: Revision | None
    room: Revision | None
    keyframe_displacement: float | None
    keyframe_frames: int | None
    calibration_rooms: int
    has_visual_odometry: bool

    @classmethod
    @understood
    def of(cls, message: odometry_pb2.TrackStarted) -> TrackStart:
        return cls(
            _revision(message, "adapter"),
            _revision(message, "room"),
            _known(message.keyframes, "displacement"),
            _known(message.keyframes, "frames"),
            message.calibration_rooms,
            message.has_visual_odometry,
        )


@dataclass(frozen=True, eq=False)
class Candidate:
    """A room that a camera which is lost may be in: so many of the frames that are needed agree on it."""

    room: Revision
    map_from_camera: Array
    sequence: int
    agreed: int
    needed: int


@dataclass(frozen=True, eq=False)
class TrackUpdate:
    """Where a tracked camera is. `status` is "tracking", "degraded", "lost" or "relocalizing"; only while it is
    "tracking" should a robot rely on `map_from_camera`. Velocities are (6,) in m/s and rad/s, in the body frame.
    `contradicted` are the sensors that contradict the others or the pose: "odometry", "images", "inertial", "gravity"
    or "views"."""

    timestamp_ns: int
    sequence: int
    status: str
    reason: str | None
    room: Revision | None
    map_from_camera: Array | None
    map_from_camera_covariance: Array | None
    map_from_odom: Array | None
    odom_from_camera: Array | None
    odom_from_camera_covariance: Array | None
    map_from_base: Array | None
    map_from_base_covariance: Array | None
    odom_from_base: Array | None
    motion: Array
    motion_covariance: Array | None
    body_velocity: Array | None
    base_velocity: Array | None
    keyframe_sequence: int
    is_keyframe: bool
    out_of_distribution: float
    best_match: Frame | None
    best_camera: str | None
    match_used: bool
    match_surprise: float | None
    candidate: Candidate | None
    contradicted: tuple[str, ...]
    elapsed_ns: int

    @classmethod
    @understood
    def of(cls, message: odometry_pb2.TrackUpdate) -> TrackUpdate:
        def pose(field: str) -> Array | None:
            return pose_matrix(getattr(message, field)) if message.HasField(field) else None

        def twist(field: str) -> Array | None:
            return twist_vector(getattr(message, field)) if message.HasField(field) else None

        return cls(
            timestamp_ns=message.timestamp_ns,
            sequence=message.sequence,
            status=_word(odometry_pb2.TrackStatus, message.status, "TRACK_STATUS_"),
            reason=message.reason or None,
            room=_revision(message, "room"),
            map_from_camera=pose("map_from_camera"),
            map_from_camera_covariance=covariance_matrix(message.map_from_camera_covariance),
            map_from_odom=pose("map_from_odom"),
            odom_from_camera=pose("odom_from_camera"),
            odom_from_camera_covariance=covariance_matrix(message.odom_from_camera_covariance),
            map_from_base=pose("map_from_base"),
            map_from_base_covariance=covariance_matrix(message.map_from_base_covariance),
            odom_from_base=pose("odom_from_base"),
            motion=twist_vector(message.motion),
            motion_covariance=covariance_matrix(message.motion_covariance),
            body_velocity=twist("body_velocity"),
            base_velocity=twist("base_velocity"),
            keyframe_sequence=message.keyframe_sequence,
            is_keyframe=message.is_keyframe,
            out_of_distribution=message.out_of_distribution,
            best_match=Frame.of(message.best_match) if message.HasField("best_match") else None,
            best_camera=message.best_camera or None,
            match_used=message.match_used,
            match_surprise=_known(message, "match_surprise"),
            candidate=_candidate(message.candidate) if message.HasField("candidate") else None,
            contradicted=tuple(
                _word(odometry_pb2.TrackSensor, sensor, "TRACK_SENSOR_") for sensor in message.contradicted
            ),
            elapsed_ns=message.elapsed_ns,
        )


def _candidate(message: odometry_pb2.PlaceCandidate) -> Candidate:
    return Candidate(
        Revision.of(message.room),
        pose_matrix(message.map_from_camera),
        message.sequence,
        message.agreed,
        message.needed,
    )


@dataclass(frozen=True)
class TrackRefusal:
    """A frame that a tracking stream could not use; the stream goes on. `reason` is "late", "duplicate",
    "superseded", "view", "pose", "odometry", "gravity" or "inertial"."""

    timestamp_ns: int
    sequence: int
    reason: str
    message: str
    frames: int

    @classmethod
    @understood
    def of(cls, message: odometry_pb2.TrackRefusal) -> TrackRefusal:
        reason = _word(odometry_pb2.TrackRefusalReason, message.reason, "TRACK_REFUSAL_REASON_")
        return cls(message.timestamp_ns, message.sequence, reason, message.message, message.frames)


@dataclass(frozen=True)
class Rate:
    """A share of the cases with its 95 % interval."""

    rate: float
    low: float
    high: float

    @classmethod
    @understood
    def of(cls, message: evaluation_pb2.Rate) -> Rate:
        return cls(message.rate, message.low, message.high)


@dataclass(frozen=True, eq=False)
class NavigatorScores:
    """The scores of one navigator over `n` questions. `hits` is Hit@ε by ε."""

    name: str
    n: int
    mse: float | None
    r2: float | None
    top1: Rate
    hits: dict[float, Rate]
    translation_m_median: float
    rotation_rad_median: float
    recalls: dict[tuple[float, float], Rate]

    @classmethod
    @understood
    def of(cls, message: evaluation_pb2.NavigatorScores) -> NavigatorScores:
        return cls(
            message.name,
            message.n,
            _known(message, "mse"),
            _known(message, "r2"),
            Rate.of(message.top1),
            {hit.threshold: Rate.of(hit.rate) for hit in message.hit_rates},
            message.translation_m_median,
            message.rotation_rad_median,
            {(recall.translation_m, recall.rotation_deg): Rate.of(recall.rate) for recall in message.recalls},
        )


@dataclass(frozen=True, eq=False)
class Evaluation:
    """Scores of navigators on a room's held-out pairs. If it `leaks`, the adapter has seen frames of these pairs."""

    room: Revision
    adapter: Revision
    split: str
    stride: int
    n: int
    candidate_count: int
    source_excluded: bool
    in_room: bool
    leaks: bool
    calibrated_here: bool
    steps: int
    mode: str
    navigators: tuple[NavigatorScores, ...]

    @classmethod
    @understood
    def of(cls, message: evaluation_pb2.EvaluationReport) -> Evaluation:
        return cls(
            Revision.of(message.room),
            Revision.of(message.adapter),
            message.split,
            message.stride,
            message.n,
            message.candidate_count,
            message.source_excluded,
            message.in_room,
            message.leaks,
            message.calibrated_here,
            message.steps,
            _word(navigation_pb2.Mode, message.mode, "MODE_"),
            tuple(map(NavigatorScores.of, message.navigators)),
        )

    def table(self) -> pandas.DataFrame:
        """A row for each navigator: its scores, and Hit@ε with the ends of its 95 % interval. Needs pandas.

        `n` questions; `r2` of predicted latents, not of motions; `median_m` and `median_deg` from the frame that was
        retrieved to the one that was meant.
        """
        try:
            import pandas
        except ImportError as error:
            raise ImportError('table() needs pandas: pip install "seese3[pandas]"') from error

        rows = []
        for scores in self.navigators:
            row: dict[str, Any] = {"navigator": scores.name, "n": scores.n, "r2": scores.r2}
            for epsilon, hit in scores.hits.items():
                row |= {
                    f"hit@{epsilon:g}": hit.rate,
                    f"hit@{epsilon:g} low": hit.low,
                    f"hit@{epsilon:g} high": hit.high,
                }
            row |= {"median_m": scores.translation_m_median, "median_deg": np.degrees(scores.rotation_rad_median)}
            rows.append(row)
        return pandas.DataFrame(rows).set_index("navigator")

    def plot(self, axes: Any = None) -> Any:
        """Draws Hit@ε over ε with 95 % intervals, a line for each navigator, and returns the axes. Needs matplotlib."""
        try:
            from matplotlib import pyplot
        except ImportError as error:
            raise ImportError('plot() needs matplotlib: pip install "seese3[plots]"') from error

        axes = axes if axes is not None else pyplot.subplots(figsize=(9, 4.5), layout="constrained")[1]
        for number, scores in enumerate(self.navigators):
            thresholds = list(scores.hits)
            # There are ten colours: the next ten lines are dashed, so that no two are alike.
            colour, dashes = f"C{number % 10}", ("-", "--", ":")[number // 10 % 3]
            rates = [hit.rate for hit in scores.hits.values()]
            axes.plot(thresholds, rates, dashes, color=colour, marker=".", label=scores.name)
            axes.fill_between(
                thresholds,
                [hit.low for hit in scores.hits.values()],
                [hit.high for hit in scores.hits.values()],
                color=colour,
                alpha=0.08,
            )
        axes.set(
            xlabel="ε: metres and radians mixed",
            ylabel="Hit@ε",
            ylim=(0, 1.02),
            title=f"{self.room.name}: {self.n} motions over {self.stride} frames, {self.split} split"
            + (" (LEAKS)" if self.leaks else ""),
        )
        axes.legend(fontsize="small", loc="center left", bbox_to_anchor=(1.0, 0.5))
        return axes
