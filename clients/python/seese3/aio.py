"""The asynchronous client: every call as a coroutine. The synchronous `client.py` is made from this file."""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import AsyncIterable, AsyncIterator, Callable, Sequence
from types import TracebackType
from typing import Any

import grpc
import numpy as np
import numpy.typing as npt

from . import answers, channel, errors, requests
from .answers import Adapter, Camera, Default, Evaluation, Publication, Room, TrackRefusal, TrackStart, TrackUpdate
from .geometry import wire_pose
from .requests import (
    DepthImage,
    Gravity,
    InertialSamples,
    InitialPose,
    Odometry,
    Prediction,
    Question,
    TrackConfig,
    Upload,
)
from .v1 import (
    catalog_pb2,
    catalog_pb2_grpc,
    evaluation_pb2,
    evaluation_pb2_grpc,
    geometry_pb2,
    localization_pb2,
    localization_pb2_grpc,
    navigation_pb2,
    navigation_pb2_grpc,
    odometry_pb2,
    odometry_pb2_grpc,
)
from .views import View, wire_view

# How often and how soon a cut tracking stream is opened again.
RESUMPTIONS = 5
FIRST_WAIT_S = 0.1
# Frames since the last token that are kept, to send them again when a stream is cut.
MOST_UNSAVED = 1_000
# Pages of a list; a server's page has up to 1,000 entries.
MOST_PAGES = 10_000


class AsyncClient:
    """A connection to a server.

    - `address`: HOST:PORT.
    - `token`: the bearer token of every call, if the server asks for one.
    - `tls`: certificates, if the server speaks TLS.
    - `deadline_s`: how long a call may take, seconds; None is for ever. Every method takes another one as `deadline_s`.
    - `retries`: how often a read is made again when the server does not answer or is busy, 0 to 4.

    Every method raises a `RefusedError` if the server refuses, see `errors`. Adapters are named by `adapter`; "" is the
    default of the room. Thresholds ε of Hit@ε mix metres and radians; () are the server's.
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
        self._channel = channel.open_async(address, tls, retries)
        self._catalog = _stub(catalog_pb2_grpc.CatalogServiceStub, self._channel)
        self._navigation = _stub(navigation_pb2_grpc.NavigationServiceStub, self._channel)
        self._localization = _stub(localization_pb2_grpc.LocalizationServiceStub, self._channel)
        self._odometry = _stub(odometry_pb2_grpc.OdometryServiceStub, self._channel)
        self._evaluation = _stub(evaluation_pb2_grpc.EvaluationServiceStub, self._channel)

    async def __aenter__(self) -> AsyncClient:
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await self.aclose()

    async def aclose(self) -> None:
        """Closes the connection. Calls that are open are cut."""
        self._is_closed = True
        await self._channel.close()

    def _timeout(self, deadline_s: float | None) -> float | None:
        return channel.timeout(self._deadline_s if deadline_s is None else deadline_s)

    async def _ask(self, method: Any, request: Any, deadline_s: float | None) -> Any:
        self._check_open()
        try:
            answer = await method(request, timeout=self._timeout(deadline_s), metadata=self._metadata)
        except grpc.RpcError as error:
            raise errors.refused(error) from None
        if answer is None:
            raise errors.AnswerError("the server answered without a message")
        return answer

    def _check_open(self) -> None:
        if self._is_closed:
            raise errors.SeeseError("the client is closed")

    async def _listen(self, call: Any) -> AsyncIterator[Any]:
        try:
            async for message in call:
                yield message
        except grpc.RpcError as error:
            raise errors.refused(error) from None
        finally:
            call.cancel()

    # Navigation.

    async def navigate(
        self,
        room: str,
        source: View,
        *,
        to: int | None = None,
        twist: npt.ArrayLike | None = None,
        pose: npt.ArrayLike | None = None,
        adapter: str = "",
        source_pose: npt.ArrayLike | None = None,
        steps: int | None = None,
        mode: str | None = None,
        reading: str | None = None,
        navigator: str = "",
        top_k: int | None = None,
        exclude_source: bool = False,
        exclude_radius: int = 0,
        thresholds: Sequence[float] = (),
        deadline_s: float | None = None,
    ) -> answers.Navigation:
        """Imagines a motion from `source`, and retrieves the stored frame that shows the view after it.

        The motion leads `to` a frame, or is a `twist` (6,) or several (n, 6), or leads to a `pose` (4, 4) in the world.
        `mode` is "open_loop", "snap" or "closed_loop"; `reading` "affine", "homogeneous" or "literal".
        """
        question = Question(
            source=source,
            to=to,
            twist=twist,
            pose=pose,
            source_pose=source_pose,
            steps=steps,
            mode=mode,
            reading=reading,
            navigator=navigator,
            top_k=top_k,
            exclude_source=exclude_source,
            exclude_radius=exclude_radius,
            thresholds=thresholds,
        )
        answer = await self._ask(self._navigation.Navigate, question.request(room, adapter), deadline_s)
        return answers.Navigation.of(answer)

    async def navigate_batch(
        self, room: str, questions: Sequence[Question], *, adapter: str = "", deadline_s: float | None = None
    ) -> list[answers.Navigation | errors.RefusedError]:
        """Answers many questions in one call.

        A question that the server refuses has its exception in its place, also where the room is not there. A question
        that cannot be asked at all is a `ValueError` that names it.
        """
        batch = []
        for number, question in enumerate(questions):
            try:
                batch.append(question.request(room, adapter))
            except (TypeError, ValueError) as error:
                raise type(error)(f"questions[{number}]: {error}") from None
        request = navigation_pb2.BatchNavigateRequest(requests=batch)
        return answers.batch_of(await self._ask(self._navigation.BatchNavigate, request, deadline_s))

    async def navigate_to(
        self,
        room: str,
        source: View,
        *,
        goal: int | None = None,
        goal_pose: npt.ArrayLike | None = None,
        adapter: str = "",
        source_pose: npt.ArrayLike | None = None,
        step: float | None = None,
        tolerance_m: float | None = None,
        tolerance_rad: float | None = None,
        max_steps: int | None = None,
        max_recoveries: int | None = None,
        planner: str | None = None,
        least_arrival_probability: float | None = None,
        camera: Camera | str | None = None,
        on_step: Callable[[answers.WayStep], None] | None = None,
        deadline_s: float | None = None,
    ) -> answers.Way:
        """Plans a way from `source` to a stored frame or a pose (4, 4). `planner` is "pose_graph" or "latent".

        `on_step` is called with every step as it arrives; the way that is returned has them all. `camera` is that of
        an image, or "mapping"; with it, the start is estimated from matched keypoints if the room has any.
        """
        if (goal is None) == (goal_pose is None):
            raise ValueError("give exactly one of goal (a frame's row) and goal_pose")
        request = navigation_pb2.NavigateToRequest(
            room=room,
            adapter=adapter,
            source=wire_view(source),
            source_pose=None if source_pose is None else wire_pose(source_pose),
            goal_frame_id=requests.count(goal, "goal"),
            goal_pose=None if goal_pose is None else wire_pose(goal_pose),
            step=step,
            tolerance_m=tolerance_m,
            tolerance_rad=tolerance_rad,
            max_steps=requests.count(max_steps, "max_steps"),
            max_recoveries=requests.count(max_recoveries, "max_recoveries"),
            planner=requests.enum_value(navigation_pb2.Planner, "PLANNER_", planner, "planner"),  # type: ignore[arg-type]
            least_arrival_probability=least_arrival_probability,
            source_camera=requests.wire_view_camera(camera),
        )
        call = self._navigation.NavigateTo(request, timeout=self._timeout(deadline_s), metadata=self._metadata)

        steps: list[answers.WayStep] = []
        async for message in self._listen(call):
            if message.HasField("result"):
                return answers.Way.of(steps, message.result)
            steps.append(answers.WayStep.of(message.feedback))
            if on_step is not None:
                on_step(steps[-1])
        raise errors.SeeseError("the server ended a navigation without a result")

    # Localization.

    async def localize(
        self,
        view: View,
        *,
        rooms: Sequence[str] | str = (),
        adapter: str = "",
        top_k: int | None = None,
        thresholds: Sequence[float] = (),
        camera: Camera | str | None = None,
        deadline_s: float | None = None,
    ) -> answers.Localization:
        """Estimates the pose of a view in one room, in several, or in all: ().

        `camera` is that of an image, or "mapping" for the camera that mapped the room. It is required if the room has
        keypoints.
        """
        request = localization_pb2.LocalizeRequest(
            rooms=requests.names(rooms),
            adapter=adapter,
            view=wire_view(view),
            top_k=requests.count(top_k, "top_k"),
            thresholds=thresholds,
            camera=requests.wire_view_camera(camera),
        )
        return answers.Localization.of(await self._ask(self._localization.Localize, request, deadline_s))

    async def relocalize(
        self,
        views: Sequence[View],
        *,
        rooms: Sequence[str] | str = (),
        adapter: str = "",
        max_rooms: int | None = None,
        top_k: int | None = None,
        camera: Camera | str | None = None,
        deadline_s: float | None = None,
    ) -> answers.Relocalization:
        """Finds the room of a camera and its pose there, from some views, the newest last.

        `camera` is that of the images, or "mapping" for the camera that mapped the room. It is required if a room has
        keypoints.
        """
        request = localization_pb2.RelocalizeRequest(
            rooms=requests.names(rooms),
            adapter=adapter,
            views=requests.wire_views(views),
            max_rooms=requests.count(max_rooms, "max_rooms"),
            top_k=requests.count(top_k, "top_k"),
            camera=requests.wire_view_camera(camera),
        )
        return answers.Relocalization.of(await self._ask(self._localization.Relocalize, request, deadline_s))

    # Odometry.

    async def motion(
        self,
        first: View,
        second: View,
        *,
        room: str = "",
        adapter: str = "",
        camera: Camera | None = None,
        thresholds: Sequence[float] = (),
        deadline_s: float | None = None,
    ) -> answers.Motion:
        """Estimates the motion (6,) from one view to another, in the body frame of the first camera."""
        request = odometry_pb2.EstimateMotionRequest(
            room=room,
            adapter=adapter,
            first=wire_view(first),
            second=wire_view(second),
            camera=requests.wire_camera(camera),
            thresholds=thresholds,
        )
        return answers.Motion.of(await self._ask(self._odometry.EstimateMotion, request, deadline_s))

    async def encode(
        self,
        views: Sequence[View],
        *,
        room: str = "",
        adapter: str = "",
        with_features: bool = False,
        deadline_s: float | None = None,
    ) -> answers.Encoding:
        """Turns views into latents of an adapter, which can be sent wherever a view is asked for."""
        request = odometry_pb2.EncodeRequest(
            room=room,
            adapter=adapter,
            views=requests.wire_views(views),
            with_features=with_features,
        )
        return answers.Encoding.of(await self._ask(self._odometry.Encode, request, deadline_s), with_features)

    def track(
        self,
        config: TrackConfig | None = None,
        *,
        resume_token: bytes = b"",
        last_sequence: int | None = None,
        deadline_s: float | None = None,
    ) -> AsyncTrack:
        """Opens a stream that follows a camera: `async with client.track(TrackConfig(room="kitchen")) as track`.

        To go on with a stream of another program, give its `resume_token` and its `last_sequence`. The deadline is
        that of opening the stream, the first time and when it was cut; `step` has its own.
        """
        self._check_open()
        if (config is None) == (not resume_token):
            raise ValueError("give exactly one of config and resume_token")
        if bool(resume_token) != (last_sequence is not None):
            raise ValueError("resume_token and last_sequence belong together: frames go on with the number after it")
        message = config.message() if config else odometry_pb2.TrackConfig(resume_token=resume_token)
        return AsyncTrack(self._odometry.Track, self._metadata, message, last_sequence or 0, self._timeout(deadline_s))

    # Evaluation.

    async def evaluate(
        self,
        room: str,
        *,
        adapter: str = "",
        stride: int | None = None,
        split: str = "",
        navigators: Sequence[str] | str = (),
        exclude_source: bool = False,
        exclude_radius: int = 0,
        thresholds: Sequence[float] = (),
        seed: int = 0,
        steps: int | None = None,
        mode: str | None = None,
        on_progress: Callable[[int, int], None] | None = None,
        deadline_s: float | None = None,
    ) -> Evaluation:
        """Scores navigators on a room's held-out pairs, beside the identity and a random frame.

        `on_progress` is called with how many of how many navigators are done. The deadline is none unless it is given.
        """
        request = evaluation_pb2.EvaluateRequest(
            room=room,
            adapter=adapter,
            stride=requests.count(stride, "stride"),
            split=split,
            navigators=requests.names(navigators),
            exclude_source=exclude_source,
            exclude_radius=requests.count(exclude_radius, "exclude_radius"),
            thresholds=thresholds,
            seed=seed,
            steps=requests.count(steps, "steps"),
            mode=requests.mode(mode),
        )
        self._check_open()
        call = self._evaluation.Evaluate(request, timeout=channel.timeout(deadline_s), metadata=self._metadata)
        async for message in self._listen(call):
            if message.HasField("report"):
                report = Evaluation.of(message.report)
                if on_progress is not None:
                    on_progress(len(report.navigators), len(report.navigators))
                return report
            if on_progress is not None:
                on_progress(message.progress.done, message.progress.total)
        raise errors.SeeseError("the server ended an evaluation without a report")

    async def score(
        self,
        room: str,
        predictions: Sequence[Prediction],
        *,
        adapter: str = "",
        split: str = "",
        exclude_source: bool = False,
        exclude_radius: int = 0,
        thresholds: Sequence[float] = (),
        deadline_s: float | None = None,
    ) -> answers.NavigatorScores:
        """Scores a navigator of one's own by the same rules as `evaluate`, on the pairs of its predictions."""
        request = evaluation_pb2.ScorePredictionsRequest(
            room=room,
            adapter=adapter,
            predictions=[
                evaluation_pb2.Prediction(
                    source_frame_id=one.source,
                    target_frame_id=one.target,
                    latent=None
                    if one.latent is None
                    else geometry_pb2.Latent(values=np.asarray(one.latent, dtype=np.float64).tolist()),
                    retrieved_frame_id=one.frame,
                    last_step_frame_id=one.last_step_frame,
                )
                for one in predictions
            ],
            split=split,
            exclude_source=exclude_source,
            exclude_radius=exclude_radius,
            thresholds=thresholds,
        )
        answer = await self._ask(self._evaluation.ScorePredictions, request, deadline_s)
        return answers.NavigatorScores.of(answer.scores)

    # The catalog.

    async def rooms(self, *, deadline_s: float | None = None) -> list[Room]:
        """The rooms that are served, by name."""
        return [Room.of(room) async for room in self._pages("ListRooms", "rooms", deadline_s)]

    async def adapters(self, *, deadline_s: float | None = None) -> list[Adapter]:
        """The adapters that are served, by name."""
        return [Adapter.of(adapter) async for adapter in self._pages("ListAdapters", "adapters", deadline_s)]

    async def _pages(self, method: str, field: str, deadline_s: float | None) -> AsyncIterator[Any]:
        request = getattr(catalog_pb2, f"{method}Request")()
        for _ in range(MOST_PAGES):
            page = await self._ask(getattr(self._catalog, method), request, deadline_s)
            for entry in getattr(page, field):
                yield entry
            if not page.next_page_token:
                return
            _go_on(request, page.next_page_token)
        raise errors.AnswerError(f"the server's list has more than {MOST_PAGES} pages")

    async def room(self, name: str, *, deadline_s: float | None = None) -> Room:
        """One room."""
        request = catalog_pb2.GetRoomRequest(room=name)
        return Room.of((await self._ask(self._catalog.GetRoom, request, deadline_s)).room)

    async def adapter(self, name: str, *, deadline_s: float | None = None) -> Adapter:
        """One adapter."""
        request = catalog_pb2.GetAdapterRequest(adapter=name)
        return Adapter.of((await self._ask(self._catalog.GetAdapter, request, deadline_s)).adapter)

    async def frames(
        self,
        room: str,
        *,
        neighbours_within: float | None = None,
        thumbnail_width: int | None = None,
        deadline_s: float | None = None,
    ) -> answers.RoomFrames:
        """All frames of a room with their poses; with `neighbours_within`, a norm of motions, also the pose graph."""
        request = catalog_pb2.ListFramesRequest(
            room=room, neighbours_within=neighbours_within, thumbnail_width=thumbnail_width
        )
        frames: list[catalog_pb2.RoomFrame] = []
        for _ in range(MOST_PAGES):
            page = await self._ask(self._catalog.ListFrames, request, deadline_s)
            frames.extend(page.frames)
            if not page.next_page_token:
                with_neighbours = neighbours_within is not None
                with_thumbnails = thumbnail_width is not None
                return answers.RoomFrames.of(page.room, frames, with_neighbours, with_thumbnails)
            _go_on(request, page.next_page_token)
        raise errors.AnswerError(f"the server's list has more than {MOST_PAGES} pages")

    async def create_room(
        self,
        name: str,
        upload: Upload,
        *,
        encode_for: str = "",
        format: str = "",
        licence: str = "",
        camera: Camera | None = None,
        extend: bool = False,
        drop_other_features: bool = False,
        validate_only: bool = False,
        request_id: str = "",
        deadline_s: float = float("inf"),
    ) -> Publication:
        """Uploads a room, or with `extend` more frames of it; images, not features, with `encode_for`, an adapter.

        Names of rooms and adapters are plain here, without "rooms/" before them. The deadline is none unless it is
        given.
        """
        room = catalog_pb2.RoomUpload(
            name=_resource("rooms", name),
            features=[requests.feature_source(source) for source, _ in upload.features],
            encode_for=f"adapters/{encode_for}" if encode_for else "",
            format=format,
            licence=licence,
            camera=requests.wire_camera(camera),
            request_id=request_id or requests.new_id(),
            validate_only=validate_only,
            extend=extend,
            drop_other_features=drop_other_features,
        )
        messages = upload.messages(room)
        return Publication.of(await self._ask(self._catalog.CreateRoom, messages, deadline_s))

    async def publish_adapter(
        self,
        name: str,
        manifest: bytes,
        weights: bytes,
        *,
        validate_only: bool = False,
        request_id: str = "",
        deadline_s: float = float("inf"),
    ) -> Publication:
        """Uploads an adapter by the two files that a store has of it, see `Store.adapter_files`.

        The deadline is none unless it is given.
        """
        upload = catalog_pb2.AdapterUpload(
            name=_resource("adapters", name),
            manifest=manifest,
            request_id=request_id or requests.new_id(),
            validate_only=validate_only,
        )
        messages = [catalog_pb2.PublishAdapterRequest(adapter=upload)]
        for start in range(0, len(weights), requests.UPLOAD_BYTES):
            part = weights[start : start + requests.UPLOAD_BYTES]
            messages.append(catalog_pb2.PublishAdapterRequest(weights=part))
        return Publication.of(await self._ask(self._catalog.PublishAdapter, iter(messages), deadline_s))

    async def refit_room(
        self,
        name: str,
        *,
        base_adapter: str = "",
        features: str = "",
        fitted_adapter: str = "",
        seed: int = 0,
        validate_only: bool = False,
        request_id: str = "",
        on_progress: Callable[[int, int], None] | None = None,
        deadline_s: float | None = None,
    ) -> Publication:
        """Fits an adapter to all frames of a room, and publishes it. The deadline is none unless it is given."""
        request = catalog_pb2.RefitRoomRequest(
            name=f"rooms/{name}",
            base_adapter=f"adapters/{base_adapter}" if base_adapter else "",
            features=features,
            fitted_adapter=f"adapters/{fitted_adapter}" if fitted_adapter else "",
            seed=seed,
            request_id=request_id or requests.new_id(),
            validate_only=validate_only,
        )
        call = self._catalog.RefitRoom(request, timeout=channel.timeout(deadline_s), metadata=self._metadata)
        async for message in self._listen(call):
            if message.HasField("result"):
                return Publication.of(message.result)
            if on_progress is not None:
                on_progress(message.progress.done, message.progress.total)
        raise errors.SeeseError("the server ended a fit without a result")

    async def set_default(
        self,
        *,
        room: str = "",
        revision: int | None = None,
        adapter: str = "",
        request_id: str = "",
        deadline_s: float | None = None,
    ) -> list[Default]:
        """Chooses the adapter that answers in a room, or the revision that a room's or an adapter's name means.

        With `room` and `adapter`: the room's adapter. With one of them and `revision`: its revision.
        """
        if bool(room) + bool(adapter) + (revision is not None) != 2:
            raise ValueError("give room and adapter, or one of them and revision; `unset_default` takes a choice back")

        request = catalog_pb2.SetDefaultRequest(
            name=f"rooms/{room}" if room else f"adapters/{adapter}",
            revision=revision,
            adapter=f"adapters/{adapter}" if room and adapter else None,
            request_id=request_id or requests.new_id(),
        )
        answer = await self._ask(self._catalog.SetDefault, request, deadline_s)
        return [Default.of(default) for default in answer.defaults]

    async def unset_default(
        self, *, room: str = "", adapter: str = "", request_id: str = "", deadline_s: float | None = None
    ) -> list[Default]:
        """Chooses nothing for a room or an adapter any more: its name means its newest revision again."""
        if bool(room) == bool(adapter):
            raise ValueError("give exactly one of room and adapter")
        request = catalog_pb2.SetDefaultRequest(
            name=f"rooms/{room}" if room else f"adapters/{adapter}", request_id=request_id or requests.new_id()
        )
        answer = await self._ask(self._catalog.SetDefault, request, deadline_s)
        return [Default.of(default) for default in answer.defaults]

    async def roll_back_default(self, *, request_id: str = "", deadline_s: float | None = None) -> list[Default]:
        """Takes the last change of defaults back."""
        request = catalog_pb2.RollBackDefaultRequest(request_id=request_id or requests.new_id())
        answer = await self._ask(self._catalog.RollBackDefault, request, deadline_s)
        return [Default.of(default) for default in answer.defaults]

    async def delete_room(
        self, name: str, *, revision: int | None = None, request_id: str = "", deadline_s: float | None = None
    ) -> list[int]:
        """Removes a room, or one revision of it, and returns the numbers of the revisions that were removed."""
        request = catalog_pb2.DeleteRoomRequest(
            name=_resource("rooms", name, revision), request_id=request_id or requests.new_id()
        )
        return list((await self._ask(self._catalog.DeleteRoom, request, deadline_s)).revisions)

    async def delete_adapter(
        self, name: str, *, revision: int | None = None, request_id: str = "", deadline_s: float | None = None
    ) -> list[int]:
        """Removes an adapter, or one revision of it, and returns the numbers of the revisions that were removed."""
        request = catalog_pb2.DeleteAdapterRequest(
            name=_resource("adapters", name, revision), request_id=request_id or requests.new_id()
        )
        return list((await self._ask(self._catalog.DeleteAdapter, request, deadline_s)).revisions)


def _stub(kind: Any, channel: Any) -> Any:
    """A stub of a service; what protoc writes has no types."""
    return kind(channel)


def _go_on(request: Any, token: str) -> None:
    """Asks for the next page."""
    if token == request.page_token:
        raise errors.AnswerError("the server's list has no end: a page is followed by itself")
    request.page_token = token


def _resource(collection: str, name: str, revision: int | None = None) -> str:
    if not isinstance(name, str):
        raise TypeError(f"name: is the name of one of the {collection}, not {name!r}")
    return f"{collection}/{name}" + ("" if revision is None else f"/revisions/{revision}")


class AsyncTrack:
    """A stream that follows a camera. `step` sends a frame and returns its answer, `follow` does so for many.

    A stream that is cut (the server was restarted, the network was gone for a moment) is opened again by the token of
    its last answer, and the frames since then are sent again. The map pose goes on, and the odometry frame begins anew.
    `resumed` counts how often that was done. `resume_token`, and `last_sequence`, the number of the last frame, carry
    the stream on in another program. `start` says what the server chose. One stream is for one thread, or one task, at
    a time.
    """

    def __init__(
        self,
        method: Any,
        metadata: list[tuple[str, str]],
        config: odometry_pb2.TrackConfig,
        last_sequence: int,
        deadline_s: float | None,
    ) -> None:
        self._method = method
        self._deadline_s = deadline_s
        self._metadata = metadata
        self._config = config
        self.last_sequence = last_sequence
        # What was answered since the last token, and what has no answer yet: both are sent again when a stream is cut.
        self._unsaved: deque[odometry_pb2.TrackRequest] = deque(maxlen=MOST_UNSAVED)
        self._awaited: deque[odometry_pb2.TrackRequest] = deque()
        self._call: Any = None
        self._is_cut = False
        self._requests: asyncio.Queue[odometry_pb2.TrackRequest | None] = asyncio.Queue()
        self._is_busy = False
        self.start: TrackStart | None = None
        self.resume_token = config.resume_token
        self.resumed = 0

    async def __aenter__(self) -> AsyncTrack:
        try:
            await self._keep_trying(self._open)
        except BaseException:
            await self.aclose()
            raise
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await self.aclose()

    async def aclose(self) -> None:
        """Ends the stream."""
        if self._call is not None:
            await self._requests.put(None)
            self._call.cancel()
            self._call = None

    async def step(
        self,
        view: View,
        timestamp_ns: int,
        *,
        sequence: int | None = None,
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
        frame = self._frame(view, timestamp_ns, sequence, odometry, gravity, other_views, inertial, exposure_ns, depth)
        await self._drain()
        await self._send(frame)
        return await self._receive(channel.timeout(deadline_s))

    async def follow(
        self, frames: AsyncIterable[tuple[int, View]], *, ahead: int = 0
    ) -> AsyncIterator[TrackUpdate | TrackRefusal]:
        """The answers to frames, each a time in nanoseconds and a view, in the order of the frames.

        `ahead` frames are sent before the answer to the first of them is awaited: 0 for a camera, whose next frame is
        not there yet; some 16 for a recording, which is then followed faster than frame by frame. Frames that were sent
        ahead have been seen: after a loop that was left early, the stream goes on behind them. A camera that may be
        faster than the server is wrapped in `Newest`, or `AsyncNewest`: frames are then skipped, and none is late.
        """
        if ahead < 0:
            raise ValueError(f"ahead: {ahead} is below 0")
        await self._drain()

        async for timestamp_ns, view in frames:
            await self._send(self._frame(view, timestamp_ns))
            if len(self._awaited) > ahead:
                yield await self._receive()
        while self._awaited:
            yield await self._receive()

    async def set_initial_pose(self, pose: InitialPose) -> None:
        """Tells where the camera is now."""
        message = odometry_pb2.SetInitialPose(initial_pose=pose.message())
        refusal = await self._exchange(odometry_pb2.TrackRequest(set_initial_pose=message))
        if refusal is not None:
            raise errors.InvalidFieldError(refusal.message, code="INVALID_ARGUMENT", reason="POSE")

    async def reset(self) -> None:
        """Starts anew: the camera has to be found again."""
        await self._exchange(odometry_pb2.TrackRequest(reset=odometry_pb2.Reset()))

    async def _open(self) -> None:
        """Opens the stream, by its token if it has one, and sends again what was answered since then."""
        self._is_cut = True
        await self._requests.put(None)
        self._requests = asyncio.Queue()
        outgoing = self._outgoing(self._requests)
        self._call = self._method(outgoing, metadata=self._metadata)
        self._answers = self._call.__aiter__()

        config = odometry_pb2.TrackConfig(resume_token=self.resume_token) if self.resume_token else self._config
        await self._requests.put(odometry_pb2.TrackRequest(config=config))
        answer = await self._next_answer(self._deadline_s)
        self.start = TrackStart.of(answer.started)
        self.resume_token = answer.resume_token or self.resume_token
        for request in list(self._unsaved):
            await self._requests.put(request)
            await self._next_answer(self._deadline_s)
        self._is_cut = False

    async def _outgoing(
        self, queue: asyncio.Queue[odometry_pb2.TrackRequest | None]
    ) -> AsyncIterator[odometry_pb2.TrackRequest]:
        while (request := await queue.get()) is not None:
            yield request

    async def _next_answer(self, deadline_s: float | None) -> odometry_pb2.TrackResponse:
        timer = channel.AsyncTimer(self._call, deadline_s)
        try:
            answer: odometry_pb2.TrackResponse = await anext(self._answers)
        except StopAsyncIteration:
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
        sequence: int | None = None,
        odometry: Odometry | None = None,
        gravity: Gravity | None = None,
        other_views: dict[str, View] | None = None,
        inertial: InertialSamples | None = None,
        exposure_ns: int = 0,
        depth: DepthImage | None = None,
    ) -> odometry_pb2.TrackRequest:
        number = self.last_sequence + 1 if sequence is None else sequence
        frame = requests.track_frame(
            view, timestamp_ns, number, odometry, gravity, other_views or {}, inertial, exposure_ns, depth
        )
        self.last_sequence = number
        return frame

    async def _exchange(self, request: odometry_pb2.TrackRequest) -> TrackRefusal | None:
        """Sends what is no frame; returns what the server refuses of it."""
        await self._drain()
        await self._send(request)
        said = await self._receive()
        return said if isinstance(said, TrackRefusal) else None

    async def _drain(self) -> None:
        """Receives the answers left over from a `follow` that was left early."""
        while self._awaited:
            await self._receive()

    async def _send(self, request: odometry_pb2.TrackRequest) -> None:
        if self._call is None:
            raise errors.SeeseError("the stream is not open: use it as `with client.track(…) as track`")
        if self._is_cut:
            await self._keep_trying(self._open_again)
        self._awaited.append(request)
        await self._requests.put(request)

    async def _receive(self, deadline_s: float | None = None) -> TrackUpdate | TrackRefusal:
        """What the server says of the oldest request that has no answer yet."""
        if self._is_busy:
            raise errors.SeeseError("the stream waits for an answer already: one stream is for one thread or task")
        self._is_busy = True
        try:
            answer = await self._answer(deadline_s)
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
        answered = max(1, answer.refusal.frames) if answer.HasField("refusal") else 1
        for _ in range(min(answered, len(self._awaited))):
            self._unsaved.append(self._awaited.popleft())
        self._note(answer)
        return said

    def _understood(self, answer: odometry_pb2.TrackResponse) -> TrackUpdate | TrackRefusal:
        """What an answer says; it has to be that of the oldest request without one."""
        if answer.HasField("refusal"):
            return TrackRefusal.of(answer.refusal)
        asked, update = self._awaited[0], answer.update
        if asked.HasField("frame") and update.sequence != asked.frame.sequence:
            raise errors.AnswerError(
                f"the server answered frame {update.sequence} where frame {asked.frame.sequence} was sent"
            )
        return TrackUpdate.of(update)

    def _forget_awaited(self) -> None:
        # A number that is never sent would count as a frame that is missing.
        for request in reversed(self._awaited):
            if request.HasField("frame"):
                self.last_sequence = request.frame.sequence - 1
        self._awaited.clear()

    async def _answer(self, deadline_s: float | None) -> odometry_pb2.TrackResponse:
        try:
            return await self._next_answer(deadline_s)
        except errors.UnavailableError:
            answer: odometry_pb2.TrackResponse = await self._keep_trying(self._answer_again)
            return answer

    async def _open_again(self) -> None:
        await self._open()
        self.resumed += 1

    async def _answer_again(self) -> odometry_pb2.TrackResponse:
        await self._open_again()
        for request in self._awaited:
            await self._requests.put(request)
        return await self._next_answer(self._deadline_s)

    async def _keep_trying(self, what: Callable[[], Any]) -> Any:
        wait_s = FIRST_WAIT_S
        for attempt in range(RESUMPTIONS + 1):
            try:
                return await what()
            except (errors.UnavailableError, errors.BusyError) as error:
                if attempt == RESUMPTIONS:
                    raise
                await asyncio.sleep(max(wait_s, getattr(error, "retry_after_s", None) or 0.0))
                wait_s *= 2
