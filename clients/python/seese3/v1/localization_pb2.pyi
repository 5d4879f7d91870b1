from google.rpc import status_pb2 as _status_pb2
from seese3.v1 import geometry_pb2 as _geometry_pb2
from google.protobuf.internal import containers as _containers
from google.protobuf.internal import enum_type_wrapper as _enum_type_wrapper
from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from collections.abc import Iterable as _Iterable, Mapping as _Mapping
from typing import ClassVar as _ClassVar, Optional as _Optional, Union as _Union

DESCRIPTOR: _descriptor.FileDescriptor

class LocalizationMethod(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    LOCALIZATION_METHOD_UNSPECIFIED: _ClassVar[LocalizationMethod]
    LOCALIZATION_METHOD_MATCHED_KEYPOINTS: _ClassVar[LocalizationMethod]
    LOCALIZATION_METHOD_FITTED_ADAPTER: _ClassVar[LocalizationMethod]
    LOCALIZATION_METHOD_SIMILAR_FRAMES: _ClassVar[LocalizationMethod]
    LOCALIZATION_METHOD_NEAREST_FRAME: _ClassVar[LocalizationMethod]
    LOCALIZATION_METHOD_RECORDED: _ClassVar[LocalizationMethod]

class RelativeEstimator(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    RELATIVE_ESTIMATOR_UNSPECIFIED: _ClassVar[RelativeEstimator]
    RELATIVE_ESTIMATOR_FITTED: _ClassVar[RelativeEstimator]
    RELATIVE_ESTIMATOR_ZERO_SHOT: _ClassVar[RelativeEstimator]
    RELATIVE_ESTIMATOR_NEAREST_FRAME: _ClassVar[RelativeEstimator]
LOCALIZATION_METHOD_UNSPECIFIED: LocalizationMethod
LOCALIZATION_METHOD_MATCHED_KEYPOINTS: LocalizationMethod
LOCALIZATION_METHOD_FITTED_ADAPTER: LocalizationMethod
LOCALIZATION_METHOD_SIMILAR_FRAMES: LocalizationMethod
LOCALIZATION_METHOD_NEAREST_FRAME: LocalizationMethod
LOCALIZATION_METHOD_RECORDED: LocalizationMethod
RELATIVE_ESTIMATOR_UNSPECIFIED: RelativeEstimator
RELATIVE_ESTIMATOR_FITTED: RelativeEstimator
RELATIVE_ESTIMATOR_ZERO_SHOT: RelativeEstimator
RELATIVE_ESTIMATOR_NEAREST_FRAME: RelativeEstimator

class LocalizeRequest(_message.Message):
    __slots__ = ("rooms", "room_revisions", "adapter", "adapter_revision", "view", "top_k", "camera")
    class RoomRevisionsEntry(_message.Message):
        __slots__ = ("key", "value")
        KEY_FIELD_NUMBER: _ClassVar[int]
        VALUE_FIELD_NUMBER: _ClassVar[int]
        key: str
        value: int
        def __init__(self, key: _Optional[str] = ..., value: _Optional[int] = ...) -> None: ...
    ROOMS_FIELD_NUMBER: _ClassVar[int]
    ROOM_REVISIONS_FIELD_NUMBER: _ClassVar[int]
    ADAPTER_FIELD_NUMBER: _ClassVar[int]
    ADAPTER_REVISION_FIELD_NUMBER: _ClassVar[int]
    VIEW_FIELD_NUMBER: _ClassVar[int]
    TOP_K_FIELD_NUMBER: _ClassVar[int]
    CAMERA_FIELD_NUMBER: _ClassVar[int]
    rooms: _containers.RepeatedScalarFieldContainer[str]
    room_revisions: _containers.ScalarMap[str, int]
    adapter: str
    adapter_revision: int
    view: _geometry_pb2.View
    top_k: int
    camera: _geometry_pb2.ViewCamera
    def __init__(self, rooms: _Optional[_Iterable[str]] = ..., room_revisions: _Optional[_Mapping[str, int]] = ..., adapter: _Optional[str] = ..., adapter_revision: _Optional[int] = ..., view: _Optional[_Union[_geometry_pb2.View, _Mapping]] = ..., top_k: _Optional[int] = ..., camera: _Optional[_Union[_geometry_pb2.ViewCamera, _Mapping]] = ...) -> None: ...

class LocalizeResponse(_message.Message):
    __slots__ = ("pose", "room", "novelty", "method", "reason", "matches", "fitted", "frames", "adapter", "room_count", "exact", "index")
    POSE_FIELD_NUMBER: _ClassVar[int]
    ROOM_FIELD_NUMBER: _ClassVar[int]
    NOVELTY_FIELD_NUMBER: _ClassVar[int]
    METHOD_FIELD_NUMBER: _ClassVar[int]
    REASON_FIELD_NUMBER: _ClassVar[int]
    MATCHES_FIELD_NUMBER: _ClassVar[int]
    FITTED_FIELD_NUMBER: _ClassVar[int]
    FRAMES_FIELD_NUMBER: _ClassVar[int]
    ADAPTER_FIELD_NUMBER: _ClassVar[int]
    ROOM_COUNT_FIELD_NUMBER: _ClassVar[int]
    EXACT_FIELD_NUMBER: _ClassVar[int]
    INDEX_FIELD_NUMBER: _ClassVar[int]
    pose: _geometry_pb2.PoseWithCovariance
    room: _geometry_pb2.Revision
    novelty: float
    method: LocalizationMethod
    reason: str
    matches: KeypointMatches
    fitted: FittedEstimate
    frames: _containers.RepeatedCompositeFieldContainer[SimilarFrame]
    adapter: _geometry_pb2.Revision
    room_count: int
    exact: bool
    index: str
    def __init__(self, pose: _Optional[_Union[_geometry_pb2.PoseWithCovariance, _Mapping]] = ..., room: _Optional[_Union[_geometry_pb2.Revision, _Mapping]] = ..., novelty: _Optional[float] = ..., method: _Optional[_Union[LocalizationMethod, str]] = ..., reason: _Optional[str] = ..., matches: _Optional[_Union[KeypointMatches, _Mapping]] = ..., fitted: _Optional[_Union[FittedEstimate, _Mapping]] = ..., frames: _Optional[_Iterable[_Union[SimilarFrame, _Mapping]]] = ..., adapter: _Optional[_Union[_geometry_pb2.Revision, _Mapping]] = ..., room_count: _Optional[int] = ..., exact: _Optional[bool] = ..., index: _Optional[str] = ...) -> None: ...

class BatchLocalizeRequest(_message.Message):
    __slots__ = ("requests",)
    REQUESTS_FIELD_NUMBER: _ClassVar[int]
    requests: _containers.RepeatedCompositeFieldContainer[LocalizeRequest]
    def __init__(self, requests: _Optional[_Iterable[_Union[LocalizeRequest, _Mapping]]] = ...) -> None: ...

class BatchLocalizeResponse(_message.Message):
    __slots__ = ("results",)
    RESULTS_FIELD_NUMBER: _ClassVar[int]
    results: _containers.RepeatedCompositeFieldContainer[BatchLocalizeResult]
    def __init__(self, results: _Optional[_Iterable[_Union[BatchLocalizeResult, _Mapping]]] = ...) -> None: ...

class BatchLocalizeResult(_message.Message):
    __slots__ = ("response", "error")
    RESPONSE_FIELD_NUMBER: _ClassVar[int]
    ERROR_FIELD_NUMBER: _ClassVar[int]
    response: LocalizeResponse
    error: _status_pb2.Status
    def __init__(self, response: _Optional[_Union[LocalizeResponse, _Mapping]] = ..., error: _Optional[_Union[_status_pb2.Status, _Mapping]] = ...) -> None: ...

class KeypointMatches(_message.Message):
    __slots__ = ("inliers", "keypoints", "frame_ids")
    INLIERS_FIELD_NUMBER: _ClassVar[int]
    KEYPOINTS_FIELD_NUMBER: _ClassVar[int]
    FRAME_IDS_FIELD_NUMBER: _ClassVar[int]
    inliers: int
    keypoints: int
    frame_ids: _containers.RepeatedScalarFieldContainer[int]
    def __init__(self, inliers: _Optional[int] = ..., keypoints: _Optional[int] = ..., frame_ids: _Optional[_Iterable[int]] = ...) -> None: ...

class FittedEstimate(_message.Message):
    __slots__ = ("frame_id", "distance", "translation_estimator", "translation_gain", "rotation_estimator", "rotation_gain", "adapter")
    FRAME_ID_FIELD_NUMBER: _ClassVar[int]
    DISTANCE_FIELD_NUMBER: _ClassVar[int]
    TRANSLATION_ESTIMATOR_FIELD_NUMBER: _ClassVar[int]
    TRANSLATION_GAIN_FIELD_NUMBER: _ClassVar[int]
    ROTATION_ESTIMATOR_FIELD_NUMBER: _ClassVar[int]
    ROTATION_GAIN_FIELD_NUMBER: _ClassVar[int]
    ADAPTER_FIELD_NUMBER: _ClassVar[int]
    frame_id: int
    distance: float
    translation_estimator: RelativeEstimator
    translation_gain: float
    rotation_estimator: RelativeEstimator
    rotation_gain: float
    adapter: _geometry_pb2.Revision
    def __init__(self, frame_id: _Optional[int] = ..., distance: _Optional[float] = ..., translation_estimator: _Optional[_Union[RelativeEstimator, str]] = ..., translation_gain: _Optional[float] = ..., rotation_estimator: _Optional[_Union[RelativeEstimator, str]] = ..., rotation_gain: _Optional[float] = ..., adapter: _Optional[_Union[_geometry_pb2.Revision, _Mapping]] = ...) -> None: ...

class SimilarFrame(_message.Message):
    __slots__ = ("room", "frame", "error")
    ROOM_FIELD_NUMBER: _ClassVar[int]
    FRAME_FIELD_NUMBER: _ClassVar[int]
    ERROR_FIELD_NUMBER: _ClassVar[int]
    room: _geometry_pb2.Revision
    frame: _geometry_pb2.RetrievedFrame
    error: _geometry_pb2.PoseError
    def __init__(self, room: _Optional[_Union[_geometry_pb2.Revision, _Mapping]] = ..., frame: _Optional[_Union[_geometry_pb2.RetrievedFrame, _Mapping]] = ..., error: _Optional[_Union[_geometry_pb2.PoseError, _Mapping]] = ...) -> None: ...

class RelocalizeRequest(_message.Message):
    __slots__ = ("rooms", "room_revisions", "adapter", "adapter_revision", "views", "max_rooms", "top_k", "camera")
    class RoomRevisionsEntry(_message.Message):
        __slots__ = ("key", "value")
        KEY_FIELD_NUMBER: _ClassVar[int]
        VALUE_FIELD_NUMBER: _ClassVar[int]
        key: str
        value: int
        def __init__(self, key: _Optional[str] = ..., value: _Optional[int] = ...) -> None: ...
    ROOMS_FIELD_NUMBER: _ClassVar[int]
    ROOM_REVISIONS_FIELD_NUMBER: _ClassVar[int]
    ADAPTER_FIELD_NUMBER: _ClassVar[int]
    ADAPTER_REVISION_FIELD_NUMBER: _ClassVar[int]
    VIEWS_FIELD_NUMBER: _ClassVar[int]
    MAX_ROOMS_FIELD_NUMBER: _ClassVar[int]
    TOP_K_FIELD_NUMBER: _ClassVar[int]
    CAMERA_FIELD_NUMBER: _ClassVar[int]
    rooms: _containers.RepeatedScalarFieldContainer[str]
    room_revisions: _containers.ScalarMap[str, int]
    adapter: str
    adapter_revision: int
    views: _containers.RepeatedCompositeFieldContainer[_geometry_pb2.View]
    max_rooms: int
    top_k: int
    camera: _geometry_pb2.ViewCamera
    def __init__(self, rooms: _Optional[_Iterable[str]] = ..., room_revisions: _Optional[_Mapping[str, int]] = ..., adapter: _Optional[str] = ..., adapter_revision: _Optional[int] = ..., views: _Optional[_Iterable[_Union[_geometry_pb2.View, _Mapping]]] = ..., max_rooms: _Optional[int] = ..., top_k: _Optional[int] = ..., camera: _Optional[_Union[_geometry_pb2.ViewCamera, _Mapping]] = ...) -> None: ...

class RelocalizeResponse(_message.Message):
    __slots__ = ("adapter", "rooms", "room_count", "margin", "ambiguous", "reason")
    ADAPTER_FIELD_NUMBER: _ClassVar[int]
    ROOMS_FIELD_NUMBER: _ClassVar[int]
    ROOM_COUNT_FIELD_NUMBER: _ClassVar[int]
    MARGIN_FIELD_NUMBER: _ClassVar[int]
    AMBIGUOUS_FIELD_NUMBER: _ClassVar[int]
    REASON_FIELD_NUMBER: _ClassVar[int]
    adapter: _geometry_pb2.Revision
    rooms: _containers.RepeatedCompositeFieldContainer[RoomMatch]
    room_count: int
    margin: float
    ambiguous: bool
    reason: str
    def __init__(self, adapter: _Optional[_Union[_geometry_pb2.Revision, _Mapping]] = ..., rooms: _Optional[_Iterable[_Union[RoomMatch, _Mapping]]] = ..., room_count: _Optional[int] = ..., margin: _Optional[float] = ..., ambiguous: _Optional[bool] = ..., reason: _Optional[str] = ...) -> None: ...

class RoomMatch(_message.Message):
    __slots__ = ("room", "pose", "novelty", "method", "matches", "fitted", "distance", "distance_ratio", "frames")
    ROOM_FIELD_NUMBER: _ClassVar[int]
    POSE_FIELD_NUMBER: _ClassVar[int]
    NOVELTY_FIELD_NUMBER: _ClassVar[int]
    METHOD_FIELD_NUMBER: _ClassVar[int]
    MATCHES_FIELD_NUMBER: _ClassVar[int]
    FITTED_FIELD_NUMBER: _ClassVar[int]
    DISTANCE_FIELD_NUMBER: _ClassVar[int]
    DISTANCE_RATIO_FIELD_NUMBER: _ClassVar[int]
    FRAMES_FIELD_NUMBER: _ClassVar[int]
    room: _geometry_pb2.Revision
    pose: _geometry_pb2.PoseWithCovariance
    novelty: float
    method: LocalizationMethod
    matches: KeypointMatches
    fitted: FittedEstimate
    distance: float
    distance_ratio: float
    frames: _containers.RepeatedCompositeFieldContainer[_geometry_pb2.RetrievedFrame]
    def __init__(self, room: _Optional[_Union[_geometry_pb2.Revision, _Mapping]] = ..., pose: _Optional[_Union[_geometry_pb2.PoseWithCovariance, _Mapping]] = ..., novelty: _Optional[float] = ..., method: _Optional[_Union[LocalizationMethod, str]] = ..., matches: _Optional[_Union[KeypointMatches, _Mapping]] = ..., fitted: _Optional[_Union[FittedEstimate, _Mapping]] = ..., distance: _Optional[float] = ..., distance_ratio: _Optional[float] = ..., frames: _Optional[_Iterable[_Union[_geometry_pb2.RetrievedFrame, _Mapping]]] = ...) -> None: ...
