from seese3.v1 import geometry_pb2 as _geometry_pb2
from seese3.v1 import navigation_pb2 as _navigation_pb2
from google.protobuf.internal import containers as _containers
from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from collections.abc import Iterable as _Iterable, Mapping as _Mapping
from typing import ClassVar as _ClassVar, Optional as _Optional, Union as _Union

DESCRIPTOR: _descriptor.FileDescriptor

class EvaluateRequest(_message.Message):
    __slots__ = ("room", "room_revision", "adapter", "adapter_revision", "stride", "split", "navigators", "exclude_source", "exclude_radius", "thresholds", "seed", "steps", "step_mode")
    ROOM_FIELD_NUMBER: _ClassVar[int]
    ROOM_REVISION_FIELD_NUMBER: _ClassVar[int]
    ADAPTER_FIELD_NUMBER: _ClassVar[int]
    ADAPTER_REVISION_FIELD_NUMBER: _ClassVar[int]
    STRIDE_FIELD_NUMBER: _ClassVar[int]
    SPLIT_FIELD_NUMBER: _ClassVar[int]
    NAVIGATORS_FIELD_NUMBER: _ClassVar[int]
    EXCLUDE_SOURCE_FIELD_NUMBER: _ClassVar[int]
    EXCLUDE_RADIUS_FIELD_NUMBER: _ClassVar[int]
    THRESHOLDS_FIELD_NUMBER: _ClassVar[int]
    SEED_FIELD_NUMBER: _ClassVar[int]
    STEPS_FIELD_NUMBER: _ClassVar[int]
    STEP_MODE_FIELD_NUMBER: _ClassVar[int]
    room: str
    room_revision: int
    adapter: str
    adapter_revision: int
    stride: int
    split: _geometry_pb2.Split
    navigators: _containers.RepeatedScalarFieldContainer[str]
    exclude_source: bool
    exclude_radius: int
    thresholds: _containers.RepeatedScalarFieldContainer[float]
    seed: int
    steps: int
    step_mode: _navigation_pb2.StepMode
    def __init__(self, room: _Optional[str] = ..., room_revision: _Optional[int] = ..., adapter: _Optional[str] = ..., adapter_revision: _Optional[int] = ..., stride: _Optional[int] = ..., split: _Optional[_Union[_geometry_pb2.Split, str]] = ..., navigators: _Optional[_Iterable[str]] = ..., exclude_source: _Optional[bool] = ..., exclude_radius: _Optional[int] = ..., thresholds: _Optional[_Iterable[float]] = ..., seed: _Optional[int] = ..., steps: _Optional[int] = ..., step_mode: _Optional[_Union[_navigation_pb2.StepMode, str]] = ...) -> None: ...

class EvaluateResponse(_message.Message):
    __slots__ = ("progress", "report")
    PROGRESS_FIELD_NUMBER: _ClassVar[int]
    REPORT_FIELD_NUMBER: _ClassVar[int]
    progress: EvaluationProgress
    report: EvaluationReport
    def __init__(self, progress: _Optional[_Union[EvaluationProgress, _Mapping]] = ..., report: _Optional[_Union[EvaluationReport, _Mapping]] = ...) -> None: ...

class EvaluationProgress(_message.Message):
    __slots__ = ("done", "total", "navigator")
    DONE_FIELD_NUMBER: _ClassVar[int]
    TOTAL_FIELD_NUMBER: _ClassVar[int]
    NAVIGATOR_FIELD_NUMBER: _ClassVar[int]
    done: int
    total: int
    navigator: str
    def __init__(self, done: _Optional[int] = ..., total: _Optional[int] = ..., navigator: _Optional[str] = ...) -> None: ...

class EvaluationReport(_message.Message):
    __slots__ = ("room", "adapter", "split", "stride", "pair_count", "candidate_count", "exclude_source", "exclude_radius", "seed", "in_room", "leaks", "navigators", "steps", "step_mode", "calibrated_here")
    ROOM_FIELD_NUMBER: _ClassVar[int]
    ADAPTER_FIELD_NUMBER: _ClassVar[int]
    SPLIT_FIELD_NUMBER: _ClassVar[int]
    STRIDE_FIELD_NUMBER: _ClassVar[int]
    PAIR_COUNT_FIELD_NUMBER: _ClassVar[int]
    CANDIDATE_COUNT_FIELD_NUMBER: _ClassVar[int]
    EXCLUDE_SOURCE_FIELD_NUMBER: _ClassVar[int]
    EXCLUDE_RADIUS_FIELD_NUMBER: _ClassVar[int]
    SEED_FIELD_NUMBER: _ClassVar[int]
    IN_ROOM_FIELD_NUMBER: _ClassVar[int]
    LEAKS_FIELD_NUMBER: _ClassVar[int]
    NAVIGATORS_FIELD_NUMBER: _ClassVar[int]
    STEPS_FIELD_NUMBER: _ClassVar[int]
    STEP_MODE_FIELD_NUMBER: _ClassVar[int]
    CALIBRATED_HERE_FIELD_NUMBER: _ClassVar[int]
    room: _geometry_pb2.Revision
    adapter: _geometry_pb2.Revision
    split: _geometry_pb2.Split
    stride: int
    pair_count: int
    candidate_count: int
    exclude_source: bool
    exclude_radius: int
    seed: int
    in_room: bool
    leaks: bool
    navigators: _containers.RepeatedCompositeFieldContainer[NavigatorScores]
    steps: int
    step_mode: _navigation_pb2.StepMode
    calibrated_here: bool
    def __init__(self, room: _Optional[_Union[_geometry_pb2.Revision, _Mapping]] = ..., adapter: _Optional[_Union[_geometry_pb2.Revision, _Mapping]] = ..., split: _Optional[_Union[_geometry_pb2.Split, str]] = ..., stride: _Optional[int] = ..., pair_count: _Optional[int] = ..., candidate_count: _Optional[int] = ..., exclude_source: _Optional[bool] = ..., exclude_radius: _Optional[int] = ..., seed: _Optional[int] = ..., in_room: _Optional[bool] = ..., leaks: _Optional[bool] = ..., navigators: _Optional[_Iterable[_Union[NavigatorScores, _Mapping]]] = ..., steps: _Optional[int] = ..., step_mode: _Optional[_Union[_navigation_pb2.StepMode, str]] = ..., calibrated_here: _Optional[bool] = ...) -> None: ...

class NavigatorScores(_message.Message):
    __slots__ = ("name", "pair_count", "latent_mse", "latent_r2", "top1", "hit_rates", "translation_m_median", "rotation_rad_median", "recalls", "leaks")
    NAME_FIELD_NUMBER: _ClassVar[int]
    PAIR_COUNT_FIELD_NUMBER: _ClassVar[int]
    LATENT_MSE_FIELD_NUMBER: _ClassVar[int]
    LATENT_R2_FIELD_NUMBER: _ClassVar[int]
    TOP1_FIELD_NUMBER: _ClassVar[int]
    HIT_RATES_FIELD_NUMBER: _ClassVar[int]
    TRANSLATION_M_MEDIAN_FIELD_NUMBER: _ClassVar[int]
    ROTATION_RAD_MEDIAN_FIELD_NUMBER: _ClassVar[int]
    RECALLS_FIELD_NUMBER: _ClassVar[int]
    LEAKS_FIELD_NUMBER: _ClassVar[int]
    name: str
    pair_count: int
    latent_mse: float
    latent_r2: float
    top1: Proportion
    hit_rates: _containers.RepeatedCompositeFieldContainer[HitRate]
    translation_m_median: float
    rotation_rad_median: float
    recalls: _containers.RepeatedCompositeFieldContainer[PoseRecall]
    leaks: bool
    def __init__(self, name: _Optional[str] = ..., pair_count: _Optional[int] = ..., latent_mse: _Optional[float] = ..., latent_r2: _Optional[float] = ..., top1: _Optional[_Union[Proportion, _Mapping]] = ..., hit_rates: _Optional[_Iterable[_Union[HitRate, _Mapping]]] = ..., translation_m_median: _Optional[float] = ..., rotation_rad_median: _Optional[float] = ..., recalls: _Optional[_Iterable[_Union[PoseRecall, _Mapping]]] = ..., leaks: _Optional[bool] = ...) -> None: ...

class Proportion(_message.Message):
    __slots__ = ("value", "low", "high")
    VALUE_FIELD_NUMBER: _ClassVar[int]
    LOW_FIELD_NUMBER: _ClassVar[int]
    HIGH_FIELD_NUMBER: _ClassVar[int]
    value: float
    low: float
    high: float
    def __init__(self, value: _Optional[float] = ..., low: _Optional[float] = ..., high: _Optional[float] = ...) -> None: ...

class HitRate(_message.Message):
    __slots__ = ("threshold", "proportion", "over_identity")
    THRESHOLD_FIELD_NUMBER: _ClassVar[int]
    PROPORTION_FIELD_NUMBER: _ClassVar[int]
    OVER_IDENTITY_FIELD_NUMBER: _ClassVar[int]
    threshold: float
    proportion: Proportion
    over_identity: ShareDifference
    def __init__(self, threshold: _Optional[float] = ..., proportion: _Optional[_Union[Proportion, _Mapping]] = ..., over_identity: _Optional[_Union[ShareDifference, _Mapping]] = ...) -> None: ...

class ShareDifference(_message.Message):
    __slots__ = ("value", "low", "high")
    VALUE_FIELD_NUMBER: _ClassVar[int]
    LOW_FIELD_NUMBER: _ClassVar[int]
    HIGH_FIELD_NUMBER: _ClassVar[int]
    value: float
    low: float
    high: float
    def __init__(self, value: _Optional[float] = ..., low: _Optional[float] = ..., high: _Optional[float] = ...) -> None: ...

class PoseRecall(_message.Message):
    __slots__ = ("translation_m", "rotation_rad", "proportion")
    TRANSLATION_M_FIELD_NUMBER: _ClassVar[int]
    ROTATION_RAD_FIELD_NUMBER: _ClassVar[int]
    PROPORTION_FIELD_NUMBER: _ClassVar[int]
    translation_m: float
    rotation_rad: float
    proportion: Proportion
    def __init__(self, translation_m: _Optional[float] = ..., rotation_rad: _Optional[float] = ..., proportion: _Optional[_Union[Proportion, _Mapping]] = ...) -> None: ...

class ListPairsRequest(_message.Message):
    __slots__ = ("room", "room_revision", "adapter", "adapter_revision", "split", "stride")
    ROOM_FIELD_NUMBER: _ClassVar[int]
    ROOM_REVISION_FIELD_NUMBER: _ClassVar[int]
    ADAPTER_FIELD_NUMBER: _ClassVar[int]
    ADAPTER_REVISION_FIELD_NUMBER: _ClassVar[int]
    SPLIT_FIELD_NUMBER: _ClassVar[int]
    STRIDE_FIELD_NUMBER: _ClassVar[int]
    room: str
    room_revision: int
    adapter: str
    adapter_revision: int
    split: _geometry_pb2.Split
    stride: int
    def __init__(self, room: _Optional[str] = ..., room_revision: _Optional[int] = ..., adapter: _Optional[str] = ..., adapter_revision: _Optional[int] = ..., split: _Optional[_Union[_geometry_pb2.Split, str]] = ..., stride: _Optional[int] = ...) -> None: ...

class FramePair(_message.Message):
    __slots__ = ("source_frame_id", "target_frame_id")
    SOURCE_FRAME_ID_FIELD_NUMBER: _ClassVar[int]
    TARGET_FRAME_ID_FIELD_NUMBER: _ClassVar[int]
    source_frame_id: int
    target_frame_id: int
    def __init__(self, source_frame_id: _Optional[int] = ..., target_frame_id: _Optional[int] = ...) -> None: ...

class ListPairsResponse(_message.Message):
    __slots__ = ("room", "split", "stride", "test_pairs", "training_pairs", "candidate_frame_ids")
    ROOM_FIELD_NUMBER: _ClassVar[int]
    SPLIT_FIELD_NUMBER: _ClassVar[int]
    STRIDE_FIELD_NUMBER: _ClassVar[int]
    TEST_PAIRS_FIELD_NUMBER: _ClassVar[int]
    TRAINING_PAIRS_FIELD_NUMBER: _ClassVar[int]
    CANDIDATE_FRAME_IDS_FIELD_NUMBER: _ClassVar[int]
    room: _geometry_pb2.Revision
    split: _geometry_pb2.Split
    stride: int
    test_pairs: _containers.RepeatedCompositeFieldContainer[FramePair]
    training_pairs: _containers.RepeatedCompositeFieldContainer[FramePair]
    candidate_frame_ids: _containers.RepeatedScalarFieldContainer[int]
    def __init__(self, room: _Optional[_Union[_geometry_pb2.Revision, _Mapping]] = ..., split: _Optional[_Union[_geometry_pb2.Split, str]] = ..., stride: _Optional[int] = ..., test_pairs: _Optional[_Iterable[_Union[FramePair, _Mapping]]] = ..., training_pairs: _Optional[_Iterable[_Union[FramePair, _Mapping]]] = ..., candidate_frame_ids: _Optional[_Iterable[int]] = ...) -> None: ...

class ScorePredictionsRequest(_message.Message):
    __slots__ = ("room", "room_revision", "adapter", "adapter_revision", "predictions", "split", "exclude_source", "exclude_radius", "thresholds")
    ROOM_FIELD_NUMBER: _ClassVar[int]
    ROOM_REVISION_FIELD_NUMBER: _ClassVar[int]
    ADAPTER_FIELD_NUMBER: _ClassVar[int]
    ADAPTER_REVISION_FIELD_NUMBER: _ClassVar[int]
    PREDICTIONS_FIELD_NUMBER: _ClassVar[int]
    SPLIT_FIELD_NUMBER: _ClassVar[int]
    EXCLUDE_SOURCE_FIELD_NUMBER: _ClassVar[int]
    EXCLUDE_RADIUS_FIELD_NUMBER: _ClassVar[int]
    THRESHOLDS_FIELD_NUMBER: _ClassVar[int]
    room: str
    room_revision: int
    adapter: str
    adapter_revision: int
    predictions: _containers.RepeatedCompositeFieldContainer[Prediction]
    split: _geometry_pb2.Split
    exclude_source: bool
    exclude_radius: int
    thresholds: _containers.RepeatedScalarFieldContainer[float]
    def __init__(self, room: _Optional[str] = ..., room_revision: _Optional[int] = ..., adapter: _Optional[str] = ..., adapter_revision: _Optional[int] = ..., predictions: _Optional[_Iterable[_Union[Prediction, _Mapping]]] = ..., split: _Optional[_Union[_geometry_pb2.Split, str]] = ..., exclude_source: _Optional[bool] = ..., exclude_radius: _Optional[int] = ..., thresholds: _Optional[_Iterable[float]] = ...) -> None: ...

class Prediction(_message.Message):
    __slots__ = ("source_frame_id", "target_frame_id", "latent", "retrieved_frame_id", "last_step_frame_id")
    SOURCE_FRAME_ID_FIELD_NUMBER: _ClassVar[int]
    TARGET_FRAME_ID_FIELD_NUMBER: _ClassVar[int]
    LATENT_FIELD_NUMBER: _ClassVar[int]
    RETRIEVED_FRAME_ID_FIELD_NUMBER: _ClassVar[int]
    LAST_STEP_FRAME_ID_FIELD_NUMBER: _ClassVar[int]
    source_frame_id: int
    target_frame_id: int
    latent: _geometry_pb2.Latent
    retrieved_frame_id: int
    last_step_frame_id: int
    def __init__(self, source_frame_id: _Optional[int] = ..., target_frame_id: _Optional[int] = ..., latent: _Optional[_Union[_geometry_pb2.Latent, _Mapping]] = ..., retrieved_frame_id: _Optional[int] = ..., last_step_frame_id: _Optional[int] = ...) -> None: ...

class ScorePredictionsResponse(_message.Message):
    __slots__ = ("room", "adapter", "scores", "candidate_count", "leaks")
    ROOM_FIELD_NUMBER: _ClassVar[int]
    ADAPTER_FIELD_NUMBER: _ClassVar[int]
    SCORES_FIELD_NUMBER: _ClassVar[int]
    CANDIDATE_COUNT_FIELD_NUMBER: _ClassVar[int]
    LEAKS_FIELD_NUMBER: _ClassVar[int]
    room: _geometry_pb2.Revision
    adapter: _geometry_pb2.Revision
    scores: NavigatorScores
    candidate_count: int
    leaks: bool
    def __init__(self, room: _Optional[_Union[_geometry_pb2.Revision, _Mapping]] = ..., adapter: _Optional[_Union[_geometry_pb2.Revision, _Mapping]] = ..., scores: _Optional[_Union[NavigatorScores, _Mapping]] = ..., candidate_count: _Optional[int] = ..., leaks: _Optional[bool] = ...) -> None: ...
