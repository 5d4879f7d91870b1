import datetime

from google.protobuf import timestamp_pb2 as _timestamp_pb2
from seese3.v1 import geometry_pb2 as _geometry_pb2
from google.protobuf.internal import containers as _containers
from google.protobuf.internal import enum_type_wrapper as _enum_type_wrapper
from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from collections.abc import Iterable as _Iterable, Mapping as _Mapping
from typing import ClassVar as _ClassVar, Optional as _Optional, Union as _Union

DESCRIPTOR: _descriptor.FileDescriptor

class LayerIndexBase(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    LAYER_INDEX_BASE_UNSPECIFIED: _ClassVar[LayerIndexBase]
    LAYER_INDEX_BASE_ZERO: _ClassVar[LayerIndexBase]
    LAYER_INDEX_BASE_ONE: _ClassVar[LayerIndexBase]
    LAYER_INDEX_BASE_NAME: _ClassVar[LayerIndexBase]

class FinalNorm(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    FINAL_NORM_UNSPECIFIED: _ClassVar[FinalNorm]
    FINAL_NORM_NONE: _ClassVar[FinalNorm]
    FINAL_NORM_APPLIED: _ClassVar[FinalNorm]

class TrainingLoss(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    TRAINING_LOSS_UNSPECIFIED: _ClassVar[TrainingLoss]
    TRAINING_LOSS_MSE: _ClassVar[TrainingLoss]
    TRAINING_LOSS_COSINE: _ClassVar[TrainingLoss]
    TRAINING_LOSS_ROTATION: _ClassVar[TrainingLoss]

class ChartMixing(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    CHART_MIXING_UNSPECIFIED: _ClassVar[ChartMixing]
    CHART_MIXING_GATE: _ClassVar[ChartMixing]
    CHART_MIXING_EVEN: _ClassVar[ChartMixing]

class UploadMode(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    UPLOAD_MODE_UNSPECIFIED: _ClassVar[UploadMode]
    UPLOAD_MODE_CREATE: _ClassVar[UploadMode]
    UPLOAD_MODE_REPLACE: _ClassVar[UploadMode]
    UPLOAD_MODE_EXTEND: _ClassVar[UploadMode]
LAYER_INDEX_BASE_UNSPECIFIED: LayerIndexBase
LAYER_INDEX_BASE_ZERO: LayerIndexBase
LAYER_INDEX_BASE_ONE: LayerIndexBase
LAYER_INDEX_BASE_NAME: LayerIndexBase
FINAL_NORM_UNSPECIFIED: FinalNorm
FINAL_NORM_NONE: FinalNorm
FINAL_NORM_APPLIED: FinalNorm
TRAINING_LOSS_UNSPECIFIED: TrainingLoss
TRAINING_LOSS_MSE: TrainingLoss
TRAINING_LOSS_COSINE: TrainingLoss
TRAINING_LOSS_ROTATION: TrainingLoss
CHART_MIXING_UNSPECIFIED: ChartMixing
CHART_MIXING_GATE: ChartMixing
CHART_MIXING_EVEN: ChartMixing
UPLOAD_MODE_UNSPECIFIED: UploadMode
UPLOAD_MODE_CREATE: UploadMode
UPLOAD_MODE_REPLACE: UploadMode
UPLOAD_MODE_EXTEND: UploadMode

class GetServerInfoRequest(_message.Message):
    __slots__ = ()
    def __init__(self) -> None: ...

class ServerInfo(_message.Message):
    __slots__ = ("version", "encoders", "writable", "encodes_images", "matches_keypoints", "shows_thumbnails", "limits")
    VERSION_FIELD_NUMBER: _ClassVar[int]
    ENCODERS_FIELD_NUMBER: _ClassVar[int]
    WRITABLE_FIELD_NUMBER: _ClassVar[int]
    ENCODES_IMAGES_FIELD_NUMBER: _ClassVar[int]
    MATCHES_KEYPOINTS_FIELD_NUMBER: _ClassVar[int]
    SHOWS_THUMBNAILS_FIELD_NUMBER: _ClassVar[int]
    LIMITS_FIELD_NUMBER: _ClassVar[int]
    version: str
    encoders: _containers.RepeatedCompositeFieldContainer[ServerEncoder]
    writable: bool
    encodes_images: bool
    matches_keypoints: bool
    shows_thumbnails: bool
    limits: ServerLimits
    def __init__(self, version: _Optional[str] = ..., encoders: _Optional[_Iterable[_Union[ServerEncoder, _Mapping]]] = ..., writable: _Optional[bool] = ..., encodes_images: _Optional[bool] = ..., matches_keypoints: _Optional[bool] = ..., shows_thumbnails: _Optional[bool] = ..., limits: _Optional[_Union[ServerLimits, _Mapping]] = ...) -> None: ...

class ServerEncoder(_message.Message):
    __slots__ = ("encoder", "adapters", "detects_keypoints")
    ENCODER_FIELD_NUMBER: _ClassVar[int]
    ADAPTERS_FIELD_NUMBER: _ClassVar[int]
    DETECTS_KEYPOINTS_FIELD_NUMBER: _ClassVar[int]
    encoder: str
    adapters: _containers.RepeatedScalarFieldContainer[str]
    detects_keypoints: bool
    def __init__(self, encoder: _Optional[str] = ..., adapters: _Optional[_Iterable[str]] = ..., detects_keypoints: _Optional[bool] = ...) -> None: ...

class ServerLimits(_message.Message):
    __slots__ = ("top_k", "steps", "batch", "predictions", "message_bytes", "duration_s", "image_pixels", "request_pixels", "answer_frames", "upload_bytes", "streams")
    TOP_K_FIELD_NUMBER: _ClassVar[int]
    STEPS_FIELD_NUMBER: _ClassVar[int]
    BATCH_FIELD_NUMBER: _ClassVar[int]
    PREDICTIONS_FIELD_NUMBER: _ClassVar[int]
    MESSAGE_BYTES_FIELD_NUMBER: _ClassVar[int]
    DURATION_S_FIELD_NUMBER: _ClassVar[int]
    IMAGE_PIXELS_FIELD_NUMBER: _ClassVar[int]
    REQUEST_PIXELS_FIELD_NUMBER: _ClassVar[int]
    ANSWER_FRAMES_FIELD_NUMBER: _ClassVar[int]
    UPLOAD_BYTES_FIELD_NUMBER: _ClassVar[int]
    STREAMS_FIELD_NUMBER: _ClassVar[int]
    top_k: int
    steps: int
    batch: int
    predictions: int
    message_bytes: int
    duration_s: float
    image_pixels: int
    request_pixels: int
    answer_frames: int
    upload_bytes: int
    streams: int
    def __init__(self, top_k: _Optional[int] = ..., steps: _Optional[int] = ..., batch: _Optional[int] = ..., predictions: _Optional[int] = ..., message_bytes: _Optional[int] = ..., duration_s: _Optional[float] = ..., image_pixels: _Optional[int] = ..., request_pixels: _Optional[int] = ..., answer_frames: _Optional[int] = ..., upload_bytes: _Optional[int] = ..., streams: _Optional[int] = ...) -> None: ...

class ListRoomsRequest(_message.Message):
    __slots__ = ("page_size", "page_token")
    PAGE_SIZE_FIELD_NUMBER: _ClassVar[int]
    PAGE_TOKEN_FIELD_NUMBER: _ClassVar[int]
    page_size: int
    page_token: str
    def __init__(self, page_size: _Optional[int] = ..., page_token: _Optional[str] = ...) -> None: ...

class ListRoomsResponse(_message.Message):
    __slots__ = ("rooms", "next_page_token")
    ROOMS_FIELD_NUMBER: _ClassVar[int]
    NEXT_PAGE_TOKEN_FIELD_NUMBER: _ClassVar[int]
    rooms: _containers.RepeatedCompositeFieldContainer[Room]
    next_page_token: str
    def __init__(self, rooms: _Optional[_Iterable[_Union[Room, _Mapping]]] = ..., next_page_token: _Optional[str] = ...) -> None: ...

class ListFramesRequest(_message.Message):
    __slots__ = ("room", "room_revision", "page_size", "page_token", "neighbors_within", "thumbnail_width")
    ROOM_FIELD_NUMBER: _ClassVar[int]
    ROOM_REVISION_FIELD_NUMBER: _ClassVar[int]
    PAGE_SIZE_FIELD_NUMBER: _ClassVar[int]
    PAGE_TOKEN_FIELD_NUMBER: _ClassVar[int]
    NEIGHBORS_WITHIN_FIELD_NUMBER: _ClassVar[int]
    THUMBNAIL_WIDTH_FIELD_NUMBER: _ClassVar[int]
    room: str
    room_revision: int
    page_size: int
    page_token: str
    neighbors_within: float
    thumbnail_width: int
    def __init__(self, room: _Optional[str] = ..., room_revision: _Optional[int] = ..., page_size: _Optional[int] = ..., page_token: _Optional[str] = ..., neighbors_within: _Optional[float] = ..., thumbnail_width: _Optional[int] = ...) -> None: ...

class ListFramesResponse(_message.Message):
    __slots__ = ("room", "frames", "next_page_token")
    ROOM_FIELD_NUMBER: _ClassVar[int]
    FRAMES_FIELD_NUMBER: _ClassVar[int]
    NEXT_PAGE_TOKEN_FIELD_NUMBER: _ClassVar[int]
    room: _geometry_pb2.Revision
    frames: _containers.RepeatedCompositeFieldContainer[RoomFrame]
    next_page_token: str
    def __init__(self, room: _Optional[_Union[_geometry_pb2.Revision, _Mapping]] = ..., frames: _Optional[_Iterable[_Union[RoomFrame, _Mapping]]] = ..., next_page_token: _Optional[str] = ...) -> None: ...

class RoomFrame(_message.Message):
    __slots__ = ("frame_id", "pose", "frame_name", "timestamp_ns", "segment", "neighbors", "thumbnail")
    FRAME_ID_FIELD_NUMBER: _ClassVar[int]
    POSE_FIELD_NUMBER: _ClassVar[int]
    FRAME_NAME_FIELD_NUMBER: _ClassVar[int]
    TIMESTAMP_NS_FIELD_NUMBER: _ClassVar[int]
    SEGMENT_FIELD_NUMBER: _ClassVar[int]
    NEIGHBORS_FIELD_NUMBER: _ClassVar[int]
    THUMBNAIL_FIELD_NUMBER: _ClassVar[int]
    frame_id: int
    pose: _geometry_pb2.Pose
    frame_name: str
    timestamp_ns: int
    segment: int
    neighbors: _containers.RepeatedCompositeFieldContainer[NeighborFrame]
    thumbnail: bytes
    def __init__(self, frame_id: _Optional[int] = ..., pose: _Optional[_Union[_geometry_pb2.Pose, _Mapping]] = ..., frame_name: _Optional[str] = ..., timestamp_ns: _Optional[int] = ..., segment: _Optional[int] = ..., neighbors: _Optional[_Iterable[_Union[NeighborFrame, _Mapping]]] = ..., thumbnail: _Optional[bytes] = ...) -> None: ...

class NeighborFrame(_message.Message):
    __slots__ = ("frame_id", "motion")
    FRAME_ID_FIELD_NUMBER: _ClassVar[int]
    MOTION_FIELD_NUMBER: _ClassVar[int]
    frame_id: int
    motion: _geometry_pb2.Twist
    def __init__(self, frame_id: _Optional[int] = ..., motion: _Optional[_Union[_geometry_pb2.Twist, _Mapping]] = ...) -> None: ...

class GetRoomRequest(_message.Message):
    __slots__ = ("room", "room_revision")
    ROOM_FIELD_NUMBER: _ClassVar[int]
    ROOM_REVISION_FIELD_NUMBER: _ClassVar[int]
    room: str
    room_revision: int
    def __init__(self, room: _Optional[str] = ..., room_revision: _Optional[int] = ...) -> None: ...

class Room(_message.Message):
    __slots__ = ("name", "revision", "frame_count", "adapters", "feature_sources", "format", "license", "worst_rotation_error", "create_time", "camera", "extent", "duration_s", "frame_rate_hz", "has_keypoints", "expected_errors")
    NAME_FIELD_NUMBER: _ClassVar[int]
    REVISION_FIELD_NUMBER: _ClassVar[int]
    FRAME_COUNT_FIELD_NUMBER: _ClassVar[int]
    ADAPTERS_FIELD_NUMBER: _ClassVar[int]
    FEATURE_SOURCES_FIELD_NUMBER: _ClassVar[int]
    FORMAT_FIELD_NUMBER: _ClassVar[int]
    LICENSE_FIELD_NUMBER: _ClassVar[int]
    WORST_ROTATION_ERROR_FIELD_NUMBER: _ClassVar[int]
    CREATE_TIME_FIELD_NUMBER: _ClassVar[int]
    CAMERA_FIELD_NUMBER: _ClassVar[int]
    EXTENT_FIELD_NUMBER: _ClassVar[int]
    DURATION_S_FIELD_NUMBER: _ClassVar[int]
    FRAME_RATE_HZ_FIELD_NUMBER: _ClassVar[int]
    HAS_KEYPOINTS_FIELD_NUMBER: _ClassVar[int]
    EXPECTED_ERRORS_FIELD_NUMBER: _ClassVar[int]
    name: str
    revision: int
    frame_count: int
    adapters: _containers.RepeatedScalarFieldContainer[str]
    feature_sources: _containers.RepeatedCompositeFieldContainer[FeatureSource]
    format: str
    license: str
    worst_rotation_error: float
    create_time: _timestamp_pb2.Timestamp
    camera: _geometry_pb2.CameraIntrinsics
    extent: Extent
    duration_s: float
    frame_rate_hz: float
    has_keypoints: bool
    expected_errors: _containers.RepeatedCompositeFieldContainer[ExpectedError]
    def __init__(self, name: _Optional[str] = ..., revision: _Optional[int] = ..., frame_count: _Optional[int] = ..., adapters: _Optional[_Iterable[str]] = ..., feature_sources: _Optional[_Iterable[_Union[FeatureSource, _Mapping]]] = ..., format: _Optional[str] = ..., license: _Optional[str] = ..., worst_rotation_error: _Optional[float] = ..., create_time: _Optional[_Union[datetime.datetime, _timestamp_pb2.Timestamp, _Mapping]] = ..., camera: _Optional[_Union[_geometry_pb2.CameraIntrinsics, _Mapping]] = ..., extent: _Optional[_Union[Extent, _Mapping]] = ..., duration_s: _Optional[float] = ..., frame_rate_hz: _Optional[float] = ..., has_keypoints: _Optional[bool] = ..., expected_errors: _Optional[_Iterable[_Union[ExpectedError, _Mapping]]] = ...) -> None: ...

class Extent(_message.Message):
    __slots__ = ("min", "max")
    MIN_FIELD_NUMBER: _ClassVar[int]
    MAX_FIELD_NUMBER: _ClassVar[int]
    min: _geometry_pb2.Vector3
    max: _geometry_pb2.Vector3
    def __init__(self, min: _Optional[_Union[_geometry_pb2.Vector3, _Mapping]] = ..., max: _Optional[_Union[_geometry_pb2.Vector3, _Mapping]] = ...) -> None: ...

class ExpectedError(_message.Message):
    __slots__ = ("feature_distance", "translation_m", "rotation_rad")
    FEATURE_DISTANCE_FIELD_NUMBER: _ClassVar[int]
    TRANSLATION_M_FIELD_NUMBER: _ClassVar[int]
    ROTATION_RAD_FIELD_NUMBER: _ClassVar[int]
    feature_distance: float
    translation_m: float
    rotation_rad: float
    def __init__(self, feature_distance: _Optional[float] = ..., translation_m: _Optional[float] = ..., rotation_rad: _Optional[float] = ...) -> None: ...

class FeatureSource(_message.Message):
    __slots__ = ("name", "encoder", "layer", "pooling", "preprocess", "dim", "layer_index_base", "final_norm", "parts")
    NAME_FIELD_NUMBER: _ClassVar[int]
    ENCODER_FIELD_NUMBER: _ClassVar[int]
    LAYER_FIELD_NUMBER: _ClassVar[int]
    POOLING_FIELD_NUMBER: _ClassVar[int]
    PREPROCESS_FIELD_NUMBER: _ClassVar[int]
    DIM_FIELD_NUMBER: _ClassVar[int]
    LAYER_INDEX_BASE_FIELD_NUMBER: _ClassVar[int]
    FINAL_NORM_FIELD_NUMBER: _ClassVar[int]
    PARTS_FIELD_NUMBER: _ClassVar[int]
    name: str
    encoder: str
    layer: str
    pooling: str
    preprocess: str
    dim: int
    layer_index_base: LayerIndexBase
    final_norm: FinalNorm
    parts: _containers.RepeatedCompositeFieldContainer[FeatureSource]
    def __init__(self, name: _Optional[str] = ..., encoder: _Optional[str] = ..., layer: _Optional[str] = ..., pooling: _Optional[str] = ..., preprocess: _Optional[str] = ..., dim: _Optional[int] = ..., layer_index_base: _Optional[_Union[LayerIndexBase, str]] = ..., final_norm: _Optional[_Union[FinalNorm, str]] = ..., parts: _Optional[_Iterable[_Union[FeatureSource, _Mapping]]] = ...) -> None: ...

class ListAdaptersRequest(_message.Message):
    __slots__ = ("page_size", "page_token")
    PAGE_SIZE_FIELD_NUMBER: _ClassVar[int]
    PAGE_TOKEN_FIELD_NUMBER: _ClassVar[int]
    page_size: int
    page_token: str
    def __init__(self, page_size: _Optional[int] = ..., page_token: _Optional[str] = ...) -> None: ...

class ListAdaptersResponse(_message.Message):
    __slots__ = ("adapters", "next_page_token")
    ADAPTERS_FIELD_NUMBER: _ClassVar[int]
    NEXT_PAGE_TOKEN_FIELD_NUMBER: _ClassVar[int]
    adapters: _containers.RepeatedCompositeFieldContainer[Adapter]
    next_page_token: str
    def __init__(self, adapters: _Optional[_Iterable[_Union[Adapter, _Mapping]]] = ..., next_page_token: _Optional[str] = ...) -> None: ...

class GetAdapterRequest(_message.Message):
    __slots__ = ("adapter", "adapter_revision")
    ADAPTER_FIELD_NUMBER: _ClassVar[int]
    ADAPTER_REVISION_FIELD_NUMBER: _ClassVar[int]
    adapter: str
    adapter_revision: int
    def __init__(self, adapter: _Optional[str] = ..., adapter_revision: _Optional[int] = ...) -> None: ...

class Adapter(_message.Message):
    __slots__ = ("name", "revision", "feature_source", "latent_dim", "training_rooms", "preset", "split", "stride", "seed", "test", "train", "train_mean_r2", "target_mean", "target_deviation", "singular_values", "create_time", "charts", "loss", "navigators", "mixing", "calibration_rooms")
    NAME_FIELD_NUMBER: _ClassVar[int]
    REVISION_FIELD_NUMBER: _ClassVar[int]
    FEATURE_SOURCE_FIELD_NUMBER: _ClassVar[int]
    LATENT_DIM_FIELD_NUMBER: _ClassVar[int]
    TRAINING_ROOMS_FIELD_NUMBER: _ClassVar[int]
    PRESET_FIELD_NUMBER: _ClassVar[int]
    SPLIT_FIELD_NUMBER: _ClassVar[int]
    STRIDE_FIELD_NUMBER: _ClassVar[int]
    SEED_FIELD_NUMBER: _ClassVar[int]
    TEST_FIELD_NUMBER: _ClassVar[int]
    TRAIN_FIELD_NUMBER: _ClassVar[int]
    TRAIN_MEAN_R2_FIELD_NUMBER: _ClassVar[int]
    TARGET_MEAN_FIELD_NUMBER: _ClassVar[int]
    TARGET_DEVIATION_FIELD_NUMBER: _ClassVar[int]
    SINGULAR_VALUES_FIELD_NUMBER: _ClassVar[int]
    CREATE_TIME_FIELD_NUMBER: _ClassVar[int]
    CHARTS_FIELD_NUMBER: _ClassVar[int]
    LOSS_FIELD_NUMBER: _ClassVar[int]
    NAVIGATORS_FIELD_NUMBER: _ClassVar[int]
    MIXING_FIELD_NUMBER: _ClassVar[int]
    CALIBRATION_ROOMS_FIELD_NUMBER: _ClassVar[int]
    name: str
    revision: int
    feature_source: FeatureSource
    latent_dim: int
    training_rooms: _containers.RepeatedCompositeFieldContainer[_geometry_pb2.Revision]
    preset: str
    split: _geometry_pb2.Split
    stride: int
    seed: int
    test: MotionScores
    train: MotionScores
    train_mean_r2: float
    target_mean: _geometry_pb2.Twist
    target_deviation: _geometry_pb2.Twist
    singular_values: _containers.RepeatedScalarFieldContainer[float]
    create_time: _timestamp_pb2.Timestamp
    charts: int
    loss: TrainingLoss
    navigators: _containers.RepeatedScalarFieldContainer[str]
    mixing: ChartMixing
    calibration_rooms: _containers.RepeatedCompositeFieldContainer[_geometry_pb2.Revision]
    def __init__(self, name: _Optional[str] = ..., revision: _Optional[int] = ..., feature_source: _Optional[_Union[FeatureSource, _Mapping]] = ..., latent_dim: _Optional[int] = ..., training_rooms: _Optional[_Iterable[_Union[_geometry_pb2.Revision, _Mapping]]] = ..., preset: _Optional[str] = ..., split: _Optional[_Union[_geometry_pb2.Split, str]] = ..., stride: _Optional[int] = ..., seed: _Optional[int] = ..., test: _Optional[_Union[MotionScores, _Mapping]] = ..., train: _Optional[_Union[MotionScores, _Mapping]] = ..., train_mean_r2: _Optional[float] = ..., target_mean: _Optional[_Union[_geometry_pb2.Twist, _Mapping]] = ..., target_deviation: _Optional[_Union[_geometry_pb2.Twist, _Mapping]] = ..., singular_values: _Optional[_Iterable[float]] = ..., create_time: _Optional[_Union[datetime.datetime, _timestamp_pb2.Timestamp, _Mapping]] = ..., charts: _Optional[int] = ..., loss: _Optional[_Union[TrainingLoss, str]] = ..., navigators: _Optional[_Iterable[str]] = ..., mixing: _Optional[_Union[ChartMixing, str]] = ..., calibration_rooms: _Optional[_Iterable[_Union[_geometry_pb2.Revision, _Mapping]]] = ...) -> None: ...

class MotionScores(_message.Message):
    __slots__ = ("pair_count", "overall", "translation", "rotation", "direction", "magnitude", "still_components")
    PAIR_COUNT_FIELD_NUMBER: _ClassVar[int]
    OVERALL_FIELD_NUMBER: _ClassVar[int]
    TRANSLATION_FIELD_NUMBER: _ClassVar[int]
    ROTATION_FIELD_NUMBER: _ClassVar[int]
    DIRECTION_FIELD_NUMBER: _ClassVar[int]
    MAGNITUDE_FIELD_NUMBER: _ClassVar[int]
    STILL_COMPONENTS_FIELD_NUMBER: _ClassVar[int]
    pair_count: int
    overall: float
    translation: float
    rotation: float
    direction: float
    magnitude: float
    still_components: int
    def __init__(self, pair_count: _Optional[int] = ..., overall: _Optional[float] = ..., translation: _Optional[float] = ..., rotation: _Optional[float] = ..., direction: _Optional[float] = ..., magnitude: _Optional[float] = ..., still_components: _Optional[int] = ...) -> None: ...

class UploadRoomRequest(_message.Message):
    __slots__ = ("room", "frames", "end", "keypoints")
    ROOM_FIELD_NUMBER: _ClassVar[int]
    FRAMES_FIELD_NUMBER: _ClassVar[int]
    END_FIELD_NUMBER: _ClassVar[int]
    KEYPOINTS_FIELD_NUMBER: _ClassVar[int]
    room: RoomUpload
    frames: FrameBatch
    end: UploadEnd
    keypoints: bytes
    def __init__(self, room: _Optional[_Union[RoomUpload, _Mapping]] = ..., frames: _Optional[_Union[FrameBatch, _Mapping]] = ..., end: _Optional[_Union[UploadEnd, _Mapping]] = ..., keypoints: _Optional[bytes] = ...) -> None: ...

class RoomUpload(_message.Message):
    __slots__ = ("room", "mode", "feature_sources", "encode_for", "format", "license", "camera", "request_id", "validate_only", "drop_other_features", "keypoints")
    ROOM_FIELD_NUMBER: _ClassVar[int]
    MODE_FIELD_NUMBER: _ClassVar[int]
    FEATURE_SOURCES_FIELD_NUMBER: _ClassVar[int]
    ENCODE_FOR_FIELD_NUMBER: _ClassVar[int]
    FORMAT_FIELD_NUMBER: _ClassVar[int]
    LICENSE_FIELD_NUMBER: _ClassVar[int]
    CAMERA_FIELD_NUMBER: _ClassVar[int]
    REQUEST_ID_FIELD_NUMBER: _ClassVar[int]
    VALIDATE_ONLY_FIELD_NUMBER: _ClassVar[int]
    DROP_OTHER_FEATURES_FIELD_NUMBER: _ClassVar[int]
    KEYPOINTS_FIELD_NUMBER: _ClassVar[int]
    room: str
    mode: UploadMode
    feature_sources: _containers.RepeatedCompositeFieldContainer[FeatureSource]
    encode_for: str
    format: str
    license: str
    camera: _geometry_pb2.CameraIntrinsics
    request_id: str
    validate_only: bool
    drop_other_features: bool
    keypoints: KeypointsUpload
    def __init__(self, room: _Optional[str] = ..., mode: _Optional[_Union[UploadMode, str]] = ..., feature_sources: _Optional[_Iterable[_Union[FeatureSource, _Mapping]]] = ..., encode_for: _Optional[str] = ..., format: _Optional[str] = ..., license: _Optional[str] = ..., camera: _Optional[_Union[_geometry_pb2.CameraIntrinsics, _Mapping]] = ..., request_id: _Optional[str] = ..., validate_only: _Optional[bool] = ..., drop_other_features: _Optional[bool] = ..., keypoints: _Optional[_Union[KeypointsUpload, _Mapping]] = ...) -> None: ...

class KeypointsUpload(_message.Message):
    __slots__ = ("feature_set", "positions", "reliability", "descriptors", "unit_m", "epipolar_px", "design_effect", "gap_scale", "pose_noise", "relative_error")
    FEATURE_SET_FIELD_NUMBER: _ClassVar[int]
    POSITIONS_FIELD_NUMBER: _ClassVar[int]
    RELIABILITY_FIELD_NUMBER: _ClassVar[int]
    DESCRIPTORS_FIELD_NUMBER: _ClassVar[int]
    UNIT_M_FIELD_NUMBER: _ClassVar[int]
    EPIPOLAR_PX_FIELD_NUMBER: _ClassVar[int]
    DESIGN_EFFECT_FIELD_NUMBER: _ClassVar[int]
    GAP_SCALE_FIELD_NUMBER: _ClassVar[int]
    POSE_NOISE_FIELD_NUMBER: _ClassVar[int]
    RELATIVE_ERROR_FIELD_NUMBER: _ClassVar[int]
    feature_set: str
    positions: str
    reliability: str
    descriptors: str
    unit_m: float
    epipolar_px: float
    design_effect: float
    gap_scale: float
    pose_noise: float
    relative_error: float
    def __init__(self, feature_set: _Optional[str] = ..., positions: _Optional[str] = ..., reliability: _Optional[str] = ..., descriptors: _Optional[str] = ..., unit_m: _Optional[float] = ..., epipolar_px: _Optional[float] = ..., design_effect: _Optional[float] = ..., gap_scale: _Optional[float] = ..., pose_noise: _Optional[float] = ..., relative_error: _Optional[float] = ...) -> None: ...

class FrameBatch(_message.Message):
    __slots__ = ("poses", "features", "images", "timestamps_ns", "frame_names", "segments")
    POSES_FIELD_NUMBER: _ClassVar[int]
    FEATURES_FIELD_NUMBER: _ClassVar[int]
    IMAGES_FIELD_NUMBER: _ClassVar[int]
    TIMESTAMPS_NS_FIELD_NUMBER: _ClassVar[int]
    FRAME_NAMES_FIELD_NUMBER: _ClassVar[int]
    SEGMENTS_FIELD_NUMBER: _ClassVar[int]
    poses: bytes
    features: _containers.RepeatedScalarFieldContainer[bytes]
    images: _containers.RepeatedScalarFieldContainer[bytes]
    timestamps_ns: _containers.RepeatedScalarFieldContainer[int]
    frame_names: _containers.RepeatedScalarFieldContainer[str]
    segments: _containers.RepeatedScalarFieldContainer[int]
    def __init__(self, poses: _Optional[bytes] = ..., features: _Optional[_Iterable[bytes]] = ..., images: _Optional[_Iterable[bytes]] = ..., timestamps_ns: _Optional[_Iterable[int]] = ..., frame_names: _Optional[_Iterable[str]] = ..., segments: _Optional[_Iterable[int]] = ...) -> None: ...

class UploadEnd(_message.Message):
    __slots__ = ("frame_count", "sha256")
    FRAME_COUNT_FIELD_NUMBER: _ClassVar[int]
    SHA256_FIELD_NUMBER: _ClassVar[int]
    frame_count: int
    sha256: bytes
    def __init__(self, frame_count: _Optional[int] = ..., sha256: _Optional[bytes] = ...) -> None: ...

class UploadRoomResponse(_message.Message):
    __slots__ = ("revision", "created", "served")
    REVISION_FIELD_NUMBER: _ClassVar[int]
    CREATED_FIELD_NUMBER: _ClassVar[int]
    SERVED_FIELD_NUMBER: _ClassVar[int]
    revision: _geometry_pb2.Revision
    created: bool
    served: bool
    def __init__(self, revision: _Optional[_Union[_geometry_pb2.Revision, _Mapping]] = ..., created: _Optional[bool] = ..., served: _Optional[bool] = ...) -> None: ...

class DownloadRoomRequest(_message.Message):
    __slots__ = ("room", "room_revision")
    ROOM_FIELD_NUMBER: _ClassVar[int]
    ROOM_REVISION_FIELD_NUMBER: _ClassVar[int]
    room: str
    room_revision: int
    def __init__(self, room: _Optional[str] = ..., room_revision: _Optional[int] = ...) -> None: ...

class DownloadRoomResponse(_message.Message):
    __slots__ = ("room", "frames", "end", "keypoints")
    ROOM_FIELD_NUMBER: _ClassVar[int]
    FRAMES_FIELD_NUMBER: _ClassVar[int]
    END_FIELD_NUMBER: _ClassVar[int]
    KEYPOINTS_FIELD_NUMBER: _ClassVar[int]
    room: RoomDownload
    frames: FrameBatch
    end: UploadEnd
    keypoints: bytes
    def __init__(self, room: _Optional[_Union[RoomDownload, _Mapping]] = ..., frames: _Optional[_Union[FrameBatch, _Mapping]] = ..., end: _Optional[_Union[UploadEnd, _Mapping]] = ..., keypoints: _Optional[bytes] = ...) -> None: ...

class RoomDownload(_message.Message):
    __slots__ = ("revision", "upload")
    REVISION_FIELD_NUMBER: _ClassVar[int]
    UPLOAD_FIELD_NUMBER: _ClassVar[int]
    revision: _geometry_pb2.Revision
    upload: RoomUpload
    def __init__(self, revision: _Optional[_Union[_geometry_pb2.Revision, _Mapping]] = ..., upload: _Optional[_Union[RoomUpload, _Mapping]] = ...) -> None: ...

class UploadAdapterRequest(_message.Message):
    __slots__ = ("adapter", "weights")
    ADAPTER_FIELD_NUMBER: _ClassVar[int]
    WEIGHTS_FIELD_NUMBER: _ClassVar[int]
    adapter: AdapterUpload
    weights: bytes
    def __init__(self, adapter: _Optional[_Union[AdapterUpload, _Mapping]] = ..., weights: _Optional[bytes] = ...) -> None: ...

class AdapterUpload(_message.Message):
    __slots__ = ("adapter", "mode", "manifest", "request_id", "validate_only")
    ADAPTER_FIELD_NUMBER: _ClassVar[int]
    MODE_FIELD_NUMBER: _ClassVar[int]
    MANIFEST_FIELD_NUMBER: _ClassVar[int]
    REQUEST_ID_FIELD_NUMBER: _ClassVar[int]
    VALIDATE_ONLY_FIELD_NUMBER: _ClassVar[int]
    adapter: str
    mode: UploadMode
    manifest: bytes
    request_id: str
    validate_only: bool
    def __init__(self, adapter: _Optional[str] = ..., mode: _Optional[_Union[UploadMode, str]] = ..., manifest: _Optional[bytes] = ..., request_id: _Optional[str] = ..., validate_only: _Optional[bool] = ...) -> None: ...

class UploadAdapterResponse(_message.Message):
    __slots__ = ("revision", "created", "served")
    REVISION_FIELD_NUMBER: _ClassVar[int]
    CREATED_FIELD_NUMBER: _ClassVar[int]
    SERVED_FIELD_NUMBER: _ClassVar[int]
    revision: _geometry_pb2.Revision
    created: bool
    served: bool
    def __init__(self, revision: _Optional[_Union[_geometry_pb2.Revision, _Mapping]] = ..., created: _Optional[bool] = ..., served: _Optional[bool] = ...) -> None: ...

class DownloadAdapterRequest(_message.Message):
    __slots__ = ("adapter", "adapter_revision")
    ADAPTER_FIELD_NUMBER: _ClassVar[int]
    ADAPTER_REVISION_FIELD_NUMBER: _ClassVar[int]
    adapter: str
    adapter_revision: int
    def __init__(self, adapter: _Optional[str] = ..., adapter_revision: _Optional[int] = ...) -> None: ...

class DownloadAdapterResponse(_message.Message):
    __slots__ = ("adapter", "weights")
    ADAPTER_FIELD_NUMBER: _ClassVar[int]
    WEIGHTS_FIELD_NUMBER: _ClassVar[int]
    adapter: AdapterDownload
    weights: bytes
    def __init__(self, adapter: _Optional[_Union[AdapterDownload, _Mapping]] = ..., weights: _Optional[bytes] = ...) -> None: ...

class AdapterDownload(_message.Message):
    __slots__ = ("revision", "manifest")
    REVISION_FIELD_NUMBER: _ClassVar[int]
    MANIFEST_FIELD_NUMBER: _ClassVar[int]
    revision: _geometry_pb2.Revision
    manifest: bytes
    def __init__(self, revision: _Optional[_Union[_geometry_pb2.Revision, _Mapping]] = ..., manifest: _Optional[bytes] = ...) -> None: ...

class FitAdapterRequest(_message.Message):
    __slots__ = ("room", "base_adapter", "feature_set", "fitted_adapter", "seed", "request_id", "validate_only")
    ROOM_FIELD_NUMBER: _ClassVar[int]
    BASE_ADAPTER_FIELD_NUMBER: _ClassVar[int]
    FEATURE_SET_FIELD_NUMBER: _ClassVar[int]
    FITTED_ADAPTER_FIELD_NUMBER: _ClassVar[int]
    SEED_FIELD_NUMBER: _ClassVar[int]
    REQUEST_ID_FIELD_NUMBER: _ClassVar[int]
    VALIDATE_ONLY_FIELD_NUMBER: _ClassVar[int]
    room: str
    base_adapter: str
    feature_set: str
    fitted_adapter: str
    seed: int
    request_id: str
    validate_only: bool
    def __init__(self, room: _Optional[str] = ..., base_adapter: _Optional[str] = ..., feature_set: _Optional[str] = ..., fitted_adapter: _Optional[str] = ..., seed: _Optional[int] = ..., request_id: _Optional[str] = ..., validate_only: _Optional[bool] = ...) -> None: ...

class FitAdapterResponse(_message.Message):
    __slots__ = ("progress", "result")
    PROGRESS_FIELD_NUMBER: _ClassVar[int]
    RESULT_FIELD_NUMBER: _ClassVar[int]
    progress: FitProgress
    result: FitResult
    def __init__(self, progress: _Optional[_Union[FitProgress, _Mapping]] = ..., result: _Optional[_Union[FitResult, _Mapping]] = ...) -> None: ...

class FitProgress(_message.Message):
    __slots__ = ("done", "total")
    DONE_FIELD_NUMBER: _ClassVar[int]
    TOTAL_FIELD_NUMBER: _ClassVar[int]
    done: int
    total: int
    def __init__(self, done: _Optional[int] = ..., total: _Optional[int] = ...) -> None: ...

class FitResult(_message.Message):
    __slots__ = ("revision", "created", "served")
    REVISION_FIELD_NUMBER: _ClassVar[int]
    CREATED_FIELD_NUMBER: _ClassVar[int]
    SERVED_FIELD_NUMBER: _ClassVar[int]
    revision: _geometry_pb2.Revision
    created: bool
    served: bool
    def __init__(self, revision: _Optional[_Union[_geometry_pb2.Revision, _Mapping]] = ..., created: _Optional[bool] = ..., served: _Optional[bool] = ...) -> None: ...

class CatalogDefault(_message.Message):
    __slots__ = ("room_adapter", "room_revision", "adapter_revision")
    ROOM_ADAPTER_FIELD_NUMBER: _ClassVar[int]
    ROOM_REVISION_FIELD_NUMBER: _ClassVar[int]
    ADAPTER_REVISION_FIELD_NUMBER: _ClassVar[int]
    room_adapter: RoomAdapter
    room_revision: _geometry_pb2.Revision
    adapter_revision: _geometry_pb2.Revision
    def __init__(self, room_adapter: _Optional[_Union[RoomAdapter, _Mapping]] = ..., room_revision: _Optional[_Union[_geometry_pb2.Revision, _Mapping]] = ..., adapter_revision: _Optional[_Union[_geometry_pb2.Revision, _Mapping]] = ...) -> None: ...

class RoomAdapter(_message.Message):
    __slots__ = ("room", "adapter")
    ROOM_FIELD_NUMBER: _ClassVar[int]
    ADAPTER_FIELD_NUMBER: _ClassVar[int]
    room: str
    adapter: str
    def __init__(self, room: _Optional[str] = ..., adapter: _Optional[str] = ...) -> None: ...

class ListDefaultsRequest(_message.Message):
    __slots__ = ()
    def __init__(self) -> None: ...

class ListDefaultsResponse(_message.Message):
    __slots__ = ("defaults",)
    DEFAULTS_FIELD_NUMBER: _ClassVar[int]
    defaults: _containers.RepeatedCompositeFieldContainer[CatalogDefault]
    def __init__(self, defaults: _Optional[_Iterable[_Union[CatalogDefault, _Mapping]]] = ...) -> None: ...

class SetDefaultRequest(_message.Message):
    __slots__ = ("default", "request_id", "validate_only")
    DEFAULT_FIELD_NUMBER: _ClassVar[int]
    REQUEST_ID_FIELD_NUMBER: _ClassVar[int]
    VALIDATE_ONLY_FIELD_NUMBER: _ClassVar[int]
    default: CatalogDefault
    request_id: str
    validate_only: bool
    def __init__(self, default: _Optional[_Union[CatalogDefault, _Mapping]] = ..., request_id: _Optional[str] = ..., validate_only: _Optional[bool] = ...) -> None: ...

class SetDefaultResponse(_message.Message):
    __slots__ = ("defaults",)
    DEFAULTS_FIELD_NUMBER: _ClassVar[int]
    defaults: _containers.RepeatedCompositeFieldContainer[CatalogDefault]
    def __init__(self, defaults: _Optional[_Iterable[_Union[CatalogDefault, _Mapping]]] = ...) -> None: ...

class ClearDefaultRequest(_message.Message):
    __slots__ = ("adapter_of_room", "revision_of_room", "revision_of_adapter", "request_id", "validate_only")
    ADAPTER_OF_ROOM_FIELD_NUMBER: _ClassVar[int]
    REVISION_OF_ROOM_FIELD_NUMBER: _ClassVar[int]
    REVISION_OF_ADAPTER_FIELD_NUMBER: _ClassVar[int]
    REQUEST_ID_FIELD_NUMBER: _ClassVar[int]
    VALIDATE_ONLY_FIELD_NUMBER: _ClassVar[int]
    adapter_of_room: str
    revision_of_room: str
    revision_of_adapter: str
    request_id: str
    validate_only: bool
    def __init__(self, adapter_of_room: _Optional[str] = ..., revision_of_room: _Optional[str] = ..., revision_of_adapter: _Optional[str] = ..., request_id: _Optional[str] = ..., validate_only: _Optional[bool] = ...) -> None: ...

class ClearDefaultResponse(_message.Message):
    __slots__ = ("defaults",)
    DEFAULTS_FIELD_NUMBER: _ClassVar[int]
    defaults: _containers.RepeatedCompositeFieldContainer[CatalogDefault]
    def __init__(self, defaults: _Optional[_Iterable[_Union[CatalogDefault, _Mapping]]] = ...) -> None: ...

class DeleteRoomRequest(_message.Message):
    __slots__ = ("room", "room_revision", "request_id", "validate_only")
    ROOM_FIELD_NUMBER: _ClassVar[int]
    ROOM_REVISION_FIELD_NUMBER: _ClassVar[int]
    REQUEST_ID_FIELD_NUMBER: _ClassVar[int]
    VALIDATE_ONLY_FIELD_NUMBER: _ClassVar[int]
    room: str
    room_revision: int
    request_id: str
    validate_only: bool
    def __init__(self, room: _Optional[str] = ..., room_revision: _Optional[int] = ..., request_id: _Optional[str] = ..., validate_only: _Optional[bool] = ...) -> None: ...

class DeleteRoomResponse(_message.Message):
    __slots__ = ("revisions",)
    REVISIONS_FIELD_NUMBER: _ClassVar[int]
    revisions: _containers.RepeatedScalarFieldContainer[int]
    def __init__(self, revisions: _Optional[_Iterable[int]] = ...) -> None: ...

class DeleteAdapterRequest(_message.Message):
    __slots__ = ("adapter", "adapter_revision", "request_id", "validate_only")
    ADAPTER_FIELD_NUMBER: _ClassVar[int]
    ADAPTER_REVISION_FIELD_NUMBER: _ClassVar[int]
    REQUEST_ID_FIELD_NUMBER: _ClassVar[int]
    VALIDATE_ONLY_FIELD_NUMBER: _ClassVar[int]
    adapter: str
    adapter_revision: int
    request_id: str
    validate_only: bool
    def __init__(self, adapter: _Optional[str] = ..., adapter_revision: _Optional[int] = ..., request_id: _Optional[str] = ..., validate_only: _Optional[bool] = ...) -> None: ...

class DeleteAdapterResponse(_message.Message):
    __slots__ = ("revisions",)
    REVISIONS_FIELD_NUMBER: _ClassVar[int]
    revisions: _containers.RepeatedScalarFieldContainer[int]
    def __init__(self, revisions: _Optional[_Iterable[int]] = ...) -> None: ...
