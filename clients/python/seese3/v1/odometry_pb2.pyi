from seese3.v1 import geometry_pb2 as _geometry_pb2
from google.protobuf.internal import containers as _containers
from google.protobuf.internal import enum_type_wrapper as _enum_type_wrapper
from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from collections.abc import Iterable as _Iterable, Mapping as _Mapping
from typing import ClassVar as _ClassVar, Optional as _Optional, Union as _Union

DESCRIPTOR: _descriptor.FileDescriptor

class MotionEstimator(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    MOTION_ESTIMATOR_UNSPECIFIED: _ClassVar[MotionEstimator]
    MOTION_ESTIMATOR_ADAPTER: _ClassVar[MotionEstimator]
    MOTION_ESTIMATOR_TWO_VIEW: _ClassVar[MotionEstimator]
    MOTION_ESTIMATOR_NONE: _ClassVar[MotionEstimator]
    MOTION_ESTIMATOR_RELATIONAL: _ClassVar[MotionEstimator]

class Fusion(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    FUSION_UNSPECIFIED: _ClassVar[Fusion]
    FUSION_ANCHORS: _ClassVar[Fusion]
    FUSION_NONE: _ClassVar[Fusion]

class BackPressure(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    BACK_PRESSURE_UNSPECIFIED: _ClassVar[BackPressure]
    BACK_PRESSURE_IN_ORDER: _ClassVar[BackPressure]
    BACK_PRESSURE_NEWEST: _ClassVar[BackPressure]

class TrackSensor(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    TRACK_SENSOR_UNSPECIFIED: _ClassVar[TrackSensor]
    TRACK_SENSOR_ODOMETRY: _ClassVar[TrackSensor]
    TRACK_SENSOR_IMAGES: _ClassVar[TrackSensor]
    TRACK_SENSOR_INERTIAL: _ClassVar[TrackSensor]
    TRACK_SENSOR_GRAVITY: _ClassVar[TrackSensor]
    TRACK_SENSOR_VIEWS: _ClassVar[TrackSensor]

class TrackStatus(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    TRACK_STATUS_UNSPECIFIED: _ClassVar[TrackStatus]
    TRACK_STATUS_TRACKING: _ClassVar[TrackStatus]
    TRACK_STATUS_DEGRADED: _ClassVar[TrackStatus]
    TRACK_STATUS_LOST: _ClassVar[TrackStatus]
    TRACK_STATUS_RELOCALIZING: _ClassVar[TrackStatus]

class TrackRefusalReason(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    TRACK_REFUSAL_REASON_UNSPECIFIED: _ClassVar[TrackRefusalReason]
    TRACK_REFUSAL_REASON_LATE: _ClassVar[TrackRefusalReason]
    TRACK_REFUSAL_REASON_DUPLICATE: _ClassVar[TrackRefusalReason]
    TRACK_REFUSAL_REASON_SUPERSEDED: _ClassVar[TrackRefusalReason]
    TRACK_REFUSAL_REASON_VIEW: _ClassVar[TrackRefusalReason]
    TRACK_REFUSAL_REASON_POSE: _ClassVar[TrackRefusalReason]
    TRACK_REFUSAL_REASON_ODOMETRY: _ClassVar[TrackRefusalReason]
    TRACK_REFUSAL_REASON_GRAVITY: _ClassVar[TrackRefusalReason]
    TRACK_REFUSAL_REASON_INERTIAL: _ClassVar[TrackRefusalReason]
MOTION_ESTIMATOR_UNSPECIFIED: MotionEstimator
MOTION_ESTIMATOR_ADAPTER: MotionEstimator
MOTION_ESTIMATOR_TWO_VIEW: MotionEstimator
MOTION_ESTIMATOR_NONE: MotionEstimator
MOTION_ESTIMATOR_RELATIONAL: MotionEstimator
FUSION_UNSPECIFIED: Fusion
FUSION_ANCHORS: Fusion
FUSION_NONE: Fusion
BACK_PRESSURE_UNSPECIFIED: BackPressure
BACK_PRESSURE_IN_ORDER: BackPressure
BACK_PRESSURE_NEWEST: BackPressure
TRACK_SENSOR_UNSPECIFIED: TrackSensor
TRACK_SENSOR_ODOMETRY: TrackSensor
TRACK_SENSOR_IMAGES: TrackSensor
TRACK_SENSOR_INERTIAL: TrackSensor
TRACK_SENSOR_GRAVITY: TrackSensor
TRACK_SENSOR_VIEWS: TrackSensor
TRACK_STATUS_UNSPECIFIED: TrackStatus
TRACK_STATUS_TRACKING: TrackStatus
TRACK_STATUS_DEGRADED: TrackStatus
TRACK_STATUS_LOST: TrackStatus
TRACK_STATUS_RELOCALIZING: TrackStatus
TRACK_REFUSAL_REASON_UNSPECIFIED: TrackRefusalReason
TRACK_REFUSAL_REASON_LATE: TrackRefusalReason
TRACK_REFUSAL_REASON_DUPLICATE: TrackRefusalReason
TRACK_REFUSAL_REASON_SUPERSEDED: TrackRefusalReason
TRACK_REFUSAL_REASON_VIEW: TrackRefusalReason
TRACK_REFUSAL_REASON_POSE: TrackRefusalReason
TRACK_REFUSAL_REASON_ODOMETRY: TrackRefusalReason
TRACK_REFUSAL_REASON_GRAVITY: TrackRefusalReason
TRACK_REFUSAL_REASON_INERTIAL: TrackRefusalReason

class EstimateMotionRequest(_message.Message):
    __slots__ = ("room", "room_revision", "adapter", "adapter_revision", "first", "second", "camera", "estimator")
    ROOM_FIELD_NUMBER: _ClassVar[int]
    ROOM_REVISION_FIELD_NUMBER: _ClassVar[int]
    ADAPTER_FIELD_NUMBER: _ClassVar[int]
    ADAPTER_REVISION_FIELD_NUMBER: _ClassVar[int]
    FIRST_FIELD_NUMBER: _ClassVar[int]
    SECOND_FIELD_NUMBER: _ClassVar[int]
    CAMERA_FIELD_NUMBER: _ClassVar[int]
    ESTIMATOR_FIELD_NUMBER: _ClassVar[int]
    room: str
    room_revision: int
    adapter: str
    adapter_revision: int
    first: _geometry_pb2.View
    second: _geometry_pb2.View
    camera: _geometry_pb2.ViewCamera
    estimator: MotionEstimator
    def __init__(self, room: _Optional[str] = ..., room_revision: _Optional[int] = ..., adapter: _Optional[str] = ..., adapter_revision: _Optional[int] = ..., first: _Optional[_Union[_geometry_pb2.View, _Mapping]] = ..., second: _Optional[_Union[_geometry_pb2.View, _Mapping]] = ..., camera: _Optional[_Union[_geometry_pb2.ViewCamera, _Mapping]] = ..., estimator: _Optional[_Union[MotionEstimator, str]] = ...) -> None: ...

class EncodeRequest(_message.Message):
    __slots__ = ("room", "room_revision", "adapter", "adapter_revision", "views", "with_features")
    ROOM_FIELD_NUMBER: _ClassVar[int]
    ROOM_REVISION_FIELD_NUMBER: _ClassVar[int]
    ADAPTER_FIELD_NUMBER: _ClassVar[int]
    ADAPTER_REVISION_FIELD_NUMBER: _ClassVar[int]
    VIEWS_FIELD_NUMBER: _ClassVar[int]
    WITH_FEATURES_FIELD_NUMBER: _ClassVar[int]
    room: str
    room_revision: int
    adapter: str
    adapter_revision: int
    views: _containers.RepeatedCompositeFieldContainer[_geometry_pb2.View]
    with_features: bool
    def __init__(self, room: _Optional[str] = ..., room_revision: _Optional[int] = ..., adapter: _Optional[str] = ..., adapter_revision: _Optional[int] = ..., views: _Optional[_Iterable[_Union[_geometry_pb2.View, _Mapping]]] = ..., with_features: _Optional[bool] = ...) -> None: ...

class EncodeResponse(_message.Message):
    __slots__ = ("adapter", "views")
    ADAPTER_FIELD_NUMBER: _ClassVar[int]
    VIEWS_FIELD_NUMBER: _ClassVar[int]
    adapter: _geometry_pb2.Revision
    views: _containers.RepeatedCompositeFieldContainer[EncodedView]
    def __init__(self, adapter: _Optional[_Union[_geometry_pb2.Revision, _Mapping]] = ..., views: _Optional[_Iterable[_Union[EncodedView, _Mapping]]] = ...) -> None: ...

class EncodedView(_message.Message):
    __slots__ = ("latent", "feature")
    LATENT_FIELD_NUMBER: _ClassVar[int]
    FEATURE_FIELD_NUMBER: _ClassVar[int]
    latent: _geometry_pb2.Latent
    feature: _geometry_pb2.Feature
    def __init__(self, latent: _Optional[_Union[_geometry_pb2.Latent, _Mapping]] = ..., feature: _Optional[_Union[_geometry_pb2.Feature, _Mapping]] = ...) -> None: ...

class EstimateMotionResponse(_message.Message):
    __slots__ = ("adapter", "motion", "true_motion", "error", "estimator")
    ADAPTER_FIELD_NUMBER: _ClassVar[int]
    MOTION_FIELD_NUMBER: _ClassVar[int]
    TRUE_MOTION_FIELD_NUMBER: _ClassVar[int]
    ERROR_FIELD_NUMBER: _ClassVar[int]
    ESTIMATOR_FIELD_NUMBER: _ClassVar[int]
    adapter: _geometry_pb2.Revision
    motion: _geometry_pb2.TwistWithCovariance
    true_motion: _geometry_pb2.Twist
    error: _geometry_pb2.PoseError
    estimator: MotionEstimator
    def __init__(self, adapter: _Optional[_Union[_geometry_pb2.Revision, _Mapping]] = ..., motion: _Optional[_Union[_geometry_pb2.TwistWithCovariance, _Mapping]] = ..., true_motion: _Optional[_Union[_geometry_pb2.Twist, _Mapping]] = ..., error: _Optional[_Union[_geometry_pb2.PoseError, _Mapping]] = ..., estimator: _Optional[_Union[MotionEstimator, str]] = ...) -> None: ...

class TrackRequest(_message.Message):
    __slots__ = ("config", "frame", "set_initial_pose", "reset")
    CONFIG_FIELD_NUMBER: _ClassVar[int]
    FRAME_FIELD_NUMBER: _ClassVar[int]
    SET_INITIAL_POSE_FIELD_NUMBER: _ClassVar[int]
    RESET_FIELD_NUMBER: _ClassVar[int]
    config: TrackConfig
    frame: TrackFrame
    set_initial_pose: SetInitialPose
    reset: Reset
    def __init__(self, config: _Optional[_Union[TrackConfig, _Mapping]] = ..., frame: _Optional[_Union[TrackFrame, _Mapping]] = ..., set_initial_pose: _Optional[_Union[SetInitialPose, _Mapping]] = ..., reset: _Optional[_Union[Reset, _Mapping]] = ...) -> None: ...

class TrackConfig(_message.Message):
    __slots__ = ("room", "rooms", "room_revisions", "adapter", "adapter_revision", "initial_pose", "keyframes", "fusion", "frame_names", "back_pressure", "resume_token", "token_every", "base_from_camera", "camera", "gravity_in_map", "other_cameras", "inertial_sensor", "trust_odometry", "time_offset_ns")
    class RoomRevisionsEntry(_message.Message):
        __slots__ = ("key", "value")
        KEY_FIELD_NUMBER: _ClassVar[int]
        VALUE_FIELD_NUMBER: _ClassVar[int]
        key: str
        value: int
        def __init__(self, key: _Optional[str] = ..., value: _Optional[int] = ...) -> None: ...
    ROOM_FIELD_NUMBER: _ClassVar[int]
    ROOMS_FIELD_NUMBER: _ClassVar[int]
    ROOM_REVISIONS_FIELD_NUMBER: _ClassVar[int]
    ADAPTER_FIELD_NUMBER: _ClassVar[int]
    ADAPTER_REVISION_FIELD_NUMBER: _ClassVar[int]
    INITIAL_POSE_FIELD_NUMBER: _ClassVar[int]
    KEYFRAMES_FIELD_NUMBER: _ClassVar[int]
    FUSION_FIELD_NUMBER: _ClassVar[int]
    FRAME_NAMES_FIELD_NUMBER: _ClassVar[int]
    BACK_PRESSURE_FIELD_NUMBER: _ClassVar[int]
    RESUME_TOKEN_FIELD_NUMBER: _ClassVar[int]
    TOKEN_EVERY_FIELD_NUMBER: _ClassVar[int]
    BASE_FROM_CAMERA_FIELD_NUMBER: _ClassVar[int]
    CAMERA_FIELD_NUMBER: _ClassVar[int]
    GRAVITY_IN_MAP_FIELD_NUMBER: _ClassVar[int]
    OTHER_CAMERAS_FIELD_NUMBER: _ClassVar[int]
    INERTIAL_SENSOR_FIELD_NUMBER: _ClassVar[int]
    TRUST_ODOMETRY_FIELD_NUMBER: _ClassVar[int]
    TIME_OFFSET_NS_FIELD_NUMBER: _ClassVar[int]
    room: str
    rooms: _containers.RepeatedScalarFieldContainer[str]
    room_revisions: _containers.ScalarMap[str, int]
    adapter: str
    adapter_revision: int
    initial_pose: InitialPose
    keyframes: KeyframePolicy
    fusion: Fusion
    frame_names: FrameNames
    back_pressure: BackPressure
    resume_token: bytes
    token_every: int
    base_from_camera: _geometry_pb2.Pose
    camera: _geometry_pb2.ViewCamera
    gravity_in_map: _geometry_pb2.Vector3
    other_cameras: _containers.RepeatedCompositeFieldContainer[RigCamera]
    inertial_sensor: InertialSensor
    trust_odometry: bool
    time_offset_ns: int
    def __init__(self, room: _Optional[str] = ..., rooms: _Optional[_Iterable[str]] = ..., room_revisions: _Optional[_Mapping[str, int]] = ..., adapter: _Optional[str] = ..., adapter_revision: _Optional[int] = ..., initial_pose: _Optional[_Union[InitialPose, _Mapping]] = ..., keyframes: _Optional[_Union[KeyframePolicy, _Mapping]] = ..., fusion: _Optional[_Union[Fusion, str]] = ..., frame_names: _Optional[_Union[FrameNames, _Mapping]] = ..., back_pressure: _Optional[_Union[BackPressure, str]] = ..., resume_token: _Optional[bytes] = ..., token_every: _Optional[int] = ..., base_from_camera: _Optional[_Union[_geometry_pb2.Pose, _Mapping]] = ..., camera: _Optional[_Union[_geometry_pb2.ViewCamera, _Mapping]] = ..., gravity_in_map: _Optional[_Union[_geometry_pb2.Vector3, _Mapping]] = ..., other_cameras: _Optional[_Iterable[_Union[RigCamera, _Mapping]]] = ..., inertial_sensor: _Optional[_Union[InertialSensor, _Mapping]] = ..., trust_odometry: _Optional[bool] = ..., time_offset_ns: _Optional[int] = ...) -> None: ...

class InertialSensor(_message.Message):
    __slots__ = ("pose", "gyroscope_noise", "accelerometer_noise", "gyroscope_bias_deviation", "accelerometer_bias_deviation", "gyroscope_bias_walk", "accelerometer_bias_walk", "time_offset_ns")
    POSE_FIELD_NUMBER: _ClassVar[int]
    GYROSCOPE_NOISE_FIELD_NUMBER: _ClassVar[int]
    ACCELEROMETER_NOISE_FIELD_NUMBER: _ClassVar[int]
    GYROSCOPE_BIAS_DEVIATION_FIELD_NUMBER: _ClassVar[int]
    ACCELEROMETER_BIAS_DEVIATION_FIELD_NUMBER: _ClassVar[int]
    GYROSCOPE_BIAS_WALK_FIELD_NUMBER: _ClassVar[int]
    ACCELEROMETER_BIAS_WALK_FIELD_NUMBER: _ClassVar[int]
    TIME_OFFSET_NS_FIELD_NUMBER: _ClassVar[int]
    pose: _geometry_pb2.Pose
    gyroscope_noise: float
    accelerometer_noise: float
    gyroscope_bias_deviation: float
    accelerometer_bias_deviation: float
    gyroscope_bias_walk: float
    accelerometer_bias_walk: float
    time_offset_ns: int
    def __init__(self, pose: _Optional[_Union[_geometry_pb2.Pose, _Mapping]] = ..., gyroscope_noise: _Optional[float] = ..., accelerometer_noise: _Optional[float] = ..., gyroscope_bias_deviation: _Optional[float] = ..., accelerometer_bias_deviation: _Optional[float] = ..., gyroscope_bias_walk: _Optional[float] = ..., accelerometer_bias_walk: _Optional[float] = ..., time_offset_ns: _Optional[int] = ...) -> None: ...

class InertialSample(_message.Message):
    __slots__ = ("timestamp_ns", "angular_velocity", "linear_acceleration")
    TIMESTAMP_NS_FIELD_NUMBER: _ClassVar[int]
    ANGULAR_VELOCITY_FIELD_NUMBER: _ClassVar[int]
    LINEAR_ACCELERATION_FIELD_NUMBER: _ClassVar[int]
    timestamp_ns: int
    angular_velocity: _geometry_pb2.Vector3
    linear_acceleration: _geometry_pb2.Vector3
    def __init__(self, timestamp_ns: _Optional[int] = ..., angular_velocity: _Optional[_Union[_geometry_pb2.Vector3, _Mapping]] = ..., linear_acceleration: _Optional[_Union[_geometry_pb2.Vector3, _Mapping]] = ...) -> None: ...

class RigCamera(_message.Message):
    __slots__ = ("name", "pose", "intrinsics", "time_offset_ns")
    NAME_FIELD_NUMBER: _ClassVar[int]
    POSE_FIELD_NUMBER: _ClassVar[int]
    INTRINSICS_FIELD_NUMBER: _ClassVar[int]
    TIME_OFFSET_NS_FIELD_NUMBER: _ClassVar[int]
    name: str
    pose: _geometry_pb2.Pose
    intrinsics: _geometry_pb2.CameraIntrinsics
    time_offset_ns: int
    def __init__(self, name: _Optional[str] = ..., pose: _Optional[_Union[_geometry_pb2.Pose, _Mapping]] = ..., intrinsics: _Optional[_Union[_geometry_pb2.CameraIntrinsics, _Mapping]] = ..., time_offset_ns: _Optional[int] = ...) -> None: ...

class DepthImage(_message.Message):
    __slots__ = ("png", "unit_m", "deviation_m")
    PNG_FIELD_NUMBER: _ClassVar[int]
    UNIT_M_FIELD_NUMBER: _ClassVar[int]
    DEVIATION_M_FIELD_NUMBER: _ClassVar[int]
    png: bytes
    unit_m: float
    deviation_m: float
    def __init__(self, png: _Optional[bytes] = ..., unit_m: _Optional[float] = ..., deviation_m: _Optional[float] = ...) -> None: ...

class InitialPose(_message.Message):
    __slots__ = ("pose", "position_deviation_m", "rotation_deviation_rad")
    POSE_FIELD_NUMBER: _ClassVar[int]
    POSITION_DEVIATION_M_FIELD_NUMBER: _ClassVar[int]
    ROTATION_DEVIATION_RAD_FIELD_NUMBER: _ClassVar[int]
    pose: _geometry_pb2.Pose
    position_deviation_m: float
    rotation_deviation_rad: float
    def __init__(self, pose: _Optional[_Union[_geometry_pb2.Pose, _Mapping]] = ..., position_deviation_m: _Optional[float] = ..., rotation_deviation_rad: _Optional[float] = ...) -> None: ...

class KeyframePolicy(_message.Message):
    __slots__ = ("motion_norm", "sequence_interval")
    MOTION_NORM_FIELD_NUMBER: _ClassVar[int]
    SEQUENCE_INTERVAL_FIELD_NUMBER: _ClassVar[int]
    motion_norm: float
    sequence_interval: int
    def __init__(self, motion_norm: _Optional[float] = ..., sequence_interval: _Optional[int] = ...) -> None: ...

class FrameNames(_message.Message):
    __slots__ = ("map", "odom", "camera", "base")
    MAP_FIELD_NUMBER: _ClassVar[int]
    ODOM_FIELD_NUMBER: _ClassVar[int]
    CAMERA_FIELD_NUMBER: _ClassVar[int]
    BASE_FIELD_NUMBER: _ClassVar[int]
    map: str
    odom: str
    camera: str
    base: str
    def __init__(self, map: _Optional[str] = ..., odom: _Optional[str] = ..., camera: _Optional[str] = ..., base: _Optional[str] = ...) -> None: ...

class TrackFrame(_message.Message):
    __slots__ = ("timestamp_ns", "sequence_number", "view", "with_token", "odometry", "gravity", "other_views", "inertial_samples", "exposure_ns", "depth")
    TIMESTAMP_NS_FIELD_NUMBER: _ClassVar[int]
    SEQUENCE_NUMBER_FIELD_NUMBER: _ClassVar[int]
    VIEW_FIELD_NUMBER: _ClassVar[int]
    WITH_TOKEN_FIELD_NUMBER: _ClassVar[int]
    ODOMETRY_FIELD_NUMBER: _ClassVar[int]
    GRAVITY_FIELD_NUMBER: _ClassVar[int]
    OTHER_VIEWS_FIELD_NUMBER: _ClassVar[int]
    INERTIAL_SAMPLES_FIELD_NUMBER: _ClassVar[int]
    EXPOSURE_NS_FIELD_NUMBER: _ClassVar[int]
    DEPTH_FIELD_NUMBER: _ClassVar[int]
    timestamp_ns: int
    sequence_number: int
    view: _geometry_pb2.View
    with_token: bool
    odometry: MeasuredOdometry
    gravity: MeasuredGravity
    other_views: _containers.RepeatedCompositeFieldContainer[OtherView]
    inertial_samples: _containers.RepeatedCompositeFieldContainer[InertialSample]
    exposure_ns: int
    depth: DepthImage
    def __init__(self, timestamp_ns: _Optional[int] = ..., sequence_number: _Optional[int] = ..., view: _Optional[_Union[_geometry_pb2.View, _Mapping]] = ..., with_token: _Optional[bool] = ..., odometry: _Optional[_Union[MeasuredOdometry, _Mapping]] = ..., gravity: _Optional[_Union[MeasuredGravity, _Mapping]] = ..., other_views: _Optional[_Iterable[_Union[OtherView, _Mapping]]] = ..., inertial_samples: _Optional[_Iterable[_Union[InertialSample, _Mapping]]] = ..., exposure_ns: _Optional[int] = ..., depth: _Optional[_Union[DepthImage, _Mapping]] = ...) -> None: ...

class MeasuredGravity(_message.Message):
    __slots__ = ("direction", "coordinate_frame", "deviation_rad")
    DIRECTION_FIELD_NUMBER: _ClassVar[int]
    COORDINATE_FRAME_FIELD_NUMBER: _ClassVar[int]
    DEVIATION_RAD_FIELD_NUMBER: _ClassVar[int]
    direction: _geometry_pb2.Vector3
    coordinate_frame: str
    deviation_rad: float
    def __init__(self, direction: _Optional[_Union[_geometry_pb2.Vector3, _Mapping]] = ..., coordinate_frame: _Optional[str] = ..., deviation_rad: _Optional[float] = ...) -> None: ...

class OtherView(_message.Message):
    __slots__ = ("camera_name", "view")
    CAMERA_NAME_FIELD_NUMBER: _ClassVar[int]
    VIEW_FIELD_NUMBER: _ClassVar[int]
    camera_name: str
    view: _geometry_pb2.View
    def __init__(self, camera_name: _Optional[str] = ..., view: _Optional[_Union[_geometry_pb2.View, _Mapping]] = ...) -> None: ...

class MeasuredOdometry(_message.Message):
    __slots__ = ("pose", "translation_share", "rotation_share", "velocity_covariance")
    POSE_FIELD_NUMBER: _ClassVar[int]
    TRANSLATION_SHARE_FIELD_NUMBER: _ClassVar[int]
    ROTATION_SHARE_FIELD_NUMBER: _ClassVar[int]
    VELOCITY_COVARIANCE_FIELD_NUMBER: _ClassVar[int]
    pose: _geometry_pb2.Pose
    translation_share: float
    rotation_share: float
    velocity_covariance: _containers.RepeatedScalarFieldContainer[float]
    def __init__(self, pose: _Optional[_Union[_geometry_pb2.Pose, _Mapping]] = ..., translation_share: _Optional[float] = ..., rotation_share: _Optional[float] = ..., velocity_covariance: _Optional[_Iterable[float]] = ...) -> None: ...

class SetInitialPose(_message.Message):
    __slots__ = ("initial_pose",)
    INITIAL_POSE_FIELD_NUMBER: _ClassVar[int]
    initial_pose: InitialPose
    def __init__(self, initial_pose: _Optional[_Union[InitialPose, _Mapping]] = ...) -> None: ...

class Reset(_message.Message):
    __slots__ = ()
    def __init__(self) -> None: ...

class TrackResponse(_message.Message):
    __slots__ = ("started", "update", "refusal", "acknowledged", "resume_token")
    STARTED_FIELD_NUMBER: _ClassVar[int]
    UPDATE_FIELD_NUMBER: _ClassVar[int]
    REFUSAL_FIELD_NUMBER: _ClassVar[int]
    ACKNOWLEDGED_FIELD_NUMBER: _ClassVar[int]
    RESUME_TOKEN_FIELD_NUMBER: _ClassVar[int]
    started: TrackStarted
    update: TrackUpdate
    refusal: TrackRefusal
    acknowledged: TrackAcknowledged
    resume_token: bytes
    def __init__(self, started: _Optional[_Union[TrackStarted, _Mapping]] = ..., update: _Optional[_Union[TrackUpdate, _Mapping]] = ..., refusal: _Optional[_Union[TrackRefusal, _Mapping]] = ..., acknowledged: _Optional[_Union[TrackAcknowledged, _Mapping]] = ..., resume_token: _Optional[bytes] = ...) -> None: ...

class TrackStarted(_message.Message):
    __slots__ = ("adapter", "room", "frame_names", "keyframes", "calibration_rooms", "has_visual_odometry")
    ADAPTER_FIELD_NUMBER: _ClassVar[int]
    ROOM_FIELD_NUMBER: _ClassVar[int]
    FRAME_NAMES_FIELD_NUMBER: _ClassVar[int]
    KEYFRAMES_FIELD_NUMBER: _ClassVar[int]
    CALIBRATION_ROOMS_FIELD_NUMBER: _ClassVar[int]
    HAS_VISUAL_ODOMETRY_FIELD_NUMBER: _ClassVar[int]
    adapter: _geometry_pb2.Revision
    room: _geometry_pb2.Revision
    frame_names: FrameNames
    keyframes: KeyframePolicy
    calibration_rooms: int
    has_visual_odometry: bool
    def __init__(self, adapter: _Optional[_Union[_geometry_pb2.Revision, _Mapping]] = ..., room: _Optional[_Union[_geometry_pb2.Revision, _Mapping]] = ..., frame_names: _Optional[_Union[FrameNames, _Mapping]] = ..., keyframes: _Optional[_Union[KeyframePolicy, _Mapping]] = ..., calibration_rooms: _Optional[int] = ..., has_visual_odometry: _Optional[bool] = ...) -> None: ...

class TrackUpdate(_message.Message):
    __slots__ = ("timestamp_ns", "sequence_number", "status", "reason", "contradicted", "room", "camera", "base", "map_from_odom", "keyframe", "match", "hypothesis", "timing")
    TIMESTAMP_NS_FIELD_NUMBER: _ClassVar[int]
    SEQUENCE_NUMBER_FIELD_NUMBER: _ClassVar[int]
    STATUS_FIELD_NUMBER: _ClassVar[int]
    REASON_FIELD_NUMBER: _ClassVar[int]
    CONTRADICTED_FIELD_NUMBER: _ClassVar[int]
    ROOM_FIELD_NUMBER: _ClassVar[int]
    CAMERA_FIELD_NUMBER: _ClassVar[int]
    BASE_FIELD_NUMBER: _ClassVar[int]
    MAP_FROM_ODOM_FIELD_NUMBER: _ClassVar[int]
    KEYFRAME_FIELD_NUMBER: _ClassVar[int]
    MATCH_FIELD_NUMBER: _ClassVar[int]
    HYPOTHESIS_FIELD_NUMBER: _ClassVar[int]
    TIMING_FIELD_NUMBER: _ClassVar[int]
    timestamp_ns: int
    sequence_number: int
    status: TrackStatus
    reason: str
    contradicted: _containers.RepeatedScalarFieldContainer[TrackSensor]
    room: _geometry_pb2.Revision
    camera: TrackedBody
    base: TrackedBody
    map_from_odom: _geometry_pb2.Pose
    keyframe: KeyframeMotion
    match: TrackMatch
    hypothesis: PoseHypothesis
    timing: TrackTiming
    def __init__(self, timestamp_ns: _Optional[int] = ..., sequence_number: _Optional[int] = ..., status: _Optional[_Union[TrackStatus, str]] = ..., reason: _Optional[str] = ..., contradicted: _Optional[_Iterable[_Union[TrackSensor, str]]] = ..., room: _Optional[_Union[_geometry_pb2.Revision, _Mapping]] = ..., camera: _Optional[_Union[TrackedBody, _Mapping]] = ..., base: _Optional[_Union[TrackedBody, _Mapping]] = ..., map_from_odom: _Optional[_Union[_geometry_pb2.Pose, _Mapping]] = ..., keyframe: _Optional[_Union[KeyframeMotion, _Mapping]] = ..., match: _Optional[_Union[TrackMatch, _Mapping]] = ..., hypothesis: _Optional[_Union[PoseHypothesis, _Mapping]] = ..., timing: _Optional[_Union[TrackTiming, _Mapping]] = ...) -> None: ...

class TrackedBody(_message.Message):
    __slots__ = ("odom_pose", "map_pose", "velocity")
    ODOM_POSE_FIELD_NUMBER: _ClassVar[int]
    MAP_POSE_FIELD_NUMBER: _ClassVar[int]
    VELOCITY_FIELD_NUMBER: _ClassVar[int]
    odom_pose: _geometry_pb2.PoseWithCovariance
    map_pose: _geometry_pb2.PoseWithCovariance
    velocity: _geometry_pb2.TwistWithCovariance
    def __init__(self, odom_pose: _Optional[_Union[_geometry_pb2.PoseWithCovariance, _Mapping]] = ..., map_pose: _Optional[_Union[_geometry_pb2.PoseWithCovariance, _Mapping]] = ..., velocity: _Optional[_Union[_geometry_pb2.TwistWithCovariance, _Mapping]] = ...) -> None: ...

class KeyframeMotion(_message.Message):
    __slots__ = ("motion", "sequence_number", "is_new")
    MOTION_FIELD_NUMBER: _ClassVar[int]
    SEQUENCE_NUMBER_FIELD_NUMBER: _ClassVar[int]
    IS_NEW_FIELD_NUMBER: _ClassVar[int]
    motion: _geometry_pb2.TwistWithCovariance
    sequence_number: int
    is_new: bool
    def __init__(self, motion: _Optional[_Union[_geometry_pb2.TwistWithCovariance, _Mapping]] = ..., sequence_number: _Optional[int] = ..., is_new: _Optional[bool] = ...) -> None: ...

class TrackMatch(_message.Message):
    __slots__ = ("novelty", "frame", "used", "mahalanobis_squared", "camera_name")
    NOVELTY_FIELD_NUMBER: _ClassVar[int]
    FRAME_FIELD_NUMBER: _ClassVar[int]
    USED_FIELD_NUMBER: _ClassVar[int]
    MAHALANOBIS_SQUARED_FIELD_NUMBER: _ClassVar[int]
    CAMERA_NAME_FIELD_NUMBER: _ClassVar[int]
    novelty: float
    frame: _geometry_pb2.RetrievedFrame
    used: bool
    mahalanobis_squared: float
    camera_name: str
    def __init__(self, novelty: _Optional[float] = ..., frame: _Optional[_Union[_geometry_pb2.RetrievedFrame, _Mapping]] = ..., used: _Optional[bool] = ..., mahalanobis_squared: _Optional[float] = ..., camera_name: _Optional[str] = ...) -> None: ...

class PoseHypothesis(_message.Message):
    __slots__ = ("room", "map_from_camera", "sequence_number", "agreed", "needed")
    ROOM_FIELD_NUMBER: _ClassVar[int]
    MAP_FROM_CAMERA_FIELD_NUMBER: _ClassVar[int]
    SEQUENCE_NUMBER_FIELD_NUMBER: _ClassVar[int]
    AGREED_FIELD_NUMBER: _ClassVar[int]
    NEEDED_FIELD_NUMBER: _ClassVar[int]
    room: _geometry_pb2.Revision
    map_from_camera: _geometry_pb2.Pose
    sequence_number: int
    agreed: int
    needed: int
    def __init__(self, room: _Optional[_Union[_geometry_pb2.Revision, _Mapping]] = ..., map_from_camera: _Optional[_Union[_geometry_pb2.Pose, _Mapping]] = ..., sequence_number: _Optional[int] = ..., agreed: _Optional[int] = ..., needed: _Optional[int] = ...) -> None: ...

class TrackTiming(_message.Message):
    __slots__ = ("elapsed_ns",)
    ELAPSED_NS_FIELD_NUMBER: _ClassVar[int]
    elapsed_ns: int
    def __init__(self, elapsed_ns: _Optional[int] = ...) -> None: ...

class TrackRefusal(_message.Message):
    __slots__ = ("timestamp_ns", "sequence_number", "reason", "message", "frame_count")
    TIMESTAMP_NS_FIELD_NUMBER: _ClassVar[int]
    SEQUENCE_NUMBER_FIELD_NUMBER: _ClassVar[int]
    REASON_FIELD_NUMBER: _ClassVar[int]
    MESSAGE_FIELD_NUMBER: _ClassVar[int]
    FRAME_COUNT_FIELD_NUMBER: _ClassVar[int]
    timestamp_ns: int
    sequence_number: int
    reason: TrackRefusalReason
    message: str
    frame_count: int
    def __init__(self, timestamp_ns: _Optional[int] = ..., sequence_number: _Optional[int] = ..., reason: _Optional[_Union[TrackRefusalReason, str]] = ..., message: _Optional[str] = ..., frame_count: _Optional[int] = ...) -> None: ...

class TrackAcknowledged(_message.Message):
    __slots__ = ()
    def __init__(self) -> None: ...
