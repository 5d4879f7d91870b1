from google.protobuf.internal import containers as _containers
from google.protobuf.internal import enum_type_wrapper as _enum_type_wrapper
from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from collections.abc import Iterable as _Iterable, Mapping as _Mapping
from typing import ClassVar as _ClassVar, Optional as _Optional, Union as _Union

DESCRIPTOR: _descriptor.FileDescriptor

class Split(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    SPLIT_UNSPECIFIED: _ClassVar[Split]
    SPLIT_TIME: _ClassVar[Split]
    SPLIT_FOLD_1: _ClassVar[Split]
    SPLIT_FOLD_2: _ClassVar[Split]
    SPLIT_FOLD_3: _ClassVar[Split]
    SPLIT_FOLD_4: _ClassVar[Split]
    SPLIT_FOLD_5: _ClassVar[Split]
    SPLIT_BLOCKS: _ClassVar[Split]
    SPLIT_PAIRS: _ClassVar[Split]
    SPLIT_DATASET: _ClassVar[Split]
    SPLIT_WHOLE: _ClassVar[Split]

class DistortionModel(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    DISTORTION_MODEL_UNSPECIFIED: _ClassVar[DistortionModel]
    DISTORTION_MODEL_BROWN_CONRADY: _ClassVar[DistortionModel]
    DISTORTION_MODEL_KANNALA_BRANDT: _ClassVar[DistortionModel]
SPLIT_UNSPECIFIED: Split
SPLIT_TIME: Split
SPLIT_FOLD_1: Split
SPLIT_FOLD_2: Split
SPLIT_FOLD_3: Split
SPLIT_FOLD_4: Split
SPLIT_FOLD_5: Split
SPLIT_BLOCKS: Split
SPLIT_PAIRS: Split
SPLIT_DATASET: Split
SPLIT_WHOLE: Split
DISTORTION_MODEL_UNSPECIFIED: DistortionModel
DISTORTION_MODEL_BROWN_CONRADY: DistortionModel
DISTORTION_MODEL_KANNALA_BRANDT: DistortionModel

class Vector3(_message.Message):
    __slots__ = ("x", "y", "z")
    X_FIELD_NUMBER: _ClassVar[int]
    Y_FIELD_NUMBER: _ClassVar[int]
    Z_FIELD_NUMBER: _ClassVar[int]
    x: float
    y: float
    z: float
    def __init__(self, x: _Optional[float] = ..., y: _Optional[float] = ..., z: _Optional[float] = ...) -> None: ...

class Quaternion(_message.Message):
    __slots__ = ("w", "x", "y", "z")
    W_FIELD_NUMBER: _ClassVar[int]
    X_FIELD_NUMBER: _ClassVar[int]
    Y_FIELD_NUMBER: _ClassVar[int]
    Z_FIELD_NUMBER: _ClassVar[int]
    w: float
    x: float
    y: float
    z: float
    def __init__(self, w: _Optional[float] = ..., x: _Optional[float] = ..., y: _Optional[float] = ..., z: _Optional[float] = ...) -> None: ...

class Pose(_message.Message):
    __slots__ = ("parent_frame", "child_frame", "position", "orientation")
    PARENT_FRAME_FIELD_NUMBER: _ClassVar[int]
    CHILD_FRAME_FIELD_NUMBER: _ClassVar[int]
    POSITION_FIELD_NUMBER: _ClassVar[int]
    ORIENTATION_FIELD_NUMBER: _ClassVar[int]
    parent_frame: str
    child_frame: str
    position: Vector3
    orientation: Quaternion
    def __init__(self, parent_frame: _Optional[str] = ..., child_frame: _Optional[str] = ..., position: _Optional[_Union[Vector3, _Mapping]] = ..., orientation: _Optional[_Union[Quaternion, _Mapping]] = ...) -> None: ...

class PoseWithCovariance(_message.Message):
    __slots__ = ("pose", "covariance")
    POSE_FIELD_NUMBER: _ClassVar[int]
    COVARIANCE_FIELD_NUMBER: _ClassVar[int]
    pose: Pose
    covariance: _containers.RepeatedScalarFieldContainer[float]
    def __init__(self, pose: _Optional[_Union[Pose, _Mapping]] = ..., covariance: _Optional[_Iterable[float]] = ...) -> None: ...

class TwistWithCovariance(_message.Message):
    __slots__ = ("twist", "covariance")
    TWIST_FIELD_NUMBER: _ClassVar[int]
    COVARIANCE_FIELD_NUMBER: _ClassVar[int]
    twist: Twist
    covariance: _containers.RepeatedScalarFieldContainer[float]
    def __init__(self, twist: _Optional[_Union[Twist, _Mapping]] = ..., covariance: _Optional[_Iterable[float]] = ...) -> None: ...

class Twist(_message.Message):
    __slots__ = ("linear", "angular")
    LINEAR_FIELD_NUMBER: _ClassVar[int]
    ANGULAR_FIELD_NUMBER: _ClassVar[int]
    linear: Vector3
    angular: Vector3
    def __init__(self, linear: _Optional[_Union[Vector3, _Mapping]] = ..., angular: _Optional[_Union[Vector3, _Mapping]] = ...) -> None: ...

class Feature(_message.Message):
    __slots__ = ("values", "feature_set")
    VALUES_FIELD_NUMBER: _ClassVar[int]
    FEATURE_SET_FIELD_NUMBER: _ClassVar[int]
    values: _containers.RepeatedScalarFieldContainer[float]
    feature_set: str
    def __init__(self, values: _Optional[_Iterable[float]] = ..., feature_set: _Optional[str] = ...) -> None: ...

class Latent(_message.Message):
    __slots__ = ("values", "adapter")
    VALUES_FIELD_NUMBER: _ClassVar[int]
    ADAPTER_FIELD_NUMBER: _ClassVar[int]
    values: _containers.RepeatedScalarFieldContainer[float]
    adapter: Revision
    def __init__(self, values: _Optional[_Iterable[float]] = ..., adapter: _Optional[_Union[Revision, _Mapping]] = ...) -> None: ...

class View(_message.Message):
    __slots__ = ("frame_id", "feature", "latent", "image")
    FRAME_ID_FIELD_NUMBER: _ClassVar[int]
    FEATURE_FIELD_NUMBER: _ClassVar[int]
    LATENT_FIELD_NUMBER: _ClassVar[int]
    IMAGE_FIELD_NUMBER: _ClassVar[int]
    frame_id: int
    feature: Feature
    latent: Latent
    image: bytes
    def __init__(self, frame_id: _Optional[int] = ..., feature: _Optional[_Union[Feature, _Mapping]] = ..., latent: _Optional[_Union[Latent, _Mapping]] = ..., image: _Optional[bytes] = ...) -> None: ...

class Revision(_message.Message):
    __slots__ = ("name", "revision")
    NAME_FIELD_NUMBER: _ClassVar[int]
    REVISION_FIELD_NUMBER: _ClassVar[int]
    name: str
    revision: int
    def __init__(self, name: _Optional[str] = ..., revision: _Optional[int] = ...) -> None: ...

class RetrievedFrame(_message.Message):
    __slots__ = ("frame_id", "distance", "pose", "frame_name", "timestamp_ns")
    FRAME_ID_FIELD_NUMBER: _ClassVar[int]
    DISTANCE_FIELD_NUMBER: _ClassVar[int]
    POSE_FIELD_NUMBER: _ClassVar[int]
    FRAME_NAME_FIELD_NUMBER: _ClassVar[int]
    TIMESTAMP_NS_FIELD_NUMBER: _ClassVar[int]
    frame_id: int
    distance: float
    pose: Pose
    frame_name: str
    timestamp_ns: int
    def __init__(self, frame_id: _Optional[int] = ..., distance: _Optional[float] = ..., pose: _Optional[_Union[Pose, _Mapping]] = ..., frame_name: _Optional[str] = ..., timestamp_ns: _Optional[int] = ...) -> None: ...

class PoseError(_message.Message):
    __slots__ = ("translation_m", "rotation_rad", "twist_norm")
    TRANSLATION_M_FIELD_NUMBER: _ClassVar[int]
    ROTATION_RAD_FIELD_NUMBER: _ClassVar[int]
    TWIST_NORM_FIELD_NUMBER: _ClassVar[int]
    translation_m: float
    rotation_rad: float
    twist_norm: float
    def __init__(self, translation_m: _Optional[float] = ..., rotation_rad: _Optional[float] = ..., twist_norm: _Optional[float] = ...) -> None: ...

class CameraIntrinsics(_message.Message):
    __slots__ = ("width", "height", "fx", "fy", "cx", "cy", "distortion_model", "distortion")
    WIDTH_FIELD_NUMBER: _ClassVar[int]
    HEIGHT_FIELD_NUMBER: _ClassVar[int]
    FX_FIELD_NUMBER: _ClassVar[int]
    FY_FIELD_NUMBER: _ClassVar[int]
    CX_FIELD_NUMBER: _ClassVar[int]
    CY_FIELD_NUMBER: _ClassVar[int]
    DISTORTION_MODEL_FIELD_NUMBER: _ClassVar[int]
    DISTORTION_FIELD_NUMBER: _ClassVar[int]
    width: float
    height: float
    fx: float
    fy: float
    cx: float
    cy: float
    distortion_model: DistortionModel
    distortion: _containers.RepeatedScalarFieldContainer[float]
    def __init__(self, width: _Optional[float] = ..., height: _Optional[float] = ..., fx: _Optional[float] = ..., fy: _Optional[float] = ..., cx: _Optional[float] = ..., cy: _Optional[float] = ..., distortion_model: _Optional[_Union[DistortionModel, str]] = ..., distortion: _Optional[_Iterable[float]] = ...) -> None: ...

class ViewCamera(_message.Message):
    __slots__ = ("intrinsics", "mapping_camera")
    INTRINSICS_FIELD_NUMBER: _ClassVar[int]
    MAPPING_CAMERA_FIELD_NUMBER: _ClassVar[int]
    intrinsics: CameraIntrinsics
    mapping_camera: MappingCamera
    def __init__(self, intrinsics: _Optional[_Union[CameraIntrinsics, _Mapping]] = ..., mapping_camera: _Optional[_Union[MappingCamera, _Mapping]] = ...) -> None: ...

class MappingCamera(_message.Message):
    __slots__ = ()
    def __init__(self) -> None: ...
