from google.rpc import status_pb2 as _status_pb2
from seese3.v1 import geometry_pb2 as _geometry_pb2
from google.protobuf.internal import containers as _containers
from google.protobuf.internal import enum_type_wrapper as _enum_type_wrapper
from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from collections.abc import Iterable as _Iterable, Mapping as _Mapping
from typing import ClassVar as _ClassVar, Optional as _Optional, Union as _Union

DESCRIPTOR: _descriptor.FileDescriptor

class StepMode(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    STEP_MODE_UNSPECIFIED: _ClassVar[StepMode]
    STEP_MODE_OPEN_LOOP: _ClassVar[StepMode]
    STEP_MODE_SNAP: _ClassVar[StepMode]
    STEP_MODE_CLOSED_LOOP: _ClassVar[StepMode]

class InverseVariant(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    INVERSE_VARIANT_UNSPECIFIED: _ClassVar[InverseVariant]
    INVERSE_VARIANT_AFFINE: _ClassVar[InverseVariant]
    INVERSE_VARIANT_HOMOGENEOUS: _ClassVar[InverseVariant]
    INVERSE_VARIANT_LITERAL: _ClassVar[InverseVariant]

class Planner(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    PLANNER_UNSPECIFIED: _ClassVar[Planner]
    PLANNER_POSE_GRAPH: _ClassVar[Planner]
    PLANNER_LATENT: _ClassVar[Planner]

class RouteOutcome(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    ROUTE_OUTCOME_UNSPECIFIED: _ClassVar[RouteOutcome]
    ROUTE_OUTCOME_FOUND: _ClassVar[RouteOutcome]
    ROUTE_OUTCOME_START_UNKNOWN: _ClassVar[RouteOutcome]
    ROUTE_OUTCOME_GOAL_NOT_MAPPED: _ClassVar[RouteOutcome]
    ROUTE_OUTCOME_NO_ROUTE: _ClassVar[RouteOutcome]
STEP_MODE_UNSPECIFIED: StepMode
STEP_MODE_OPEN_LOOP: StepMode
STEP_MODE_SNAP: StepMode
STEP_MODE_CLOSED_LOOP: StepMode
INVERSE_VARIANT_UNSPECIFIED: InverseVariant
INVERSE_VARIANT_AFFINE: InverseVariant
INVERSE_VARIANT_HOMOGENEOUS: InverseVariant
INVERSE_VARIANT_LITERAL: InverseVariant
PLANNER_UNSPECIFIED: Planner
PLANNER_POSE_GRAPH: Planner
PLANNER_LATENT: Planner
ROUTE_OUTCOME_UNSPECIFIED: RouteOutcome
ROUTE_OUTCOME_FOUND: RouteOutcome
ROUTE_OUTCOME_START_UNKNOWN: RouteOutcome
ROUTE_OUTCOME_GOAL_NOT_MAPPED: RouteOutcome
ROUTE_OUTCOME_NO_ROUTE: RouteOutcome

class RequestedMotion(_message.Message):
    __slots__ = ("twist", "target_frame_id", "target_pose", "twists")
    TWIST_FIELD_NUMBER: _ClassVar[int]
    TARGET_FRAME_ID_FIELD_NUMBER: _ClassVar[int]
    TARGET_POSE_FIELD_NUMBER: _ClassVar[int]
    TWISTS_FIELD_NUMBER: _ClassVar[int]
    twist: _geometry_pb2.Twist
    target_frame_id: int
    target_pose: _geometry_pb2.Pose
    twists: TwistList
    def __init__(self, twist: _Optional[_Union[_geometry_pb2.Twist, _Mapping]] = ..., target_frame_id: _Optional[int] = ..., target_pose: _Optional[_Union[_geometry_pb2.Pose, _Mapping]] = ..., twists: _Optional[_Union[TwistList, _Mapping]] = ...) -> None: ...

class TwistList(_message.Message):
    __slots__ = ("twists",)
    TWISTS_FIELD_NUMBER: _ClassVar[int]
    twists: _containers.RepeatedCompositeFieldContainer[_geometry_pb2.Twist]
    def __init__(self, twists: _Optional[_Iterable[_Union[_geometry_pb2.Twist, _Mapping]]] = ...) -> None: ...

class NavigateRequest(_message.Message):
    __slots__ = ("room", "room_revision", "adapter", "adapter_revision", "source", "source_pose", "motion", "steps", "step_mode", "inverse_variant", "top_k", "exclude_source", "exclude_radius", "navigator")
    ROOM_FIELD_NUMBER: _ClassVar[int]
    ROOM_REVISION_FIELD_NUMBER: _ClassVar[int]
    ADAPTER_FIELD_NUMBER: _ClassVar[int]
    ADAPTER_REVISION_FIELD_NUMBER: _ClassVar[int]
    SOURCE_FIELD_NUMBER: _ClassVar[int]
    SOURCE_POSE_FIELD_NUMBER: _ClassVar[int]
    MOTION_FIELD_NUMBER: _ClassVar[int]
    STEPS_FIELD_NUMBER: _ClassVar[int]
    STEP_MODE_FIELD_NUMBER: _ClassVar[int]
    INVERSE_VARIANT_FIELD_NUMBER: _ClassVar[int]
    TOP_K_FIELD_NUMBER: _ClassVar[int]
    EXCLUDE_SOURCE_FIELD_NUMBER: _ClassVar[int]
    EXCLUDE_RADIUS_FIELD_NUMBER: _ClassVar[int]
    NAVIGATOR_FIELD_NUMBER: _ClassVar[int]
    room: str
    room_revision: int
    adapter: str
    adapter_revision: int
    source: _geometry_pb2.View
    source_pose: _geometry_pb2.Pose
    motion: RequestedMotion
    steps: int
    step_mode: StepMode
    inverse_variant: InverseVariant
    top_k: int
    exclude_source: bool
    exclude_radius: int
    navigator: str
    def __init__(self, room: _Optional[str] = ..., room_revision: _Optional[int] = ..., adapter: _Optional[str] = ..., adapter_revision: _Optional[int] = ..., source: _Optional[_Union[_geometry_pb2.View, _Mapping]] = ..., source_pose: _Optional[_Union[_geometry_pb2.Pose, _Mapping]] = ..., motion: _Optional[_Union[RequestedMotion, _Mapping]] = ..., steps: _Optional[int] = ..., step_mode: _Optional[_Union[StepMode, str]] = ..., inverse_variant: _Optional[_Union[InverseVariant, str]] = ..., top_k: _Optional[int] = ..., exclude_source: _Optional[bool] = ..., exclude_radius: _Optional[int] = ..., navigator: _Optional[str] = ...) -> None: ...

class NavigateResponse(_message.Message):
    __slots__ = ("room", "adapter", "steps", "step_mode", "inverse_variant", "motion", "exact", "navigator", "index")
    ROOM_FIELD_NUMBER: _ClassVar[int]
    ADAPTER_FIELD_NUMBER: _ClassVar[int]
    STEPS_FIELD_NUMBER: _ClassVar[int]
    STEP_MODE_FIELD_NUMBER: _ClassVar[int]
    INVERSE_VARIANT_FIELD_NUMBER: _ClassVar[int]
    MOTION_FIELD_NUMBER: _ClassVar[int]
    EXACT_FIELD_NUMBER: _ClassVar[int]
    NAVIGATOR_FIELD_NUMBER: _ClassVar[int]
    INDEX_FIELD_NUMBER: _ClassVar[int]
    room: _geometry_pb2.Revision
    adapter: _geometry_pb2.Revision
    steps: _containers.RepeatedCompositeFieldContainer[NavigationStep]
    step_mode: StepMode
    inverse_variant: InverseVariant
    motion: _geometry_pb2.Twist
    exact: bool
    navigator: str
    index: str
    def __init__(self, room: _Optional[_Union[_geometry_pb2.Revision, _Mapping]] = ..., adapter: _Optional[_Union[_geometry_pb2.Revision, _Mapping]] = ..., steps: _Optional[_Iterable[_Union[NavigationStep, _Mapping]]] = ..., step_mode: _Optional[_Union[StepMode, str]] = ..., inverse_variant: _Optional[_Union[InverseVariant, str]] = ..., motion: _Optional[_Union[_geometry_pb2.Twist, _Mapping]] = ..., exact: _Optional[bool] = ..., navigator: _Optional[str] = ..., index: _Optional[str] = ...) -> None: ...

class NavigationStep(_message.Message):
    __slots__ = ("step", "frames", "requested_pose", "error", "latent")
    STEP_FIELD_NUMBER: _ClassVar[int]
    FRAMES_FIELD_NUMBER: _ClassVar[int]
    REQUESTED_POSE_FIELD_NUMBER: _ClassVar[int]
    ERROR_FIELD_NUMBER: _ClassVar[int]
    LATENT_FIELD_NUMBER: _ClassVar[int]
    step: int
    frames: _containers.RepeatedCompositeFieldContainer[_geometry_pb2.RetrievedFrame]
    requested_pose: _geometry_pb2.Pose
    error: _geometry_pb2.PoseError
    latent: _geometry_pb2.Latent
    def __init__(self, step: _Optional[int] = ..., frames: _Optional[_Iterable[_Union[_geometry_pb2.RetrievedFrame, _Mapping]]] = ..., requested_pose: _Optional[_Union[_geometry_pb2.Pose, _Mapping]] = ..., error: _Optional[_Union[_geometry_pb2.PoseError, _Mapping]] = ..., latent: _Optional[_Union[_geometry_pb2.Latent, _Mapping]] = ...) -> None: ...

class BatchNavigateRequest(_message.Message):
    __slots__ = ("requests",)
    REQUESTS_FIELD_NUMBER: _ClassVar[int]
    requests: _containers.RepeatedCompositeFieldContainer[NavigateRequest]
    def __init__(self, requests: _Optional[_Iterable[_Union[NavigateRequest, _Mapping]]] = ...) -> None: ...

class BatchNavigateResponse(_message.Message):
    __slots__ = ("results",)
    RESULTS_FIELD_NUMBER: _ClassVar[int]
    results: _containers.RepeatedCompositeFieldContainer[BatchNavigateResult]
    def __init__(self, results: _Optional[_Iterable[_Union[BatchNavigateResult, _Mapping]]] = ...) -> None: ...

class BatchNavigateResult(_message.Message):
    __slots__ = ("response", "error")
    RESPONSE_FIELD_NUMBER: _ClassVar[int]
    ERROR_FIELD_NUMBER: _ClassVar[int]
    response: NavigateResponse
    error: _status_pb2.Status
    def __init__(self, response: _Optional[_Union[NavigateResponse, _Mapping]] = ..., error: _Optional[_Union[_status_pb2.Status, _Mapping]] = ...) -> None: ...

class PlanRouteRequest(_message.Message):
    __slots__ = ("room", "room_revision", "adapter", "adapter_revision", "source", "source_pose", "camera", "goal_frame_id", "goal_pose", "max_hop_length", "tolerance_m", "tolerance_rad", "max_hops", "max_recoveries", "planner", "min_arrival_probability")
    ROOM_FIELD_NUMBER: _ClassVar[int]
    ROOM_REVISION_FIELD_NUMBER: _ClassVar[int]
    ADAPTER_FIELD_NUMBER: _ClassVar[int]
    ADAPTER_REVISION_FIELD_NUMBER: _ClassVar[int]
    SOURCE_FIELD_NUMBER: _ClassVar[int]
    SOURCE_POSE_FIELD_NUMBER: _ClassVar[int]
    CAMERA_FIELD_NUMBER: _ClassVar[int]
    GOAL_FRAME_ID_FIELD_NUMBER: _ClassVar[int]
    GOAL_POSE_FIELD_NUMBER: _ClassVar[int]
    MAX_HOP_LENGTH_FIELD_NUMBER: _ClassVar[int]
    TOLERANCE_M_FIELD_NUMBER: _ClassVar[int]
    TOLERANCE_RAD_FIELD_NUMBER: _ClassVar[int]
    MAX_HOPS_FIELD_NUMBER: _ClassVar[int]
    MAX_RECOVERIES_FIELD_NUMBER: _ClassVar[int]
    PLANNER_FIELD_NUMBER: _ClassVar[int]
    MIN_ARRIVAL_PROBABILITY_FIELD_NUMBER: _ClassVar[int]
    room: str
    room_revision: int
    adapter: str
    adapter_revision: int
    source: _geometry_pb2.View
    source_pose: _geometry_pb2.Pose
    camera: _geometry_pb2.ViewCamera
    goal_frame_id: int
    goal_pose: _geometry_pb2.Pose
    max_hop_length: float
    tolerance_m: float
    tolerance_rad: float
    max_hops: int
    max_recoveries: int
    planner: Planner
    min_arrival_probability: float
    def __init__(self, room: _Optional[str] = ..., room_revision: _Optional[int] = ..., adapter: _Optional[str] = ..., adapter_revision: _Optional[int] = ..., source: _Optional[_Union[_geometry_pb2.View, _Mapping]] = ..., source_pose: _Optional[_Union[_geometry_pb2.Pose, _Mapping]] = ..., camera: _Optional[_Union[_geometry_pb2.ViewCamera, _Mapping]] = ..., goal_frame_id: _Optional[int] = ..., goal_pose: _Optional[_Union[_geometry_pb2.Pose, _Mapping]] = ..., max_hop_length: _Optional[float] = ..., tolerance_m: _Optional[float] = ..., tolerance_rad: _Optional[float] = ..., max_hops: _Optional[int] = ..., max_recoveries: _Optional[int] = ..., planner: _Optional[_Union[Planner, str]] = ..., min_arrival_probability: _Optional[float] = ...) -> None: ...

class Route(_message.Message):
    __slots__ = ("outcome", "message", "start", "hops", "needed_hop_length", "arrival_probability", "room", "adapter", "planning_time_ns")
    OUTCOME_FIELD_NUMBER: _ClassVar[int]
    MESSAGE_FIELD_NUMBER: _ClassVar[int]
    START_FIELD_NUMBER: _ClassVar[int]
    HOPS_FIELD_NUMBER: _ClassVar[int]
    NEEDED_HOP_LENGTH_FIELD_NUMBER: _ClassVar[int]
    ARRIVAL_PROBABILITY_FIELD_NUMBER: _ClassVar[int]
    ROOM_FIELD_NUMBER: _ClassVar[int]
    ADAPTER_FIELD_NUMBER: _ClassVar[int]
    PLANNING_TIME_NS_FIELD_NUMBER: _ClassVar[int]
    outcome: RouteOutcome
    message: str
    start: RouteStart
    hops: _containers.RepeatedCompositeFieldContainer[RouteHop]
    needed_hop_length: float
    arrival_probability: float
    room: _geometry_pb2.Revision
    adapter: _geometry_pb2.Revision
    planning_time_ns: int
    def __init__(self, outcome: _Optional[_Union[RouteOutcome, str]] = ..., message: _Optional[str] = ..., start: _Optional[_Union[RouteStart, _Mapping]] = ..., hops: _Optional[_Iterable[_Union[RouteHop, _Mapping]]] = ..., needed_hop_length: _Optional[float] = ..., arrival_probability: _Optional[float] = ..., room: _Optional[_Union[_geometry_pb2.Revision, _Mapping]] = ..., adapter: _Optional[_Union[_geometry_pb2.Revision, _Mapping]] = ..., planning_time_ns: _Optional[int] = ...) -> None: ...

class RouteStart(_message.Message):
    __slots__ = ("pose", "novelty", "distance_remaining_m", "rotation_remaining_rad")
    POSE_FIELD_NUMBER: _ClassVar[int]
    NOVELTY_FIELD_NUMBER: _ClassVar[int]
    DISTANCE_REMAINING_M_FIELD_NUMBER: _ClassVar[int]
    ROTATION_REMAINING_RAD_FIELD_NUMBER: _ClassVar[int]
    pose: _geometry_pb2.PoseWithCovariance
    novelty: float
    distance_remaining_m: float
    rotation_remaining_rad: float
    def __init__(self, pose: _Optional[_Union[_geometry_pb2.PoseWithCovariance, _Mapping]] = ..., novelty: _Optional[float] = ..., distance_remaining_m: _Optional[float] = ..., rotation_remaining_rad: _Optional[float] = ...) -> None: ...

class RouteHop(_message.Message):
    __slots__ = ("motion", "frame", "distance_remaining_m", "rotation_remaining_rad", "recoveries")
    MOTION_FIELD_NUMBER: _ClassVar[int]
    FRAME_FIELD_NUMBER: _ClassVar[int]
    DISTANCE_REMAINING_M_FIELD_NUMBER: _ClassVar[int]
    ROTATION_REMAINING_RAD_FIELD_NUMBER: _ClassVar[int]
    RECOVERIES_FIELD_NUMBER: _ClassVar[int]
    motion: _geometry_pb2.Twist
    frame: _geometry_pb2.RetrievedFrame
    distance_remaining_m: float
    rotation_remaining_rad: float
    recoveries: int
    def __init__(self, motion: _Optional[_Union[_geometry_pb2.Twist, _Mapping]] = ..., frame: _Optional[_Union[_geometry_pb2.RetrievedFrame, _Mapping]] = ..., distance_remaining_m: _Optional[float] = ..., rotation_remaining_rad: _Optional[float] = ..., recoveries: _Optional[int] = ...) -> None: ...
