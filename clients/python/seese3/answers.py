"""What a server answers, as dataclasses of NumPy arrays.

What a server left out is None here, and never 0: an absent R² is no R² of 0. Shapes and units are those of `geometry`;
covariances of motions are on (v, ω), in the body frame of the first camera. Times are whole nanoseconds. Pictures and
tables need the extras `seese3[plots]` and `seese3[pandas]`.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from datetime import datetime, timezone
from functools import cached_property
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
import numpy.typing as npt

from . import errors
from .errors import understood
from .geometry import Array, covariance_matrix, pose_matrix, twist_vector, vector
from .v1 import catalog_pb2, evaluation_pb2, geometry_pb2, localization_pb2, navigation_pb2, odometry_pb2
from .views import Feature, Latent, Revision
from .words import DistortionModel, FinalNorm, LayerIndexBase, enum_word

if TYPE_CHECKING:
    import pandas


_Answer = TypeVar("_Answer")


def _known(message: Any, field: str) -> Any:
    """An optional number, or None if it is absent."""
    return getattr(message, field) if message.HasField(field) else None


def _word_or_none(enum: Any, value: int, prefix: str) -> Any:
    return enum_word(enum, value, prefix) if value else None


def _revision(message: Any, field: str) -> Revision | None:
    return Revision.of(getattr(message, field)) if message.HasField(field) else None


@dataclass(frozen=True, eq=False)
class PoseError:
    """The error of an answer against a recorded pose.

    Attributes:
        translation_m: The distance between the camera centers, meters.
        rotation_rad: The angle between the orientations, radians.
        twist_norm: The norm of the difference of the two motions from the source, meters and radians mixed. Hit@ε
            counts the errors below ε.
    """

    translation_m: float
    rotation_rad: float
    twist_norm: float

    @classmethod
    @understood
    def of(cls, message: Any, field: str) -> PoseError | None:
        if not message.HasField(field):
            return None
        error = getattr(message, field)
        return cls(error.translation_m, error.rotation_rad, error.twist_norm)


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
    layer_index_base: LayerIndexBase | None = None
    final_norm: FinalNorm | None = None

    @classmethod
    @understood
    def of(cls, message: catalog_pb2.FeatureSource) -> FeatureSource:
        return cls(
            name=message.name,
            dim=message.dim,
            encoder=message.encoder,
            layer=message.layer,
            pooling=message.pooling,
            preprocess=message.preprocess,
            layer_index_base=_word_or_none(catalog_pb2.LayerIndexBase, message.layer_index_base, "LAYER_INDEX_BASE_"),
            final_norm=_word_or_none(catalog_pb2.FinalNorm, message.final_norm, "FINAL_NORM_"),
        )


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
    distortion_model: DistortionModel | None = None
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
        return cls(
            message.width,
            message.height,
            message.fx,
            message.fy or None,
            _known(message, "cx"),
            _known(message, "cy"),
            _word_or_none(geometry_pb2.DistortionModel, message.distortion_model, "DISTORTION_MODEL_"),
            message.distortion,
        )


@dataclass(frozen=True)
class ExpectedError:
    """The error to expect of views up to a distance from the map.

    Attributes:
        feature_distance: The largest distance of a view's feature from the nearest feature of the room, in standard
            deviations of a feature column.
        translation_m: The root mean square of the position error, meters.
        rotation_rad: The root mean square of the rotation error, radians.
    """

    feature_distance: float
    translation_m: float
    rotation_rad: float


@dataclass(frozen=True, eq=False)
class Room:
    """A room that is served.

    Attributes:
        name: The name.
        revision: The number of the revision, counted from 1.
        frame_count: The number of frames.
        adapters: The adapters that fit the features, the default first.
        feature_sources: The sources of the features, one for each feature set.
        format: The dataset format that the room was imported from.
        license: The terms under which the recording may be used; empty if not stated.
        worst_rotation_error: The largest entry of |RRᵀ − I| over the rotations as they were recorded.
        created: When the revision was published.
        camera: The camera of all images, in units of the image width; None if it is unknown.
        extent: The smallest and the largest coordinates of the camera positions, (2, 3), meters; None if unknown.
        duration_s: The duration of the recording, seconds; None without timestamps.
        frame_rate_hz: The median frame rate, hertz; None without timestamps.
        has_keypoints: Whether the room has keypoints, which are matched with those of images.
        expected_errors: The errors of localization by the adapter that is fitted to the room, the nearest views
            first, from cross-validation within the recording. Another recording is less accurate.
    """

    name: str
    revision: int
    frame_count: int
    adapters: tuple[str, ...]
    feature_sources: tuple[FeatureSource, ...]
    format: str
    license: str
    worst_rotation_error: float
    created: datetime
    camera: Camera | None
    extent: Array | None
    duration_s: float | None
    frame_rate_hz: float | None
    has_keypoints: bool
    expected_errors: tuple[ExpectedError, ...]

    @classmethod
    @understood
    def of(cls, message: catalog_pb2.Room) -> Room:
        if not message.name:
            raise ValueError("it has no name")
        return cls(
            message.name,
            message.revision,
            message.frame_count,
            tuple(message.adapters),
            tuple(map(FeatureSource.of, message.feature_sources)),
            message.format,
            message.license,
            message.worst_rotation_error,
            message.create_time.ToDatetime(timezone.utc),
            Camera.of(message.camera) if message.HasField("camera") else None,
            np.array([vector(message.extent.min), vector(message.extent.max)]) if message.HasField("extent") else None,
            _known(message, "duration_s"),
            _known(message, "frame_rate_hz"),
            message.has_keypoints,
            tuple(
                ExpectedError(one.feature_distance, one.translation_m, one.rotation_rad)
                for one in message.expected_errors
            ),
        )


@dataclass(frozen=True)
class MotionScores:
    """R² of predicted motions; None where the true motions do not vary, or nothing was held out.

    Attributes:
        pair_count: The number of pairs scored.
        overall: The mean R² of the six components of (v, ω).
        translation: The mean R² of the three components of v.
        rotation: The mean R² of the three components of ω.
        direction: The mean R² of the three components of v/|v|, over pairs with |v| > 1 mm.
        magnitude: R² of |v|.
        still_components: The number of components that do not vary in the pairs; they have no R².
    """

    pair_count: int
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
            pair_count=message.pair_count,
            overall=_known(message, "overall"),
            translation=_known(message, "translation"),
            rotation=_known(message, "rotation"),
            direction=_known(message, "direction"),
            magnitude=_known(message, "magnitude"),
            still_components=message.still_components,
        )


@dataclass(frozen=True, eq=False)
class Adapter:
    """A trained adapter that is served.

    Attributes:
        name: The name.
        revision: The number of the revision, counted from 1.
        feature_source: The source of the features that it was trained on.
        latent_dim: The number of columns of a latent.
        charts: The number of charts.
        training_rooms: The rooms that it was trained in.
        calibration_rooms: The rooms in which its errors were measured.
        preset: The preset that its training settings are based on.
        split: How the test pairs were held out from training.
        stride: The number of frames from the source to the target of a test pair.
        loss: The training loss: "mse", "cosine" or "rotation".
        mixing: How charts are mixed: "gate" or "even".
        seed: The seed of the training run.
        test: R² on the test pairs.
        train: R² on the training pairs.
        train_mean_r2: R² on the test pairs of a constant prediction, the mean of the training motions; None if the
            test motions do not vary.
        target_mean: The mean of the training motions, (6,).
        target_deviation: Their population standard deviation per component, (6,).
        singular_values: The singular values of W, the largest first.
        navigators: The names that `navigate(navigator=…)` accepts.
        created: When the revision was published.
    """

    name: str
    revision: int
    feature_source: FeatureSource
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

    @classmethod
    @understood
    def of(cls, message: catalog_pb2.Adapter) -> Adapter:
        if not message.name:
            raise ValueError("it has no name")
        return cls(
            name=message.name,
            revision=message.revision,
            feature_source=FeatureSource.of(message.feature_source),
            latent_dim=message.latent_dim,
            charts=message.charts,
            training_rooms=tuple(map(Revision.of, message.training_rooms)),
            calibration_rooms=tuple(map(Revision.of, message.calibration_rooms)),
            preset=message.preset,
            split=enum_word(geometry_pb2.Split, message.split, "SPLIT_"),
            stride=message.stride,
            loss=enum_word(catalog_pb2.TrainingLoss, message.loss, "TRAINING_LOSS_"),
            mixing=enum_word(catalog_pb2.ChartMixing, message.mixing, "CHART_MIXING_"),
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
    """The frames of a room, a row each. `neighbors` are (row, motion) of the frames near each one, the nearest first;
    `thumbnails` are JPEG files. What was not asked for, or is not known, is None."""

    room: Revision
    poses: Array
    names: tuple[str, ...] | None
    timestamps_ns: npt.NDArray[np.int64] | None
    segments: npt.NDArray[np.int64]
    neighbors: tuple[tuple[tuple[int, Array], ...], ...] | None
    thumbnails: tuple[bytes, ...] | None

    def __len__(self) -> int:
        return len(self.poses)

    @classmethod
    @understood
    def of(
        cls,
        room: geometry_pb2.Revision,
        frames: Sequence[catalog_pb2.RoomFrame],
        with_neighbors: bool,
        with_thumbnails: bool,
    ) -> RoomFrames:
        times = [frame.timestamp_ns for frame in frames if frame.HasField("timestamp_ns")]
        names = tuple(frame.frame_name for frame in frames)
        return cls(
            room=Revision.of(room),
            poses=np.array([pose_matrix(frame.pose) for frame in frames]).reshape(-1, 4, 4),
            names=names if any(names) else None,
            timestamps_ns=np.array(times, dtype=np.int64) if times and len(times) == len(frames) else None,
            segments=np.array([frame.segment for frame in frames], dtype=np.int64),
            neighbors=tuple(
                tuple((near.frame_id, twist_vector(near.motion)) for near in frame.neighbors) for frame in frames
            )
            if with_neighbors
            else None,
            thumbnails=tuple(frame.thumbnail for frame in frames) if with_thumbnails else None,
        )


@dataclass(frozen=True, eq=False)
class DownloadedRoom:
    """The frames and features of a room.

    Attributes:
        room: The room.
        poses: The camera poses world_from_camera, (n, 4, 4).
        features: The features by the name of their set, each (n, d).
        sources: The sources of the features, by the same names.
        timestamps_ns: The times of the frames, (n,), nanoseconds; None if unknown.
        names: The recording's own names for the frames; None if it has none.
        segments: The uninterrupted segment of each frame, (n,); None if there is only one.
        camera: The camera of all images, in units of the image width; None if it is unknown.
        format: The dataset format that the room was imported from.
        license: The terms under which the recording may be used; empty if not stated.
    """

    room: Revision
    poses: Array
    features: dict[str, npt.NDArray[np.float32]]
    sources: dict[str, FeatureSource]
    timestamps_ns: npt.NDArray[np.int64] | None
    names: tuple[str, ...] | None
    segments: npt.NDArray[np.int64] | None
    camera: Camera | None
    format: str
    license: str

    @classmethod
    @understood
    def of(cls, messages: Sequence[catalog_pb2.DownloadRoomResponse]) -> DownloadedRoom:
        if len(messages) < 2 or not messages[0].HasField("room") or not messages[-1].HasField("end"):
            raise ValueError("it is not complete")
        upload, end = messages[0].room.upload, messages[-1].end
        batches = [message.frames for message in messages if message.HasField("frames")]
        digest = hashlib.sha256()
        for batch in batches:
            for content in (batch.poses, *batch.features):
                digest.update(content)
        for message in messages:
            digest.update(message.keypoints)
        if digest.digest() != end.sha256:
            raise ValueError("its checksum is wrong")

        sources = [FeatureSource.of(source) for source in upload.feature_sources]
        poses = np.frombuffer(b"".join(batch.poses for batch in batches), "<f8").reshape(-1, 4, 4)
        rows = [b"".join(batch.features[number] for batch in batches) for number in range(len(sources))]
        times = [time for batch in batches for time in batch.timestamps_ns]
        names = tuple(name for batch in batches for name in batch.frame_names)
        segments = [number for batch in batches for number in batch.segments]
        return cls(
            room=Revision.of(messages[0].room.revision),
            poses=poses,
            features={
                source.name: np.frombuffer(values, "<f4").reshape(-1, source.dim)
                for source, values in zip(sources, rows, strict=True)
            },
            sources={source.name: source for source in sources},
            timestamps_ns=np.array(times, dtype=np.int64) if times else None,
            names=names or None,
            segments=np.array(segments, dtype=np.int64) if segments else None,
            camera=Camera.of(upload.camera) if upload.HasField("camera") else None,
            format=upload.format,
            license=upload.license,
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
class ServerEncoder:
    """An encoder of a server.

    Attributes:
        encoder: The identity of the encoder, as in `FeatureSource.encoder`.
        adapters: The adapters for whose features it converts images.
        detects_keypoints: Whether it detects keypoints.
    """

    encoder: str
    adapters: tuple[str, ...]
    detects_keypoints: bool


@dataclass(frozen=True)
class ServerInfo:
    """The version, the abilities and the limits of a server.

    Attributes:
        version: The version of the program.
        encoders: The encoders with which it converts images.
        writable: Whether the caller may change the catalog.
        encodes_images: Whether it converts images to features of at least one adapter.
        matches_keypoints: Whether it matches the keypoints of images.
        shows_thumbnails: Whether `frames` can return thumbnails.
        limits: The limits of requests, by name: "top_k", "steps", "batch", "predictions", "message_bytes",
            "duration_s", "image_pixels", "request_pixels", "answer_frames", "upload_bytes" and "streams".
    """

    version: str
    encoders: tuple[ServerEncoder, ...]
    writable: bool
    encodes_images: bool
    matches_keypoints: bool
    shows_thumbnails: bool
    limits: dict[str, float]

    @classmethod
    @understood
    def of(cls, message: catalog_pb2.ServerInfo) -> ServerInfo:
        encoders = [ServerEncoder(one.encoder, tuple(one.adapters), one.detects_keypoints) for one in message.encoders]
        limits = {field.name: getattr(message.limits, field.name) for field in message.limits.DESCRIPTOR.fields}
        return cls(
            message.version,
            tuple(encoders),
            message.writable,
            message.encodes_images,
            message.matches_keypoints,
            message.shows_thumbnails,
            limits,
        )


@dataclass(frozen=True)
class CatalogDefault:
    """A default of a server's catalog. Exactly one of the pairs is set.

    Attributes:
        room: The room of a default adapter or a default revision.
        adapter: The default adapter of `room`, or the adapter of a default revision.
        revision: The default revision of `room` or `adapter`; None for a default adapter.
    """

    room: str | None = None
    adapter: str | None = None
    revision: int | None = None

    @classmethod
    @understood
    def of(cls, message: catalog_pb2.CatalogDefault) -> CatalogDefault:
        kind = message.WhichOneof("default")
        if kind == "room_adapter":
            return cls(room=message.room_adapter.room, adapter=message.room_adapter.adapter)
        if kind == "room_revision":
            return cls(room=message.room_revision.name, revision=message.room_revision.revision)
        if kind == "adapter_revision":
            return cls(adapter=message.adapter_revision.name, revision=message.adapter_revision.revision)
        raise ValueError("it names nothing that this package knows")


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
    """Details of a pose by the adapter that is fitted to the room: the nearest frame, the gains of the motion
    from it to the view, and the fitted adapter with its revision."""

    frame_id: int
    distance: float
    translation_estimator: str
    translation_gain: float
    rotation_estimator: str
    rotation_gain: float
    adapter: Revision | None

    @classmethod
    @understood
    def of(cls, message: Any) -> FittedEstimate | None:
        if not message.HasField("fitted"):
            return None
        fitted = message.fitted
        enum, prefix = localization_pb2.RelativeEstimator, "RELATIVE_ESTIMATOR_"
        return cls(
            fitted.frame_id,
            fitted.distance,
            enum_word(enum, fitted.translation_estimator, prefix),
            fitted.translation_gain,
            enum_word(enum, fitted.rotation_estimator, prefix),
            fitted.rotation_gain,
            _revision(fitted, "adapter"),
        )


@dataclass(frozen=True, eq=False)
class SimilarFrame:
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
    or "recorded"; None without a pose. `frames` are the stored frames most similar to the view, the best first;
    `exact` is False if an approximate index found them, and `index` is its name: "exact" or "hnsw".
    """

    pose: Array | None
    covariance: Array | None
    room: Revision
    novelty: float | None
    method: str | None
    reason: str | None
    matches: KeypointMatches | None
    fitted: FittedEstimate | None
    frames: tuple[SimilarFrame, ...]
    adapter: Revision | None
    room_count: int
    exact: bool
    index: str | None

    @classmethod
    @understood
    def of(cls, message: localization_pb2.LocalizeResponse) -> Localization:
        frames = tuple(
            SimilarFrame(Revision.of(similar.room), Frame.of(similar.frame), PoseError.of(similar, "error"))
            for similar in message.frames
        )
        return cls(
            *_pose_with_covariance(message),
            Revision.of(message.room),
            _known(message, "novelty"),
            _method(message.method),
            message.reason or None,
            KeypointMatches.of(message),
            FittedEstimate.of(message),
            frames,
            Revision.of(message.adapter) if message.HasField("adapter") else None,
            message.room_count,
            message.exact,
            message.index or None,
        )


def _pose_with_covariance(message: Any) -> tuple[Array | None, Array | None]:
    if not message.HasField("pose"):
        return None, None
    return pose_matrix(message.pose.pose), covariance_matrix(message.pose.covariance)


def _method(value: int) -> str | None:
    if value == localization_pb2.LOCALIZATION_METHOD_UNSPECIFIED:
        return None
    return enum_word(localization_pb2.LocalizationMethod, value, "LOCALIZATION_METHOD_")


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


def _latent(message: geometry_pb2.Latent) -> Latent:
    return Latent(np.array(message.values), _revision(message, "adapter"))


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
            _latent(message.latent),
        )


@dataclass(frozen=True, eq=False)
class Navigation:
    """Where a motion leads, step by step. `motion` is the whole motion (6,), each of `steps` a part of it."""

    room: Revision
    adapter: Revision
    step_mode: str
    inverse_variant: str | None
    navigator: str
    exact: bool
    index: str
    _message: navigation_pb2.NavigateResponse = field(repr=False)

    # Of a batch, most callers look at the last frame of each answer: what they do not look at is not made.

    @cached_property
    def steps(self) -> tuple[Step, ...]:
        return tuple(map(Step.of, self._message.steps))

    @cached_property
    def motion(self) -> Array:
        return twist_vector(self._message.motion)

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
            enum_word(navigation_pb2.StepMode, message.step_mode, "STEP_MODE_"),
            _word_or_none(navigation_pb2.InverseVariant, message.inverse_variant, "INVERSE_VARIANT_"),
            message.navigator,
            message.exact,
            message.index,
            message,
        )


def batch_of(
    answer: type[_Answer],
    message: navigation_pb2.BatchNavigateResponse | localization_pb2.BatchLocalizeResponse,
) -> list[_Answer | errors.RefusedError]:
    """The answers of a batch in its order; a request that failed has its exception in its place."""
    return [
        answer.of(result.response) if result.HasField("response") else errors.refused_part(result.error)  # type: ignore[attr-defined]
        for result in message.results
    ]


@dataclass(frozen=True, eq=False)
class RouteStart:
    """The start of a route.

    Attributes:
        pose: The camera pose of the source, world_from_camera (4, 4).
        covariance: Its covariance (6, 6) in ROS order; None for a stored frame, for a given pose, and if the errors
            of the method were not measured.
        novelty: How unlike the source is to the room: above 1 it looks like another place. None if it is unknown.
        distance_remaining_m: The distance to the goal, meters.
        rotation_remaining_rad: The rotation to the goal, radians.
    """

    pose: Array
    covariance: Array | None
    novelty: float | None
    distance_remaining_m: float
    rotation_remaining_rad: float


@dataclass(frozen=True, eq=False)
class RouteHop:
    """One hop of a route.

    Attributes:
        motion: The motion to drive (6,), in the body frame of the camera before the hop.
        frame: The stored frame at the end of the hop.
        distance_remaining_m: The distance from there to the goal, meters.
        rotation_remaining_rad: The rotation from there to the goal, radians.
        recoveries: The number of recoveries so far; 0 except with the planner "latent".
    """

    motion: Array
    frame: Frame
    distance_remaining_m: float
    rotation_remaining_rad: float
    recoveries: int

    @classmethod
    @understood
    def of(cls, message: navigation_pb2.RouteHop) -> RouteHop:
        return cls(
            twist_vector(message.motion),
            Frame.of(message.frame),
            message.distance_remaining_m,
            message.rotation_remaining_rad,
            message.recoveries,
        )


@dataclass(frozen=True, eq=False)
class Route:
    """A route over stored frames to a goal.

    Attributes:
        outcome: "found", "start_unknown", "goal_not_mapped" or "no_route".
        message: The outcome in a few words.
        start: The start of the route.
        hops: The hops, in order; empty unless `outcome` is "found".
        needed_hop_length: The maximum hop length that a route needs; None if it is at most the one asked for.
        arrival_probability: The probability that a camera which drives the route without looking again ends within
            the tolerances; None if the start has no covariance.
        room: The room of the route.
        adapter: The adapter that was used.
        planning_time_s: The time that planning took, seconds.
    """

    outcome: str
    message: str
    start: RouteStart
    hops: tuple[RouteHop, ...]
    needed_hop_length: float | None
    arrival_probability: float | None
    room: Revision
    adapter: Revision
    planning_time_s: float

    @classmethod
    @understood
    def of(cls, message: navigation_pb2.Route) -> Route:
        start = message.start
        return cls(
            enum_word(navigation_pb2.RouteOutcome, message.outcome, "ROUTE_OUTCOME_"),
            message.message,
            RouteStart(
                pose_matrix(start.pose.pose),
                covariance_matrix(start.pose.covariance),
                _known(start, "novelty"),
                start.distance_remaining_m,
                start.rotation_remaining_rad,
            ),
            tuple(map(RouteHop.of, message.hops)),
            _known(message, "needed_hop_length"),
            _known(message, "arrival_probability"),
            Revision.of(message.room),
            Revision.of(message.adapter),
            message.planning_time_ns / 1e9,
        )


@dataclass(frozen=True, eq=False)
class Motion:
    """The motion (6,) from one view to another.

    `covariance` (6, 6) is that of the six numbers; None if an adapter estimated the motion from latents, or is not
    calibrated. `estimator` is "adapter", "two_view" (matched keypoints), "relational" (the relational reader of the
    adapter), or "none": the views have too little in common.
    """

    twist: Array
    covariance: Array | None
    true_motion: Array | None
    error: PoseError | None
    estimator: str
    adapter: Revision | None

    @classmethod
    @understood
    def of(cls, message: odometry_pb2.EstimateMotionResponse) -> Motion:
        if not message.HasField("motion"):
            raise ValueError("it has no motion")
        return cls(
            twist_vector(message.motion.twist),
            covariance_matrix(message.motion.covariance),
            twist_vector(message.true_motion) if message.HasField("true_motion") else None,
            PoseError.of(message, "error"),
            enum_word(odometry_pb2.MotionEstimator, message.estimator, "MOTION_ESTIMATOR_"),
            _revision(message, "adapter"),
        )


@dataclass(frozen=True, eq=False)
class Encoding:
    """The latents (n, k) of views, and their features (n, d) if they were asked for."""

    adapter: Revision
    latents: Array
    features: tuple[Feature | None, ...] | None

    def latent(self, row: int) -> Latent:
        """One of the latents as a view, with the name of its adapter."""
        return Latent(self.latents[row], self.adapter)

    @classmethod
    @understood
    def of(cls, message: odometry_pb2.EncodeResponse, with_features: bool) -> Encoding:
        latents = np.array([view.latent.values for view in message.views])
        if not with_features:
            return cls(Revision.of(message.adapter), latents, None)
        features = tuple(
            Feature(np.array(view.feature.values, dtype=np.float32), view.feature.feature_set)
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
    - `keyframe_motion_norm`: a new keyframe is taken after a motion of this norm, meters and radians mixed; None if
      only the interval counts.
    - `keyframe_interval`: the interval of keyframes in sequence numbers.
    - `calibration_rooms`: in how many rooms the covariances were calibrated.
    - `has_visual_odometry`: whether the motion between images is measured; not of features and latents.
    """

    adapter: Revision | None
    room: Revision | None
    keyframe_motion_norm: float | None
    keyframe_interval: int | None
    calibration_rooms: int
    has_visual_odometry: bool

    @classmethod
    @understood
    def of(cls, message: odometry_pb2.TrackStarted) -> TrackStart:
        return cls(
            _revision(message, "adapter"),
            _revision(message, "room"),
            _known(message.keyframes, "motion_norm"),
            _known(message.keyframes, "sequence_interval"),
            message.calibration_rooms,
            message.has_visual_odometry,
        )


@dataclass(frozen=True, eq=False)
class TrackedBody:
    """The poses and the velocity of the camera or of the robot's base. Covariances (6, 6) of poses are in ROS order.

    Attributes:
        odom_pose: The pose in the odometry frame (4, 4): continuous, and drifting.
        odom_covariance: Its covariance.
        map_pose: The pose in the map frame (4, 4); None if it is unknown. Check the status before using it.
        map_covariance: Its covariance; None if the pose is unknown.
        velocity: The velocity (6,) in the body frame, m/s and rad/s; None for the first frame.
        velocity_covariance: Its covariance, on (v, ω).
    """

    odom_pose: Array
    odom_covariance: Array | None
    map_pose: Array | None
    map_covariance: Array | None
    velocity: Array | None
    velocity_covariance: Array | None

    @classmethod
    @understood
    def of(cls, message: odometry_pb2.TrackedBody) -> TrackedBody:
        has_map, has_velocity = message.HasField("map_pose"), message.HasField("velocity")
        return cls(
            pose_matrix(message.odom_pose.pose),
            covariance_matrix(message.odom_pose.covariance),
            pose_matrix(message.map_pose.pose) if has_map else None,
            covariance_matrix(message.map_pose.covariance) if has_map else None,
            twist_vector(message.velocity.twist) if has_velocity else None,
            covariance_matrix(message.velocity.covariance) if has_velocity else None,
        )


@dataclass(frozen=True, eq=False)
class KeyframeMotion:
    """The motion of the camera since the keyframe.

    Attributes:
        motion: The motion (6,) from the keyframe to this frame, in the keyframe's body frame.
        covariance: Its covariance (6, 6), on (v, ω).
        sequence_number: The number of the keyframe.
        is_new: Whether this frame is the keyframe from now on.
    """

    motion: Array
    covariance: Array | None
    sequence_number: int
    is_new: bool


@dataclass(frozen=True, eq=False)
class TrackMatch:
    """The comparison of a frame's views with the room.

    Attributes:
        novelty: How unlike the view is to the room: above 1 it looks like another place. None if it is unknown.
        frame: The most similar stored frame; None if the room is unknown.
        used: Whether the located pose corrected the map pose.
        mahalanobis_squared: The squared Mahalanobis distance between the located and the predicted pose, χ² with six
            degrees of freedom; None without both.
        camera: The other camera of the view; None for the stream's own.
    """

    novelty: float | None
    frame: Frame | None
    used: bool
    mahalanobis_squared: float | None
    camera: str | None


@dataclass(frozen=True, eq=False)
class PoseHypothesis:
    """A map pose that recent matches support and that is not applied yet.

    Attributes:
        room: The room of the hypothesis.
        map_from_camera: The camera pose (4, 4) at the last frame that supported it.
        sequence_number: The number of that frame.
        agreed: The number of successive matches that agree.
        needed: The number of matches that must agree.
    """

    room: Revision
    map_from_camera: Array
    sequence_number: int
    agreed: int
    needed: int


@dataclass(frozen=True, eq=False)
class TrackUpdate:
    """The answer to a frame of a tracked camera.

    Attributes:
        timestamp_ns: The time of the frame, nanoseconds.
        sequence_number: The number of the frame.
        status: "tracking", "degraded", "lost" or "relocalizing"; only while it is "tracking" should a robot rely on
            the map pose.
        reason: The reason for the status; None if there is none.
        contradicted: The sensors that contradict the others or the pose: "odometry", "images", "inertial", "gravity"
            or "views".
        room: The room of the camera; None if it is unknown.
        camera: The poses and the velocity of the camera.
        base: Those of the robot's base; None without `base_from_camera`.
        map_from_odom: The drift correction (4, 4); None if the map pose is unknown.
        keyframe: The motion since the keyframe.
        match: The comparison of the views with the room.
        hypothesis: Another map pose that recent matches support; None if there is none.
        elapsed_ns: The time from the arrival of the frame to its answer, nanoseconds.
    """

    timestamp_ns: int
    sequence_number: int
    status: str
    reason: str | None
    contradicted: tuple[str, ...]
    room: Revision | None
    camera: TrackedBody
    base: TrackedBody | None
    map_from_odom: Array | None
    keyframe: KeyframeMotion
    match: TrackMatch
    hypothesis: PoseHypothesis | None
    elapsed_ns: int

    @classmethod
    @understood
    def of(cls, message: odometry_pb2.TrackUpdate) -> TrackUpdate:
        keyframe, match, hypothesis = message.keyframe, message.match, message.hypothesis
        return cls(
            timestamp_ns=message.timestamp_ns,
            sequence_number=message.sequence_number,
            status=enum_word(odometry_pb2.TrackStatus, message.status, "TRACK_STATUS_"),
            reason=message.reason or None,
            contradicted=tuple(
                enum_word(odometry_pb2.TrackSensor, sensor, "TRACK_SENSOR_") for sensor in message.contradicted
            ),
            room=_revision(message, "room"),
            camera=TrackedBody.of(message.camera),
            base=TrackedBody.of(message.base) if message.HasField("base") else None,
            map_from_odom=pose_matrix(message.map_from_odom) if message.HasField("map_from_odom") else None,
            keyframe=KeyframeMotion(
                twist_vector(keyframe.motion.twist),
                covariance_matrix(keyframe.motion.covariance),
                keyframe.sequence_number,
                keyframe.is_new,
            ),
            match=TrackMatch(
                _known(match, "novelty"),
                Frame.of(match.frame) if match.HasField("frame") else None,
                match.used,
                _known(match, "mahalanobis_squared"),
                match.camera_name or None,
            ),
            hypothesis=PoseHypothesis(
                Revision.of(hypothesis.room),
                pose_matrix(hypothesis.map_from_camera),
                hypothesis.sequence_number,
                hypothesis.agreed,
                hypothesis.needed,
            )
            if message.HasField("hypothesis")
            else None,
            elapsed_ns=message.timing.elapsed_ns,
        )


@dataclass(frozen=True)
class TrackRefusal:
    """A frame that a tracking stream could not use; the stream goes on. `reason` is "late", "duplicate",
    "superseded", "view", "pose", "odometry", "gravity" or "inertial"."""

    timestamp_ns: int
    sequence_number: int
    reason: str
    message: str
    frame_count: int

    @classmethod
    @understood
    def of(cls, message: odometry_pb2.TrackRefusal) -> TrackRefusal:
        reason = enum_word(odometry_pb2.TrackRefusalReason, message.reason, "TRACK_REFUSAL_REASON_")
        return cls(message.timestamp_ns, message.sequence_number, reason, message.message, message.frame_count)


@dataclass(frozen=True)
class Proportion:
    """A share of the cases with its 95 % interval, each 0 to 1.

    Overlapping pairs are correlated, so the interval is computed from the variance between blocks of the recording.

    Attributes:
        value: The share.
        low: The lower end of the interval.
        high: The upper end of the interval.
    """

    value: float
    low: float
    high: float

    @classmethod
    @understood
    def of(cls, message: evaluation_pb2.Proportion) -> Proportion:
        return cls(message.value, message.low, message.high)


@dataclass(frozen=True)
class ShareDifference:
    """The difference of two shares of the same pairs, with its 95 % interval, each -1 to 1.

    Attributes:
        value: The difference.
        low: The lower end of the interval.
        high: The upper end of the interval.
    """

    value: float
    low: float
    high: float

    @classmethod
    @understood
    def of(cls, message: evaluation_pb2.ShareDifference) -> ShareDifference:
        return cls(message.value, message.low, message.high)


def _bounds(recall: evaluation_pb2.PoseRecall) -> tuple[float, float]:
    """The bounds of a recall, meters and degrees. Degrees are rounded, so that they can be looked up."""
    return recall.translation_m, round(float(np.degrees(recall.rotation_rad)), 9)


@dataclass(frozen=True, eq=False)
class NavigatorScores:
    """The scores of one navigator. Arrays have one entry for each threshold.

    Attributes:
        name: The name of the navigator.
        pair_count: The number of pairs scored.
        latent_mse: The mean squared error of the predicted latents; None if only frames were predicted.
        latent_r2: The variance-weighted R² of the predicted latents, not of motions; None if only frames were
            predicted.
        top1: The share of pairs for which the retrieved frame is the target itself.
        thresholds: The thresholds ε, (k,), meters and radians mixed.
        hits: Hit@ε, the share of pairs with an error below ε, (k,).
        hits_low: The lower ends of the 95 % intervals of `hits`, (k,); see `Proportion`.
        hits_high: The upper ends, (k,).
        over_identity: For each threshold, the difference of Hit@ε to that of Identity (standing still) on the same
            pairs; None for Identity itself, and where the source may not be retrieved.
        translation_m_median: The median distance between the retrieved and the target camera, meters.
        rotation_rad_median: The median angle between them, radians.
        recalls: The share of pairs within a distance (meters) and an angle (degrees), by both.
        leaks: Whether these are no held-out scores; False for baselines and predicted frames.
    """

    name: str
    pair_count: int
    latent_mse: float | None
    latent_r2: float | None
    top1: Proportion
    thresholds: Array
    hits: Array
    hits_low: Array
    hits_high: Array
    over_identity: tuple[ShareDifference | None, ...]
    translation_m_median: float
    rotation_rad_median: float
    recalls: dict[tuple[float, float], Proportion]
    leaks: bool

    @classmethod
    @understood
    def of(cls, message: evaluation_pb2.NavigatorScores) -> NavigatorScores:
        hits = [Proportion.of(hit.proportion) for hit in message.hit_rates]
        return cls(
            message.name,
            message.pair_count,
            _known(message, "latent_mse"),
            _known(message, "latent_r2"),
            Proportion.of(message.top1),
            np.array([hit.threshold for hit in message.hit_rates]),
            np.array([hit.value for hit in hits]),
            np.array([hit.low for hit in hits]),
            np.array([hit.high for hit in hits]),
            tuple(
                ShareDifference.of(hit.over_identity) if hit.HasField("over_identity") else None
                for hit in message.hit_rates
            ),
            message.translation_m_median,
            message.rotation_rad_median,
            {_bounds(one): Proportion.of(one.proportion) for one in message.recalls},
            message.leaks,
        )

    def hit(self, threshold: float) -> Proportion:
        """Hit@ε for one of the thresholds, found to nine digits.

        Raises:
            KeyError: no such threshold was scored.
        """
        for row, known in enumerate(self.thresholds):
            if abs(known - threshold) <= 1e-9 * max(1.0, abs(threshold)):
                return Proportion(float(self.hits[row]), float(self.hits_low[row]), float(self.hits_high[row]))
        raise KeyError(f"{threshold} is none of the thresholds {', '.join(f'{known:g}' for known in self.thresholds)}")


@dataclass(frozen=True, eq=False)
class SplitPairs:
    """The pairs of a split, and the frames that may be retrieved. A pair is (source, target), both rows of the room.

    Attributes:
        room: The room.
        split: The split.
        stride: The number of frames from source to target.
        test: The test pairs, (n, 2).
        train: The training pairs of this stride, (m, 2).
        candidates: The frames that may be retrieved in a test, (c,).
    """

    room: Revision
    split: str
    stride: int
    test: npt.NDArray[np.int64]
    train: npt.NDArray[np.int64]
    candidates: npt.NDArray[np.int64]

    @classmethod
    @understood
    def of(cls, message: evaluation_pb2.ListPairsResponse) -> SplitPairs:
        def pairs(given: Sequence[evaluation_pb2.FramePair]) -> npt.NDArray[np.int64]:
            rows = [(pair.source_frame_id, pair.target_frame_id) for pair in given]
            return np.array(rows, dtype=np.int64).reshape(-1, 2)

        return cls(
            Revision.of(message.room),
            enum_word(geometry_pb2.Split, message.split, "SPLIT_"),
            message.stride,
            pairs(message.test_pairs),
            pairs(message.training_pairs),
            np.array(message.candidate_frame_ids, dtype=np.int64),
        )


@dataclass(frozen=True, eq=False)
class Evaluation:
    """Scores of navigators on pairs of frames of a room.

    Attributes:
        room: The room.
        adapter: The adapter.
        split: The split; None for pairs of no split.
        stride: The number of frames from source to target; None if it is not the same for all pairs.
        pair_count: The number of pairs.
        candidate_count: The number of frames that may be retrieved.
        exclude_source: Whether the source frame of a pair could not be retrieved.
        exclude_radius: The number of rows before and after the source frame that could not be retrieved either.
        seed: The seed of the navigator "random"; None for `score`.
        in_room: Whether the adapter was trained in this room; None for `score`.
        leaks: Whether the adapter may have been trained on these pairs or their frames: the scores are then not
            held-out scores.
        calibrated_here: Whether the room is one of the adapter's calibration rooms: the scores of "+calibrated"
            navigators are then not held-out scores.
        steps: The number of steps of each motion; None for `score`.
        step_mode: How the steps were chained; None for `score`.
        navigators: The scores, one entry for each navigator.
    """

    room: Revision
    adapter: Revision
    split: str | None
    stride: int | None
    pair_count: int
    candidate_count: int
    exclude_source: bool
    exclude_radius: int
    seed: int | None
    in_room: bool | None
    leaks: bool
    calibrated_here: bool
    steps: int | None
    step_mode: str | None
    navigators: tuple[NavigatorScores, ...]

    @classmethod
    @understood
    def of(cls, message: evaluation_pb2.EvaluationReport) -> Evaluation:
        return cls(
            Revision.of(message.room),
            Revision.of(message.adapter),
            enum_word(geometry_pb2.Split, message.split, "SPLIT_"),
            message.stride,
            message.pair_count,
            message.candidate_count,
            message.exclude_source,
            message.exclude_radius,
            message.seed,
            message.in_room,
            message.leaks,
            message.calibrated_here,
            message.steps,
            enum_word(navigation_pb2.StepMode, message.step_mode, "STEP_MODE_"),
            tuple(map(NavigatorScores.of, message.navigators)),
        )

    @classmethod
    @understood
    def of_scores(
        cls,
        message: evaluation_pb2.ScorePredictionsResponse,
        request: evaluation_pb2.ScorePredictionsRequest,
        name: str,
    ) -> Evaluation:
        strides = {one.target_frame_id - one.source_frame_id for one in request.predictions}
        scores = NavigatorScores.of(message.scores)
        return cls(
            Revision.of(message.room),
            Revision.of(message.adapter),
            _word_or_none(geometry_pb2.Split, request.split, "SPLIT_"),
            strides.pop() if len(strides) == 1 else None,
            scores.pair_count,
            message.candidate_count,
            request.exclude_source,
            request.exclude_radius,
            None,
            None,
            message.leaks,
            False,
            None,
            None,
            (replace(scores, name=name),),
        )

    def with_navigator(self, other: Evaluation) -> Evaluation:
        """This report with the rows of another one of the same pairs, for instance from `client.score`.

        Args:
            other: The report to add. Room, adapter, split, stride, number of pairs, candidates, exclusion of the
                source and thresholds must be the same.

        Raises:
            ValueError: the reports are of different pairs, or a name of a navigator is in both.
        """
        same = (
            "room",
            "adapter",
            "split",
            "stride",
            "pair_count",
            "candidate_count",
            "exclude_source",
            "exclude_radius",
        )
        for name in same:
            ours, theirs = getattr(self, name), getattr(other, name)
            if ours != theirs:
                raise ValueError(f"the reports are of different pairs: {name} is {ours} and {theirs}")
        thresholds = [scores.thresholds for scores in (*self.navigators, *other.navigators)]
        if any(not np.array_equal(thresholds[0], one) for one in thresholds):
            raise ValueError("the reports have different thresholds")
        names = [scores.name for scores in (*self.navigators, *other.navigators)]
        twice = [name for name in names if names.count(name) > 1]
        if twice:
            raise ValueError(f"{twice[0]!r} is in both reports; name it otherwise: score(…, name=…)")
        return replace(self, navigators=self.navigators + other.navigators)

    def table(self) -> pandas.DataFrame:
        """The scores as a table, a row for each navigator. Needs the extra `seese3[pandas]`.

        Columns are `pairs`, their number; `leak`, which is "LEAK" where the scores are not held-out scores, else "";
        `latent_r2`, the R² of predicted latents, not of motions; for each ε `hit@ε` and `over_identity@ε`, its
        difference to standing still on the same pairs, both with the ends of their 95 % intervals; and `median_m` and
        `median_deg`, the error of the retrieved frame.

        Raises:
            ImportError: pandas is not installed.
        """
        try:
            import pandas
        except ImportError as error:
            raise ImportError('table() needs pandas: pip install "seese3[pandas]"') from error

        rows = []
        for scores in self.navigators:
            row: dict[str, Any] = {"navigator": scores.name, "pairs": scores.pair_count}
            row |= {"leak": "LEAK" if scores.leaks else "", "latent_r2": scores.latent_r2}
            for epsilon, value, low, high in zip(
                scores.thresholds, scores.hits, scores.hits_low, scores.hits_high, strict=True
            ):
                row |= {f"hit@{epsilon:g}": value, f"hit@{epsilon:g} low": low, f"hit@{epsilon:g} high": high}
            for epsilon, over in zip(scores.thresholds, scores.over_identity, strict=True):
                title = f"over_identity@{epsilon:g}"
                ends = (None, None, None) if over is None else (over.value, over.low, over.high)
                row |= dict(zip((title, f"{title} low", f"{title} high"), ends, strict=True))
            row |= {"median_m": scores.translation_m_median, "median_deg": np.degrees(scores.rotation_rad_median)}
            rows.append(row)
        return pandas.DataFrame(rows).set_index("navigator")

    def plot(self, axes: Any = None) -> Any:
        """Draws Hit@ε over ε with 95 % intervals, a line for each navigator. Needs the extra `seese3[plots]`.

        Args:
            axes: The matplotlib axes to draw on; new ones if None.

        Returns:
            The axes.

        Raises:
            ImportError: matplotlib is not installed.
        """
        try:
            from matplotlib import pyplot
        except ImportError as error:
            raise ImportError('plot() needs matplotlib: pip install "seese3[plots]"') from error

        axes = axes if axes is not None else pyplot.subplots(figsize=(9, 4.5), layout="constrained")[1]
        for number, scores in enumerate(self.navigators):
            # There are ten colors: the next ten lines are dashed, so that no two are alike.
            color, dashes = f"C{number % 10}", ("-", "--", ":")[number // 10 % 3]
            label = f"{scores.name} LEAK" if scores.leaks else scores.name
            axes.plot(scores.thresholds, scores.hits, dashes, color=color, marker=".", label=label)
            axes.fill_between(scores.thresholds, scores.hits_low, scores.hits_high, color=color, alpha=0.08)
        over = "" if self.stride is None else f" over {self.stride} frames"
        motions = f"{self.pair_count} motions{over}"
        axes.set(
            xlabel="ε: meters and radians mixed",
            ylabel="Hit@ε",
            ylim=(0, 1.02),
            title=f"{self.room.name}: {motions}, {self.split or 'no'} split" + (" (LEAK)" if self.leaks else ""),
        )
        axes.legend(fontsize="small", loc="center left", bbox_to_anchor=(1.0, 0.5))
        return axes
