"""Asks a SeeSE3 server where a camera is and how it moved, reads and writes its stores, and runs its program.

    with seese3.serve("store") as server, server.client() as client:
        answer = client.navigate("kitchen", 100, to=140, steps=4)
        print(answer.frame.id, answer.frame.pose)

Poses are (4, 4) matrices world_from_camera in metres, twists (6,) are (v, ω) in the body frame of the source camera,
and what is not known is None. `AsyncClient` has the same methods as coroutines.
"""

from .aio import AsyncClient, AsyncTrack
from .answers import (
    Camera,
    Evaluation,
    FeatureSource,
    Localization,
    Navigation,
    Relocalization,
    TrackRefusal,
    TrackUpdate,
    Way,
)
from .channel import Tls
from .client import Client, Track
from .errors import (
    BusyError,
    CommandError,
    ConflictError,
    DamagedError,
    DeadlineError,
    ForbiddenError,
    InvalidFieldError,
    NotFoundError,
    PreconditionError,
    RefusedError,
    SeeseError,
    UnavailableError,
)
from .program import Server, run, serve
from .requests import Gravity, InitialPose, Odometry, Prediction, Question, RigCamera, TrackConfig, Upload
from .store import Store, StoredAdapter, StoredRoom
from .views import Feature, Latent, View

__version__ = "0.1.0"

__all__ = [
    "AsyncClient",
    "AsyncTrack",
    "BusyError",
    "Camera",
    "Client",
    "CommandError",
    "ConflictError",
    "DamagedError",
    "DeadlineError",
    "Evaluation",
    "Feature",
    "FeatureSource",
    "ForbiddenError",
    "Gravity",
    "InitialPose",
    "InvalidFieldError",
    "Latent",
    "Localization",
    "Navigation",
    "NotFoundError",
    "Odometry",
    "PreconditionError",
    "Prediction",
    "Question",
    "RefusedError",
    "Relocalization",
    "RigCamera",
    "SeeseError",
    "Server",
    "Store",
    "StoredAdapter",
    "StoredRoom",
    "Tls",
    "Track",
    "TrackConfig",
    "TrackRefusal",
    "TrackUpdate",
    "UnavailableError",
    "Upload",
    "View",
    "Way",
    "run",
    "serve",
]
