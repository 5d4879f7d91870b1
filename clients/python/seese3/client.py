"""The client, made from aio.py by generate.py: change that file."""

from __future__ import annotations

import queue
import time
from collections import deque
from collections.abc import Iterable, Iterator, Callable, Mapping, Sequence
from types import TracebackType
from typing import Any, Literal

import grpc
import numpy.typing as npt

from . import answers, channel, errors, requests
from .answers import (
    Adapter,
    Camera,
    CatalogDefault,
    Evaluation,
    Publication,
    Room,
    TrackRefusal,
    TrackStart,
    TrackUpdate,
)
from .geometry import wire_pose
from .requests import (
    DepthImage,
    Gravity,
    InertialSamples,
    InitialPose,
    LocalizationQuery,
    NavigationQuery,
    Odometry,
    Prediction,
    TrackConfig,
    Upload,
)
from .v1 import catalog_pb2, evaluation_pb2, localization_pb2, navigation_pb2, odometry_pb2, stub
from .views import View, wire_view
from .words import InverseVariant, Planner, Split, StepMode, UploadMode, enum_value

# How often and how soon a cut tracking stream is opened again.
RESUMPTIONS = 5
FIRST_WAIT_S = 0.1
# Frames since the last token that are kept, to send them again when a stream is cut.
MOST_UNSAVED = 1_000
# Pages of a list; a server's page has up to 1,000 entries.
MOST_PAGES = 10_000


class Client:
    """A connection to a server.

    - `address`: HOST:PORT.
    - `token`: the bearer token of every call, if the server asks for one.
    - `tls`: certificates, if the server speaks TLS.
    - `deadline_s`: how long a call may take, seconds; None is for ever. Every method takes another one as `deadline_s`.
    - `retries`: how often a read is made again when the server does not answer or is busy, 0 to 4.

    Every method raises a `RefusedError` if the server refuses, see `errors`.
    """

    def __init__(
        self,
        address: str,
        *,
        token: str | None = None,
        tls: channel.Tls | None = None,
        deadline_s: float | None = 30.0,
        retries: int = 3,
    ) -> None:
        self.address = address
        self._is_closed = False
        self._deadline_s = deadline_s
        self._metadata = channel.metadata(token)
        self._channel = channel.open_sync(address, tls, retries)
        self._catalog = stub("CatalogService", self._channel)
        self._navigation = stub("NavigationService", self._channel)
        self._localization = stub("LocalizationService", self._channel)
        self._odometry = stub("OdometryService", self._channel)
        self._evaluation = stub("EvaluationService", self._channel)

    def __enter__(self) -> Client:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Closes the connection. Calls that are open are cut."""
        self._is_closed = True
        self._channel.close()

    def _timeout(self, deadline_s: float | None) -> float | None:
        return channel.timeout(self._deadline_s if deadline_s is None else deadline_s)

    def _ask(self, method: Any, request: Any, deadline_s: float | None) -> Any:
        self._check_open()
        try:
            answer = method(request, timeout=self._timeout(deadline_s), metadata=self._metadata)
        except grpc.RpcError as error:
            raise errors.refused(error) from None
        if answer is None:
            raise errors.AnswerError("the server answered without a message")
        return answer

    def _check_open(self) -> None:
        if self._is_closed:
            raise errors.SeeseError("the client is closed")

    def _listen(self, call: Any) -> Iterator[Any]:
        try:
            for message in call:
                yield message
        except grpc.RpcError as error:
            raise errors.refused(error) from None
        finally:
            call.cancel()

    # Navigation.

    def navigate(
        self,
        room: str,
        source: View,
        *,
        to: int | None = None,
        twist: npt.ArrayLike | None = None,
        pose: npt.ArrayLike | None = None,
        room_revision: int | None = None,
        adapter: str | None = None,
        adapter_revision: int | None = None,
        source_pose: npt.ArrayLike | None = None,
        steps: int | None = None,
        step_mode: StepMode | None = None,
        inverse_variant: InverseVariant | None = None,
        navigator: str | None = None,
        top_k: int | None = None,
        exclude_source: bool = False,
        exclude_radius: int = 0,
        deadline_s: float | None = None,
    ) -> answers.Navigation:
        """Imagines a motion from a view, and retrieves the stored frame that shows the view after it.

        Args:
            room: The room to navigate in.
            source: The view that the motion starts from.
            to: The frame at the end of the motion. Exactly one of `to`, `twist` and `pose` is required.
            twist: The motion (6,), or several motions (n, 6), in the body frame of the source camera.
            pose: The camera pose at the end of the motion, world_from_camera (4, 4).
            room_revision: The revision of the room; None for the current one.
            adapter: The adapter; None for the room's default.
            adapter_revision: The revision of `adapter`; None for the current one.
            source_pose: The camera pose of the source (4, 4), if it is known and the source is no stored frame.
            steps: The number of equal steps that each motion is divided into; None for 1.
            step_mode: How steps are chained: "open_loop" (the default), "snap" or "closed_loop".
            inverse_variant: "homogeneous" (the default), "affine" or "literal".
            navigator: A navigator by name, one of `Adapter.navigators`; None for inverse Poincaré.
            top_k: The number of frames to retrieve for each step; None for 1.
            exclude_source: Whether the frame that a step starts from may not be retrieved.
            exclude_radius: The number of rows before and after that frame that may not be retrieved either.
            deadline_s: Time limit of the call, seconds; None for that of the client.

        Returns:
            The retrieved frames of each step.

        Raises:
            RefusedError: The server refused the request; `field` names what to change.
            ValueError: An argument is not valid.

        Example:
            >>> client.navigate("kitchen", 100, to=140, steps=4).frame.id
        """
        query = NavigationQuery(
            source=source,
            to=to,
            twist=twist,
            pose=pose,
            source_pose=source_pose,
            steps=steps,
            step_mode=step_mode,
            inverse_variant=inverse_variant,
            navigator=navigator,
            top_k=top_k,
            exclude_source=exclude_source,
            exclude_radius=exclude_radius,
        )
        request = query.request(room, adapter, room_revision, adapter_revision)
        return answers.Navigation.of(self._ask(self._navigation.Navigate, request, deadline_s))

    def navigate_batch(
        self,
        room: str,
        queries: Sequence[NavigationQuery],
        *,
        room_revision: int | None = None,
        adapter: str | None = None,
        adapter_revision: int | None = None,
        deadline_s: float | None = None,
    ) -> list[answers.Navigation | errors.RefusedError]:
        """Answers many navigation queries in one call.

        Args:
            room: The room to navigate in.
            queries: The queries; the server's limit is `server_info().limits["batch"]`.
            room_revision: The revision of the room; None for the current one.
            adapter: The adapter; None for the room's default.
            adapter_revision: The revision of `adapter`; None for the current one.
            deadline_s: Time limit of the call, seconds; None for that of the client.

        Returns:
            One entry for each query, in order. A query that the server refuses has its exception in its place.

        Raises:
            RefusedError: The server refused the whole batch.
            ValueError: A query is not valid; the message names it.

        Example:
            >>> client.navigate_batch("kitchen", [NavigationQuery(frame, to=frame + 20) for frame in range(100)])
        """
        batch = []
        for number, query in enumerate(queries):
            try:
                batch.append(query.request(room, adapter, room_revision, adapter_revision))
            except (TypeError, ValueError) as error:
                raise type(error)(f"queries[{number}]: {error}") from None
        request = navigation_pb2.BatchNavigateRequest(requests=batch)
        answer = self._ask(self._navigation.BatchNavigate, request, deadline_s)
        return answers.batch_of(answers.Navigation, answer)

    def plan_route(
        self,
        room: str,
        source: View,
        *,
        goal: int | None = None,
        goal_pose: npt.ArrayLike | None = None,
        room_revision: int | None = None,
        adapter: str | None = None,
        adapter_revision: int | None = None,
        source_pose: npt.ArrayLike | None = None,
        camera: Camera | Literal["mapping"] | None = None,
        max_hop_length: float | None = None,
        tolerance_m: float | None = None,
        tolerance_rad: float | None = None,
        max_hops: int | None = None,
        max_recoveries: int | None = None,
        planner: Planner | None = None,
        min_arrival_probability: float | None = None,
        deadline_s: float | None = None,
    ) -> answers.Route:
        """Plans a route over stored frames to a goal. Nothing is driven, and obstacles are unknown.

        Args:
            room: The room.
            source: The view that the route starts from.
            goal: The frame whose pose is the goal. Exactly one of `goal` and `goal_pose` is required.
            goal_pose: The goal as a camera pose, world_from_camera (4, 4).
            room_revision: The revision of the room; None for the current one.
            adapter: The adapter; None for the room's default.
            adapter_revision: The revision of `adapter`; None for the current one.
            source_pose: The camera pose of the source (4, 4); None to estimate it, as `localize` does.
            camera: The camera of a source that is an image, or "mapping" for the one that mapped the room. With it,
                the start is estimated from matched keypoints if the room has any.
            max_hop_length: The maximum norm of a hop's motion, meters and radians mixed; None to let the server choose.
            tolerance_m: The distance tolerance of the goal, meters; None for 0.25.
            tolerance_rad: The angle tolerance of the goal, radians; None for 15 degrees.
            max_hops: The maximum number of hops; None for 100.
            max_recoveries: The maximum number of recoveries of the planner "latent"; None for 10.
            planner: "pose_graph" (the default) or "latent", the paper's.
            min_arrival_probability: The minimum arrival probability of a route, 0 to 1; None for 0.2.
            deadline_s: Time limit of the call, seconds; None for that of the client.

        Returns:
            The route. Check its `outcome`: only "found" has hops.

        Raises:
            RefusedError: The server refused the request; `field` names what to change.
            ValueError: An argument is not valid.

        Example:
            >>> route = client.plan_route("kitchen", 10, goal=400)
            >>> [hop.motion for hop in route.hops]
        """
        if (goal is None) == (goal_pose is None):
            raise ValueError("give exactly one of goal (a frame's row) and goal_pose")
        request = navigation_pb2.PlanRouteRequest(
            room=room,
            room_revision=room_revision,
            adapter=adapter,
            adapter_revision=adapter_revision,
            source=wire_view(source),
            source_pose=None if source_pose is None else wire_pose(source_pose),
            camera=requests.wire_view_camera(camera),
            goal_frame_id=requests.count(goal, "goal"),
            goal_pose=None if goal_pose is None else wire_pose(goal_pose),
            max_hop_length=max_hop_length,
            tolerance_m=tolerance_m,
            tolerance_rad=tolerance_rad,
            max_hops=requests.count(max_hops, "max_hops"),
            max_recoveries=requests.count(max_recoveries, "max_recoveries"),
            planner=enum_value(navigation_pb2.Planner, "PLANNER_", planner, "planner"),
            min_arrival_probability=min_arrival_probability,
        )
        return answers.Route.of(self._ask(self._navigation.PlanRoute, request, deadline_s))

    # Localization.

    def localize(
        self,
        view: View,
        *,
        rooms: Sequence[str] | str = (),
        room_revisions: Mapping[str, int] | None = None,
        adapter: str | None = None,
        adapter_revision: int | None = None,
        top_k: int | None = None,
        camera: Camera | Literal["mapping"] | None = None,
        deadline_s: float | None = None,
    ) -> answers.Localization:
        """Estimates the pose of the camera that took a view.

        Args:
            view: A feature, a latent or an image; a stored frame only if one room is named.
            rooms: The room or rooms to search; () for all.
            room_revisions: The revisions of rooms that are not the current ones.
            adapter: The adapter. None for the default of a single room, or the only one that serves all rooms; a room
                with keypoints needs none for an image.
            adapter_revision: The revision of `adapter`; None for the current one.
            top_k: The number of similar frames to return; None for 1.
            camera: The camera of an image, or "mapping" for the one that mapped the room. Required if the view is an
                image and a room has keypoints.
            deadline_s: Time limit of the call, seconds; None for that of the client.

        Returns:
            The pose with its covariance, how it was obtained, and similar frames. `pose` is None if the view is not
            in the map.

        Raises:
            RefusedError: The server refused the request; `field` names what to change.
            ValueError: An argument is not valid.

        Example:
            >>> found = client.localize("photo.jpg", rooms="kitchen")
            >>> found.pose, found.covariance, found.novelty
        """
        query = LocalizationQuery(view, rooms, room_revisions, adapter, adapter_revision, top_k, camera)
        return answers.Localization.of(self._ask(self._localization.Localize, query.request(), deadline_s))

    def localize_batch(
        self, queries: Sequence[LocalizationQuery], *, deadline_s: float | None = None
    ) -> list[answers.Localization | errors.RefusedError]:
        """Localizes many views in one call.

        Args:
            queries: The queries; the server's limit is `server_info().limits["batch"]`.
            deadline_s: Time limit of the call, seconds; None for that of the client.

        Returns:
            One entry for each query, in order. A query that the server refuses has its exception in its place.

        Raises:
            RefusedError: The server refused the whole batch.
            ValueError: A query is not valid; the message names it.

        Example:
            >>> client.localize_batch([LocalizationQuery(file, "kitchen", camera="mapping") for file in files])
        """
        batch = []
        for number, query in enumerate(queries):
            try:
                batch.append(query.request())
            except (TypeError, ValueError) as error:
                raise type(error)(f"queries[{number}]: {error}") from None
        request = localization_pb2.BatchLocalizeRequest(requests=batch)
        answer = self._ask(self._localization.BatchLocalize, request, deadline_s)
        return answers.batch_of(answers.Localization, answer)

    def relocalize(
        self,
        views: Sequence[View],
        *,
        rooms: Sequence[str] | str = (),
        room_revisions: Mapping[str, int] | None = None,
        adapter: str | None = None,
        adapter_revision: int | None = None,
        max_rooms: int | None = None,
        top_k: int | None = None,
        camera: Camera | Literal["mapping"] | None = None,
        deadline_s: float | None = None,
    ) -> answers.Relocalization:
        """Finds the room of a camera and its pose there.

        Args:
            views: Views of one camera that hardly moves between them, the newest last; no stored frames.
            rooms: The room or rooms to search; () for all.
            room_revisions: The revisions of rooms that are not the current ones.
            adapter: The adapter; None for the only calibrated one that serves the rooms. Images of rooms with
                keypoints need none.
            adapter_revision: The revision of `adapter`; None for the current one.
            max_rooms: The maximum number of rooms to return; None for 3.
            top_k: The number of frames to return for each room; None for 1.
            camera: The camera of the images, or "mapping" for the one that mapped the room. Required if the views are
                images and a room has keypoints.
            deadline_s: Time limit of the call, seconds; None for that of the client.

        Returns:
            The rooms, the best match first, and whether the best one is ambiguous.

        Raises:
            RefusedError: The server refused the request; `field` names what to change.
            TypeError: `views` is one view, and no sequence of views.

        Example:
            >>> found = client.relocalize(["a.jpg", "b.jpg"], camera="mapping")
            >>> found.rooms[0].room.name, found.ambiguous
        """
        request = localization_pb2.RelocalizeRequest(
            rooms=requests.names(rooms),
            room_revisions=room_revisions,
            adapter=adapter,
            adapter_revision=adapter_revision,
            views=requests.wire_views(views),
            max_rooms=requests.count(max_rooms, "max_rooms"),
            top_k=requests.count(top_k, "top_k"),
            camera=requests.wire_view_camera(camera),
        )
        return answers.Relocalization.of(self._ask(self._localization.Relocalize, request, deadline_s))

    # Odometry.

    def motion(
        self,
        first: View,
        second: View,
        *,
        room: str | None = None,
        room_revision: int | None = None,
        adapter: str | None = None,
        adapter_revision: int | None = None,
        camera: Camera | Literal["mapping"] | None = None,
        relational: bool = False,
        deadline_s: float | None = None,
    ) -> answers.Motion:
        """Estimates the motion from one view to another.

        Args:
            first: The view at the start of the motion.
            second: The view at the end of the motion.
            room: The room that stored frames belong to; its default adapter is used.
            room_revision: The revision of the room; None for the current one.
            adapter: The adapter; None for the default of the room, or the only adapter that is not fitted to a room.
                Two images of a known camera need none.
            adapter_revision: The revision of `adapter`; None for the current one.
            camera: The camera of both images, or "mapping" for the one that mapped `room`; None for that of the room,
                if it is known.
            relational: Whether to use the adapter's relational reader, which compares the cells of both feature maps
                and needs no camera.
            deadline_s: Time limit of the call, seconds; None for that of the client.

        Returns:
            The motion (6,), in the body frame of the first camera.

        Raises:
            RefusedError: The server refused the request; `field` names what to change.

        Example:
            >>> client.motion("a.jpg", "b.jpg", camera=Camera(640, 480, fx=585)).twist
        """
        request = odometry_pb2.EstimateMotionRequest(
            room=room,
            room_revision=room_revision,
            adapter=adapter,
            adapter_revision=adapter_revision,
            first=wire_view(first),
            second=wire_view(second),
            camera=requests.wire_view_camera(camera),
            estimator="MOTION_ESTIMATOR_RELATIONAL" if relational else None,
        )
        return answers.Motion.of(self._ask(self._odometry.EstimateMotion, request, deadline_s))

    def encode(
        self,
        views: Sequence[View],
        *,
        room: str | None = None,
        room_revision: int | None = None,
        adapter: str | None = None,
        adapter_revision: int | None = None,
        with_features: bool = False,
        deadline_s: float | None = None,
    ) -> answers.Encoding:
        """Converts views to latents of an adapter, which can be sent wherever a view is taken.

        Args:
            views: The views, 1 to 256.
            room: The room that stored frames belong to; its default adapter is used.
            room_revision: The revision of the room; None for the current one.
            adapter: The adapter; None for the default of the room, or the only adapter that is not fitted to a room.
            adapter_revision: The revision of `adapter`; None for the current one.
            with_features: Whether to return raw features too.
            deadline_s: Time limit of the call, seconds; None for that of the client.

        Returns:
            The latents (n, k), with the adapter that made them.

        Raises:
            RefusedError: The server refused the request; `field` names what to change.
            TypeError: `views` is one view, and no sequence of views.

        Example:
            >>> encoding = client.encode(["photo.jpg"], room="kitchen")
            >>> client.localize(encoding.latent(0), rooms="kitchen")
        """
        request = odometry_pb2.EncodeRequest(
            room=room,
            room_revision=room_revision,
            adapter=adapter,
            adapter_revision=adapter_revision,
            views=requests.wire_views(views),
            with_features=with_features,
        )
        return answers.Encoding.of(self._ask(self._odometry.Encode, request, deadline_s), with_features)

    def track(
        self,
        config: TrackConfig | None = None,
        *,
        resume_token: bytes = b"",
        last_sequence_number: int | None = None,
        deadline_s: float | None = None,
    ) -> Track:
        """Opens a stream that follows a camera: `with client.track(TrackConfig(room="kitchen")) as track`.

        Args:
            config: What the stream is to do.
            resume_token: The token of a stream of another program that goes on here, instead of `config`.
            last_sequence_number: The number of the last frame of that stream.
            deadline_s: Time limit of opening the stream, also again after it was cut; `step` has its own.

        Returns:
            The stream, to be used in `with`.

        Raises:
            ValueError: Not exactly one of `config` and `resume_token` is given.

        Example:
            >>> with client.track(TrackConfig(room="kitchen")) as track:
            ...     update = track.step("frame.jpg", timestamp_ns=0)
        """
        self._check_open()
        if (config is None) == (not resume_token):
            raise ValueError("give exactly one of config and resume_token")
        if bool(resume_token) != (last_sequence_number is not None):
            raise ValueError("resume_token and last_sequence_number belong together")
        message = config.message() if config else odometry_pb2.TrackConfig(resume_token=resume_token)
        return Track(
            self._odometry.Track, self._metadata, message, last_sequence_number or 0, self._timeout(deadline_s)
        )

    # Evaluation.

    def evaluate(
        self,
        room: str,
        *,
        room_revision: int | None = None,
        adapter: str | None = None,
        adapter_revision: int | None = None,
        stride: int | None = None,
        split: Split | None = None,
        navigators: Sequence[str] | str = (),
        exclude_source: bool = False,
        exclude_radius: int = 0,
        thresholds: Sequence[float] = (),
        seed: int = 0,
        steps: int | None = None,
        step_mode: StepMode | None = None,
        on_progress: Callable[[int, int], None] | None = None,
        deadline_s: float | None = None,
    ) -> Evaluation:
        """Scores navigators on a room's test pairs, beside the identity and a random frame.

        Args:
            room: The room.
            room_revision: The revision of the room; None for the current one.
            adapter: The adapter. None for one from which the test pairs were held out: the room's default, else the
                newest that was trained in the room. An adapter that is fitted to the room must be named, and leaks.
            adapter_revision: The revision of `adapter`; None for the current one.
            stride: The number of frames from source to target; None for that of the adapter's training.
            split: The split that defines the test pairs; None for that of the adapter's training.
            navigators: The navigators by name; () for the baselines and all navigators of the adapter.
            exclude_source: Whether the source frame of a pair may not be retrieved.
            exclude_radius: The number of rows before and after it that may not be retrieved either.
            thresholds: The thresholds ε of Hit@ε, meters and radians mixed; () for 0.1, 0.2, 0.3 and 0.5.
            seed: The seed of the navigator "random".
            steps: The number of equal steps that each motion is divided into; None for 1.
            step_mode: How steps are chained: "open_loop" (the default), "snap" or "closed_loop".
            on_progress: Called with the number of navigators that are done, and of all.
            deadline_s: Time limit of the call, seconds; None for no limit.

        Returns:
            The scores, with 95 % intervals.

        Raises:
            RefusedError: The server refused the request; `field` names what to change.

        Example:
            >>> print(client.evaluate("kitchen", exclude_source=True).table())
        """
        request = evaluation_pb2.EvaluateRequest(
            room=room,
            room_revision=room_revision,
            adapter=adapter,
            adapter_revision=adapter_revision,
            stride=requests.count(stride, "stride"),
            split=requests.split_value(split),
            navigators=requests.names(navigators),
            exclude_source=exclude_source,
            exclude_radius=requests.count(exclude_radius, "exclude_radius"),
            thresholds=thresholds,
            seed=seed,
            steps=requests.count(steps, "steps"),
            step_mode=requests.step_mode(step_mode),
        )
        self._check_open()
        call = self._evaluation.Evaluate(request, timeout=channel.timeout(deadline_s), metadata=self._metadata)
        for message in self._listen(call):
            if message.HasField("report"):
                report = Evaluation.of(message.report)
                if on_progress is not None:
                    on_progress(len(report.navigators), len(report.navigators))
                return report
            if on_progress is not None:
                on_progress(message.progress.done, message.progress.total)
        raise errors.SeeseError("the server ended an evaluation without a report")

    def split_pairs(
        self,
        room: str,
        split: Split | None = None,
        stride: int | None = None,
        *,
        room_revision: int | None = None,
        adapter: str | None = None,
        adapter_revision: int | None = None,
        deadline_s: float | None = None,
    ) -> answers.SplitPairs:
        """The test pairs, the training pairs and the candidate frames of a split, for a navigator of one's own.

        Args:
            room: The room.
            split: The split; None for that of `evaluate` with this adapter.
            stride: The number of frames from source to target; None for that of `evaluate` with this adapter.
            room_revision: The revision of the room; None for the current one.
            adapter: The adapter that decides an absent split or stride; None for the default of `evaluate`.
            adapter_revision: The revision of `adapter`; None for the current one.
            deadline_s: Time limit of the call, seconds; None for that of the client.

        Returns:
            The pairs and the candidates, as rows of the room.

        Raises:
            RefusedError: The server refused the request; `field` names what to change.

        Example:
            >>> pairs = client.split_pairs("kitchen", "blocks", 20)
            >>> sources, targets = pairs.test.T
        """
        request = evaluation_pb2.ListPairsRequest(
            room=room,
            room_revision=room_revision,
            adapter=adapter,
            adapter_revision=adapter_revision,
            split=requests.split_value(split),
            stride=requests.count(stride, "stride"),
        )
        return answers.SplitPairs.of(self._ask(self._evaluation.ListPairs, request, deadline_s))

    def score(
        self,
        room: str,
        sources: npt.ArrayLike | None = None,
        targets: npt.ArrayLike | None = None,
        latents: npt.ArrayLike | None = None,
        *,
        frames: npt.ArrayLike | None = None,
        predictions: Sequence[Prediction] | None = None,
        name: str = "mine",
        room_revision: int | None = None,
        adapter: str | None = None,
        adapter_revision: int | None = None,
        split: Split | None = None,
        exclude_source: bool = False,
        exclude_radius: int = 0,
        thresholds: Sequence[float] = (),
        deadline_s: float | None = None,
    ) -> Evaluation:
        """Scores a navigator of one's own by the rules of `evaluate`.

        Args:
            room: The room.
            sources: The source frames of the pairs, (n,).
            targets: The target frames of the pairs, (n,).
            latents: The predicted latents of the targets, (n, k): the server retrieves the nearest candidate of each.
                Exactly one of `latents` and `frames` is required with `sources` and `targets`.
            frames: The frames that the navigator retrieved, (n,).
            predictions: The predictions, one for each pair, instead of arrays.
            name: The name of the navigator in the report.
            room_revision: The revision of the room; None for the current one.
            adapter: The adapter of the latents; None for the default of `evaluate`.
            adapter_revision: The revision of `adapter`; None for the current one.
            split: Only test pairs of this split are accepted, and only its candidates are retrieved; None for any pair.
            exclude_source: Whether the source frame of a pair may not be retrieved.
            exclude_radius: The number of rows before and after it that may not be retrieved either.
            thresholds: The thresholds ε of Hit@ε, meters and radians mixed; () for 0.1, 0.2, 0.3 and 0.5.
            deadline_s: Time limit of the call, seconds; None for that of the client.

        Returns:
            A report with one row. `evaluate(…).with_navigator(…)` puts it beside the others.

        Raises:
            RefusedError: The server refused the request, for instance because a pair is predicted twice.
            ValueError: The arrays do not fit each other.

        Example:
            >>> pairs = client.split_pairs("kitchen")
            >>> sources, targets = pairs.test.T
            >>> mine = client.score("kitchen", sources, targets, frames=sources, split=pairs.split)
            >>> print(client.evaluate("kitchen").with_navigator(mine).table())
        """
        request = evaluation_pb2.ScorePredictionsRequest(
            room=room,
            room_revision=room_revision,
            adapter=adapter,
            adapter_revision=adapter_revision,
            predictions=requests.predictions(predictions, sources, targets, latents, frames),
            split=requests.split_value(split),
            exclude_source=exclude_source,
            exclude_radius=requests.count(exclude_radius, "exclude_radius"),
            thresholds=thresholds,
        )
        answer = self._ask(self._evaluation.ScorePredictions, request, deadline_s)
        return Evaluation.of_scores(answer, request, name)

    # The catalog.

    def rooms(self, *, deadline_s: float | None = None) -> list[Room]:
        """The rooms that are served, by name."""
        return [Room.of(room) for room in self._pages("ListRooms", "rooms", deadline_s)]

    def adapters(self, *, deadline_s: float | None = None) -> list[Adapter]:
        """The adapters that are served, by name."""
        return [Adapter.of(adapter) for adapter in self._pages("ListAdapters", "adapters", deadline_s)]

    def _pages(self, method: str, field: str, deadline_s: float | None) -> Iterator[Any]:
        request = getattr(catalog_pb2, f"{method}Request")()
        for _ in range(MOST_PAGES):
            page = self._ask(getattr(self._catalog, method), request, deadline_s)
            for entry in getattr(page, field):
                yield entry
            if not page.next_page_token:
                return
            _go_on(request, page.next_page_token)
        raise errors.AnswerError(f"the server's list has more than {MOST_PAGES} pages")

    def server_info(self, *, deadline_s: float | None = None) -> answers.ServerInfo:
        """The version, the abilities and the limits of the server.

        Args:
            deadline_s: Time limit of the call, seconds; None for that of the client.

        Returns:
            What the server offers to this caller.

        Raises:
            RefusedError: The server refused the request.

        Example:
            >>> client.server_info().limits["top_k"]
        """
        answer = self._ask(self._catalog.GetServerInfo, catalog_pb2.GetServerInfoRequest(), deadline_s)
        return answers.ServerInfo.of(answer)

    def room(self, room: str, *, revision: int | None = None, deadline_s: float | None = None) -> Room:
        """One room.

        Args:
            room: The name of the room.
            revision: The revision; None for the current one.
            deadline_s: Time limit of the call, seconds; None for that of the client.

        Returns:
            The room.

        Raises:
            NotFoundError: There is no such room.

        Example:
            >>> client.room("kitchen").frame_count
        """
        request = catalog_pb2.GetRoomRequest(room=room, room_revision=revision)
        return Room.of(self._ask(self._catalog.GetRoom, request, deadline_s))

    def adapter(self, adapter: str, *, revision: int | None = None, deadline_s: float | None = None) -> Adapter:
        """One adapter.

        Args:
            adapter: The name of the adapter.
            revision: The revision; None for the current one.
            deadline_s: Time limit of the call, seconds; None for that of the client.

        Returns:
            The adapter.

        Raises:
            NotFoundError: There is no such adapter.

        Example:
            >>> client.adapter("robot").test.overall
        """
        request = catalog_pb2.GetAdapterRequest(adapter=adapter, adapter_revision=revision)
        return Adapter.of(self._ask(self._catalog.GetAdapter, request, deadline_s))

    def frames(
        self,
        room: str,
        *,
        room_revision: int | None = None,
        neighbors_within: float | None = None,
        thumbnail_width: int | None = None,
        deadline_s: float | None = None,
    ) -> answers.RoomFrames:
        """All frames of a room with their poses.

        Args:
            room: The room.
            room_revision: The revision of the room; None for the current one.
            neighbors_within: Also return the neighbors of each frame to which the motion has at most this norm,
                meters and radians mixed.
            thumbnail_width: Also return a JPEG of this width for each frame, 16 to 512 pixels.
            deadline_s: Time limit of each page, seconds; None for that of the client.

        Returns:
            The frames, a row each.

        Raises:
            RefusedError: The server refused the request, for instance because it shows no thumbnails.

        Example:
            >>> client.frames("kitchen").poses.shape
        """
        request = catalog_pb2.ListFramesRequest(
            room=room, room_revision=room_revision, neighbors_within=neighbors_within, thumbnail_width=thumbnail_width
        )
        frames: list[catalog_pb2.RoomFrame] = []
        for _ in range(MOST_PAGES):
            page = self._ask(self._catalog.ListFrames, request, deadline_s)
            frames.extend(page.frames)
            if not page.next_page_token:
                with_neighbors = neighbors_within is not None
                with_thumbnails = thumbnail_width is not None
                return answers.RoomFrames.of(page.room, frames, with_neighbors, with_thumbnails)
            _go_on(request, page.next_page_token)
        raise errors.AnswerError(f"the server's list has more than {MOST_PAGES} pages")

    def download_room(
        self, room: str, *, revision: int | None = None, deadline_s: float | None = None
    ) -> answers.DownloadedRoom:
        """Downloads the frames and features of a room. For a copy in a store, use `seese3 pull`.

        Args:
            room: The room.
            revision: The revision; None for the current one.
            deadline_s: Time limit of the call, seconds; None for no limit.

        Returns:
            The room as arrays, without images.

        Raises:
            RefusedError: The server refused the request.
            AnswerError: The download was damaged on its way.

        Example:
            >>> client.download_room("kitchen").features["efficientnet"].shape
        """
        request = catalog_pb2.DownloadRoomRequest(room=room, room_revision=revision)
        timeout = channel.timeout(_no_limit(deadline_s))
        call = self._catalog.DownloadRoom(request, timeout=timeout, metadata=self._metadata)
        messages = [message for message in self._listen(call)]
        return answers.DownloadedRoom.of(messages)

    def download_adapter(
        self, adapter: str, *, revision: int | None = None, deadline_s: float | None = None
    ) -> tuple[bytes, bytes]:
        """Downloads an adapter, for `upload_adapter`. For a copy in a store, use `seese3 pull`.

        Args:
            adapter: The adapter.
            revision: The revision; None for the current one.
            deadline_s: Time limit of the call, seconds; None for no limit.

        Returns:
            The manifest and the weights.

        Raises:
            RefusedError: The server refused the request.

        Example:
            >>> manifest, weights = client.download_adapter("robot")
        """
        request = catalog_pb2.DownloadAdapterRequest(adapter=adapter, adapter_revision=revision)
        timeout = channel.timeout(_no_limit(deadline_s))
        call = self._catalog.DownloadAdapter(request, timeout=timeout, metadata=self._metadata)
        messages = [message for message in self._listen(call)]
        if not messages or not messages[0].HasField("adapter"):
            raise errors.AnswerError("the download has no manifest")
        return messages[0].adapter.manifest, b"".join(message.weights for message in messages[1:])

    def upload_room(
        self,
        room: str,
        upload: Upload,
        *,
        mode: UploadMode = "create",
        encode_for: str | None = None,
        format: str = "",
        license: str = "",
        camera: Camera | None = None,
        drop_other_features: bool = False,
        validate_only: bool = False,
        request_id: str | None = None,
        deadline_s: float | None = None,
    ) -> Publication:
        """Uploads a room.

        Args:
            room: The name of the room.
            upload: The frames, with features or images.
            mode: "create" refuses a room that exists with other content, "replace" publishes a new revision of one
                that exists, and "extend" appends the frames to it.
            encode_for: The adapter for which the server encodes the images of the upload.
            format: The data set format of the recording; empty with "extend".
            license: The terms under which the recording may be used; empty with "extend".
            camera: The camera of all images, if it is known.
            drop_other_features: With "extend", whether the new revision may lack features that the upload has not.
            validate_only: Whether everything is checked and nothing is stored.
            request_id: An id by which the same change is known when it is sent again; None to make one up.
            deadline_s: Time limit of the call, seconds; None for no limit.

        Returns:
            The revision.

        Raises:
            ExistsError: The room exists with other content.
            RefusedError: The server refused the upload; `field` names what to change.

        Example:
            >>> client.upload_room("kitchen", Upload(poses, images=sorted(folder.glob("*.jpg"))), encode_for="robot")
        """
        described = catalog_pb2.RoomUpload(
            room=room,
            mode=enum_value(catalog_pb2.UploadMode, "UPLOAD_MODE_", mode, "mode"),
            feature_sources=[requests.feature_source(source) for source, _ in upload.features],
            encode_for=encode_for,
            format=format,
            license=license,
            camera=requests.wire_camera(camera),
            request_id=request_id or requests.new_id(),
            validate_only=validate_only,
            drop_other_features=drop_other_features,
        )
        messages = upload.messages(described)
        return Publication.of(self._ask(self._catalog.UploadRoom, messages, _no_limit(deadline_s)))

    def upload_adapter(
        self,
        adapter: str,
        manifest: bytes,
        weights: bytes,
        *,
        mode: UploadMode = "create",
        validate_only: bool = False,
        request_id: str | None = None,
        deadline_s: float | None = None,
    ) -> Publication:
        """Uploads an adapter that was trained elsewhere.

        Args:
            adapter: The name of the adapter.
            manifest: The manifest of a revision in another store, see `Store.adapter_files`.
            weights: The weights of that revision.
            mode: "create" refuses an adapter that exists with other content, "replace" publishes a new revision of
                one that exists.
            validate_only: Whether everything is checked and nothing is stored.
            request_id: An id by which the same change is known when it is sent again; None to make one up.
            deadline_s: Time limit of the call, seconds; None for no limit.

        Returns:
            The revision.

        Raises:
            ExistsError: The adapter exists with other content.
            RefusedError: The server refused the upload; `field` names what to change.

        Example:
            >>> client.upload_adapter("robot", *Store("store").adapter_files("robot"))
        """
        upload = catalog_pb2.AdapterUpload(
            adapter=adapter,
            mode=enum_value(catalog_pb2.UploadMode, "UPLOAD_MODE_", mode, "mode"),
            manifest=manifest,
            request_id=request_id or requests.new_id(),
            validate_only=validate_only,
        )
        messages = [catalog_pb2.UploadAdapterRequest(adapter=upload)]
        for start in range(0, len(weights), requests.UPLOAD_BYTES):
            part = weights[start : start + requests.UPLOAD_BYTES]
            messages.append(catalog_pb2.UploadAdapterRequest(weights=part))
        return Publication.of(self._ask(self._catalog.UploadAdapter, iter(messages), _no_limit(deadline_s)))

    def fit_adapter(
        self,
        room: str,
        *,
        base_adapter: str | None = None,
        feature_set: str | None = None,
        fitted_adapter: str | None = None,
        seed: int = 0,
        validate_only: bool = False,
        request_id: str | None = None,
        on_progress: Callable[[int, int], None] | None = None,
        deadline_s: float | None = None,
    ) -> Publication:
        """Fits an adapter to all frames of a room, and publishes it.

        Args:
            room: The room.
            base_adapter: The pre-trained adapter of other rooms to start from; None to start from random weights.
            feature_set: The feature set; None if there is a base adapter or only one set.
            fitted_adapter: The name of the adapter to publish; None for "ROOM.FEATURES.fitted".
            seed: The seed of the fit.
            validate_only: Whether everything is checked, and nothing is fitted or stored.
            request_id: An id by which the same change is known when it is sent again; None to make one up.
            on_progress: Called with the number of epochs that are done, and of all.
            deadline_s: Time limit of the call, seconds; None for no limit.

        Returns:
            The revision of the fitted adapter.

        Raises:
            RefusedError: The server refused the request; `field` names what to change.

        Example:
            >>> client.fit_adapter("kitchen").revision
        """
        request = catalog_pb2.FitAdapterRequest(
            room=room,
            base_adapter=base_adapter,
            feature_set=feature_set,
            fitted_adapter=fitted_adapter,
            seed=seed,
            request_id=request_id or requests.new_id(),
            validate_only=validate_only,
        )
        call = self._catalog.FitAdapter(request, timeout=channel.timeout(deadline_s), metadata=self._metadata)
        for message in self._listen(call):
            if message.HasField("result"):
                return Publication.of(message.result)
            if on_progress is not None:
                on_progress(message.progress.done, message.progress.total)
        raise errors.SeeseError("the server ended a fit without a result")

    def defaults(self, *, deadline_s: float | None = None) -> list[CatalogDefault]:
        """The defaults that were set for rooms and adapters.

        Args:
            deadline_s: Time limit of the call, seconds; None for that of the client.

        Returns:
            All current defaults.

        Raises:
            RefusedError: The server refused the request.

        Example:
            >>> [default.adapter for default in client.defaults() if default.room == "kitchen"]
        """
        answer = self._ask(self._catalog.ListDefaults, catalog_pb2.ListDefaultsRequest(), deadline_s)
        return [CatalogDefault.of(default) for default in answer.defaults]

    def set_default(
        self,
        *,
        room: str | None = None,
        adapter: str | None = None,
        revision: int | None = None,
        validate_only: bool = False,
        request_id: str | None = None,
        deadline_s: float | None = None,
    ) -> list[CatalogDefault]:
        """Sets the default adapter of a room, or the default revision of a room or an adapter.

        Args:
            room: The room.
            adapter: The adapter that is used in `room` when a request names none; or, without `room`, the adapter
                whose default revision is set.
            revision: The revision that the name of `room` or `adapter` alone refers to.
            validate_only: Whether everything is checked and nothing is stored.
            request_id: An id by which the same change is known when it is sent again; None to make one up.
            deadline_s: Time limit of the call, seconds; None for that of the client.

        Returns:
            All current defaults.

        Raises:
            RefusedError: The server refused the change; `field` names what to change.
            ValueError: Not exactly two of `room`, `adapter` and `revision` are given.

        Example:
            >>> client.set_default(room="kitchen", adapter="robot")
        """
        if (room is not None) + (adapter is not None) + (revision is not None) != 2:
            raise ValueError("give room and adapter, or one of them and revision")

        default = catalog_pb2.CatalogDefault()
        if revision is None:
            default.room_adapter.room, default.room_adapter.adapter = room or "", adapter or ""
        else:
            of = default.adapter_revision if room is None else default.room_revision
            of.name, of.revision = room or adapter or "", revision
        request = catalog_pb2.SetDefaultRequest(
            default=default, validate_only=validate_only, request_id=request_id or requests.new_id()
        )
        answer = self._ask(self._catalog.SetDefault, request, deadline_s)
        return [CatalogDefault.of(default) for default in answer.defaults]

    def clear_default(
        self,
        *,
        adapter_of_room: str | None = None,
        room: str | None = None,
        adapter: str | None = None,
        validate_only: bool = False,
        request_id: str | None = None,
        deadline_s: float | None = None,
    ) -> list[CatalogDefault]:
        """Clears a default. Exactly one of the first three arguments is required.

        Args:
            adapter_of_room: The room whose default adapter is cleared.
            room: The room whose default revision is cleared.
            adapter: The adapter whose default revision is cleared.
            validate_only: Whether everything is checked and nothing is stored.
            request_id: An id by which the same change is known when it is sent again; None to make one up.
            deadline_s: Time limit of the call, seconds; None for that of the client.

        Returns:
            All current defaults.

        Raises:
            RefusedError: The server refused the change.
            ValueError: Not exactly one default is named.

        Example:
            >>> client.clear_default(adapter_of_room="kitchen")
        """
        if (adapter_of_room is not None) + (room is not None) + (adapter is not None) != 1:
            raise ValueError("give exactly one of adapter_of_room, room and adapter")
        request = catalog_pb2.ClearDefaultRequest(
            adapter_of_room=adapter_of_room,
            revision_of_room=room,
            revision_of_adapter=adapter,
            validate_only=validate_only,
            request_id=request_id or requests.new_id(),
        )
        answer = self._ask(self._catalog.ClearDefault, request, deadline_s)
        return [CatalogDefault.of(default) for default in answer.defaults]

    def delete_room(
        self,
        room: str,
        *,
        revision: int | None = None,
        validate_only: bool = False,
        request_id: str | None = None,
        deadline_s: float | None = None,
    ) -> list[int]:
        """Removes a room, or one revision of it.

        Args:
            room: The name of the room.
            revision: The revision to remove; None for all.
            validate_only: Whether everything is checked and nothing is removed.
            request_id: An id by which the same change is known when it is sent again; None to make one up.
            deadline_s: Time limit of the call, seconds; None for that of the client.

        Returns:
            The numbers of the removed revisions.

        Raises:
            RefusedError: The server refused the change, for instance because the revision is a default.

        Example:
            >>> client.delete_room("kitchen", revision=1)
        """
        request = catalog_pb2.DeleteRoomRequest(
            room=_name(room),
            room_revision=revision,
            validate_only=validate_only,
            request_id=request_id or requests.new_id(),
        )
        return list((self._ask(self._catalog.DeleteRoom, request, deadline_s)).revisions)

    def delete_adapter(
        self,
        adapter: str,
        *,
        revision: int | None = None,
        validate_only: bool = False,
        request_id: str | None = None,
        deadline_s: float | None = None,
    ) -> list[int]:
        """Removes an adapter, or one revision of it.

        Args:
            adapter: The name of the adapter.
            revision: The revision to remove; None for all.
            validate_only: Whether everything is checked and nothing is removed.
            request_id: An id by which the same change is known when it is sent again; None to make one up.
            deadline_s: Time limit of the call, seconds; None for that of the client.

        Returns:
            The numbers of the removed revisions.

        Raises:
            RefusedError: The server refused the change, for instance because the adapter is a default.

        Example:
            >>> client.delete_adapter("robot", revision=1)
        """
        request = catalog_pb2.DeleteAdapterRequest(
            adapter=_name(adapter),
            adapter_revision=revision,
            validate_only=validate_only,
            request_id=request_id or requests.new_id(),
        )
        return list((self._ask(self._catalog.DeleteAdapter, request, deadline_s)).revisions)


def _no_limit(deadline_s: float | None) -> float:
    """The deadline of a call that has none of its own."""
    return float("inf") if deadline_s is None else deadline_s


def _go_on(request: Any, token: str) -> None:
    """Asks for the next page."""
    if token == request.page_token:
        raise errors.AnswerError("the server's list has no end: a page is followed by itself")
    request.page_token = token


def _name(name: str) -> str:
    # An omitted name would be a protobuf default, and an error of the server.
    if not isinstance(name, str):
        raise TypeError(f"a name is text, not {name!r}")
    return name


class Track:
    """A stream that follows a camera. `step` sends a frame and returns its answer, `follow` does so for many.

    A stream that is cut (the server was restarted, the network was gone for a moment) is opened again by the token of
    its last answer, and the frames since then are sent again. The map pose goes on, and the odometry frame begins anew.
    `resumed` counts how often that was done. `resume_token` and `last_sequence_number`, the number of the last frame,
    carry the stream on in another program. `start` has the choices of the server. A stream is for one thread, or one
    task, at a time.
    """

    def __init__(
        self,
        method: Any,
        metadata: list[tuple[str, str]],
        config: odometry_pb2.TrackConfig,
        last_sequence_number: int,
        deadline_s: float | None,
    ) -> None:
        self._method = method
        self._deadline_s = deadline_s
        self._metadata = metadata
        self._config = config
        self.last_sequence_number = last_sequence_number
        # What was answered since the last token, and what has no answer yet: both are sent again when a stream is cut.
        self._unsaved: deque[odometry_pb2.TrackRequest] = deque(maxlen=MOST_UNSAVED)
        self._awaited: deque[odometry_pb2.TrackRequest] = deque()
        self._call: Any = None
        self._is_cut = False
        self._requests: queue.Queue[odometry_pb2.TrackRequest | None] = queue.Queue()
        self._is_busy = False
        self.start: TrackStart | None = None
        self.resume_token = config.resume_token
        self.resumed = 0

    def __enter__(self) -> Track:
        try:
            self._keep_trying(self._open)
        except BaseException:
            self.close()
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Ends the stream."""
        if self._call is not None:
            self._requests.put(None)
            self._call.cancel()
            self._call = None

    def step(
        self,
        view: View,
        timestamp_ns: int,
        *,
        sequence_number: int | None = None,
        odometry: Odometry | None = None,
        gravity: Gravity | None = None,
        other_views: dict[str, View] | None = None,
        inertial: InertialSamples | None = None,
        exposure_ns: int = 0,
        depth: DepthImage | None = None,
        deadline_s: float | None = None,
    ) -> TrackUpdate | TrackRefusal:
        """Sends a frame, taken at a time on the camera's clock, and returns what the server says of it.

        `inertial` are the samples since the last frame. `exposure_ns` is the duration of the exposure, which begins at
        the time. `depth` are the depths of an image, from a depth camera or stereo.

        Without `deadline_s`, a step waits for as long as the connection is alive. A stream that was cut is opened again
        within the deadline of opening it. A step that raises, or that is given
        up, did not happen: the frame may be sent again.
        """
        frame = self._frame(
            view, timestamp_ns, sequence_number, odometry, gravity, other_views, inertial, exposure_ns, depth
        )
        self._drain()
        self._send(frame)
        return self._receive_of_frame(channel.timeout(deadline_s))

    def follow(
        self, frames: Iterable[tuple[int, View]], *, ahead: int = 0
    ) -> Iterator[TrackUpdate | TrackRefusal]:
        """The answers to frames, each a time in nanoseconds and a view, in the order of the frames.

        `ahead` frames are sent before the answer to the first of them is awaited: 0 for a camera, whose next frame is
        not there yet; some 16 for a recording, which is then followed faster than frame by frame. Frames that were sent
        ahead have been seen: after a loop that was left early, the stream goes on behind them. A camera that may be
        faster than the server is wrapped in `Newest`, or `AsyncNewest`: frames are then skipped, and none is late.
        """
        if ahead < 0:
            raise ValueError(f"ahead: {ahead} is below 0")
        self._drain()

        for timestamp_ns, view in frames:
            self._send(self._frame(view, timestamp_ns))
            if len(self._awaited) > ahead:
                yield self._receive_of_frame()
        while self._awaited:
            yield self._receive_of_frame()

    def set_initial_pose(self, pose: InitialPose) -> None:
        """Tells where the camera is now."""
        message = odometry_pb2.SetInitialPose(initial_pose=pose.message())
        refusal = self._exchange(odometry_pb2.TrackRequest(set_initial_pose=message))
        if refusal is not None:
            raise errors.InvalidFieldError(refusal.message, code="INVALID_ARGUMENT", reason="POSE")

    def reset(self) -> None:
        """Starts anew: the camera has to be found again."""
        self._exchange(odometry_pb2.TrackRequest(reset=odometry_pb2.Reset()))

    def _open(self) -> None:
        """Opens the stream, by its token if it has one, and sends again what was answered since then."""
        self._is_cut = True
        self._requests.put(None)
        self._requests = queue.Queue()
        outgoing = self._outgoing(self._requests)
        self._call = self._method(outgoing, metadata=self._metadata)
        self._answers = self._call.__iter__()

        config = odometry_pb2.TrackConfig(resume_token=self.resume_token) if self.resume_token else self._config
        self._requests.put(odometry_pb2.TrackRequest(config=config))
        answer = self._next_answer(self._deadline_s)
        self.start = TrackStart.of(answer.started)
        self.resume_token = answer.resume_token or self.resume_token
        for request in list(self._unsaved):
            self._requests.put(request)
            self._next_answer(self._deadline_s)
        self._is_cut = False

    def _outgoing(
        self, queue: queue.Queue[odometry_pb2.TrackRequest | None]
    ) -> Iterator[odometry_pb2.TrackRequest]:
        while (request := queue.get()) is not None:
            yield request

    def _next_answer(self, deadline_s: float | None) -> odometry_pb2.TrackResponse:
        timer = channel.SyncTimer(self._call, deadline_s)
        try:
            answer: odometry_pb2.TrackResponse = next(self._answers)
        except StopIteration:
            raise errors.UnavailableError("the server ended the stream", code="UNAVAILABLE") from None
        except (grpc.RpcError, channel.CancelledError) as error:
            if timer.is_over:
                message = "the server did not answer within the deadline"
                raise errors.DeadlineError(message, code="DEADLINE_EXCEEDED") from None
            if isinstance(error, grpc.RpcError):
                raise errors.refused(error) from None
            raise
        finally:
            timer.stop()
        return answer

    def _note(self, answer: odometry_pb2.TrackResponse) -> None:
        if answer.resume_token:
            self.resume_token = answer.resume_token
            self._unsaved.clear()

    def _frame(
        self,
        view: View,
        timestamp_ns: int,
        sequence_number: int | None = None,
        odometry: Odometry | None = None,
        gravity: Gravity | None = None,
        other_views: dict[str, View] | None = None,
        inertial: InertialSamples | None = None,
        exposure_ns: int = 0,
        depth: DepthImage | None = None,
    ) -> odometry_pb2.TrackRequest:
        number = self.last_sequence_number + 1 if sequence_number is None else sequence_number
        frame = requests.track_frame(
            view, timestamp_ns, number, odometry, gravity, other_views or {}, inertial, exposure_ns, depth
        )
        self.last_sequence_number = number
        return frame

    def _exchange(self, request: odometry_pb2.TrackRequest) -> TrackRefusal | None:
        """Sends what is no frame; returns what the server refuses of it."""
        self._drain()
        self._send(request)
        said = self._receive()
        return said if isinstance(said, TrackRefusal) else None

    def _drain(self) -> None:
        """Receives the answers left over from a `follow` that was left early."""
        while self._awaited:
            self._receive()

    def _send(self, request: odometry_pb2.TrackRequest) -> None:
        if self._call is None:
            raise errors.SeeseError("the stream is not open: use it as `with client.track(…) as track`")
        if self._is_cut:
            self._keep_trying(self._open_again)
        self._awaited.append(request)
        self._requests.put(request)

    def _receive_of_frame(self, deadline_s: float | None = None) -> TrackUpdate | TrackRefusal:
        """The answer to the oldest request without one, which is a frame."""
        answer = self._receive(deadline_s)
        if answer is None:
            raise errors.AnswerError("the server answered a frame as if it were another message")
        return answer

    def _receive(self, deadline_s: float | None = None) -> TrackUpdate | TrackRefusal | None:
        """The answer to the oldest request without one; None for an acknowledgement."""
        if self._is_busy:
            raise errors.SeeseError("the stream waits for an answer already: one stream is for one thread or task")
        self._is_busy = True
        try:
            answer = self._answer(deadline_s)
            said = self._understood(answer)
        except BaseException:
            # Whoever waited may have given up, by a timeout of its own or by Ctrl-C, and an answer that came later
            # would be taken for that of the next frame. So the stream is cut: what has no answer did not happen.
            self._is_cut = True
            self._forget_awaited()
            if self._call is not None:
                self._call.cancel()
            raise
        finally:
            self._is_busy = False

        # One refusal may stand for several frames, which newer ones took the place of.
        answered = max(1, answer.refusal.frame_count) if answer.HasField("refusal") else 1
        for _ in range(min(answered, len(self._awaited))):
            self._unsaved.append(self._awaited.popleft())
        self._note(answer)
        return said

    def _understood(self, answer: odometry_pb2.TrackResponse) -> TrackUpdate | TrackRefusal | None:
        """What an answer says; it has to be that of the oldest request without one. None for an acknowledgement."""
        if answer.HasField("refusal"):
            return TrackRefusal.of(answer.refusal)
        if answer.HasField("acknowledged"):
            return None
        asked, update = self._awaited[0], answer.update
        if asked.HasField("frame") and update.sequence_number != asked.frame.sequence_number:
            raise errors.AnswerError(
                f"the server answered frame {update.sequence_number} where frame {asked.frame.sequence_number} was sent"
            )
        return TrackUpdate.of(update)

    def _forget_awaited(self) -> None:
        # A number that is never sent would count as a frame that is missing.
        for request in reversed(self._awaited):
            if request.HasField("frame"):
                self.last_sequence_number = request.frame.sequence_number - 1
        self._awaited.clear()

    def _answer(self, deadline_s: float | None) -> odometry_pb2.TrackResponse:
        try:
            return self._next_answer(deadline_s)
        except errors.UnavailableError:
            answer: odometry_pb2.TrackResponse = self._keep_trying(self._answer_again)
            return answer

    def _open_again(self) -> None:
        self._open()
        self.resumed += 1

    def _answer_again(self) -> odometry_pb2.TrackResponse:
        self._open_again()
        for request in self._awaited:
            self._requests.put(request)
        return self._next_answer(self._deadline_s)

    def _keep_trying(self, what: Callable[[], Any]) -> Any:
        wait_s = FIRST_WAIT_S
        for attempt in range(RESUMPTIONS + 1):
            try:
                return what()
            except (errors.UnavailableError, errors.BusyError) as error:
                if attempt == RESUMPTIONS:
                    raise
                time.sleep(max(wait_s, getattr(error, "retry_after_s", None) or 0.0))
                wait_s *= 2
