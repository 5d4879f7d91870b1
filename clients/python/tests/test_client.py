"""Every call against the real server."""

import hashlib
import re
import secrets
import shutil
import subprocess
import time
from pathlib import Path

import numpy as np
import pytest
import seese3
from conftest import FEATURES, ROOM, ROOMS
from seese3 import NavigationQuery
from seese3.v1 import catalog_pb2, evaluation_pb2, localization_pb2, navigation_pb2, odometry_pb2


def test_every_call_of_the_protocol_has_a_method() -> None:
    source = Path(seese3.client.__file__).read_text()  # type: ignore[attr-defined]
    modules = (catalog_pb2, evaluation_pb2, localization_pb2, navigation_pb2, odometry_pb2)
    services = [service for module in modules for service in module.DESCRIPTOR.services_by_name.values()]
    calls = [method.name for service in services for method in service.methods]
    assert len(calls) >= 20
    missing = [name for name in calls if not re.search(rf'\.{name}\b|"{name}"', source)]
    assert missing == []


def cv2_pixels(image: Path) -> np.ndarray:
    """The pixels of an image in the order red, green, blue."""
    import cv2

    return np.ascontiguousarray(cv2.imread(str(image))[:, :, ::-1])


def test_the_catalog(client: seese3.Client, drawn: Path) -> None:
    assert [room.name for room in client.rooms()] == list(ROOMS)
    room = client.room(ROOM)
    assert room.frame_count == 120 and room.adapters == ("robot",)
    # Encoding published a second revision; the first has the features of the studio alone.
    assert (room.name, room.revision) == (ROOM, 2)
    assert client.room(ROOM, revision=1).revision == 1
    with pytest.raises(seese3.NotFoundError):
        client.room(ROOM, revision=9)

    info = client.server_info()
    assert info.version == seese3.__version__ and info.encodes_images and not info.writable
    assert info.encoders[0].adapters == ("robot",) and info.limits["top_k"] >= 1

    stored = seese3.Store(drawn).room(ROOM)
    frames = client.frames(ROOM, neighbors_within=0.2)
    np.testing.assert_allclose(frames.poses, stored.poses, atol=1e-12)
    assert frames.neighbors is not None
    near, motion = frames.neighbors[60][0]
    # The motion is log(P₁⁻¹P₂): of frames so near its translation is that of the relative pose, to a hundredth.
    relative = np.linalg.inv(stored.poses[60]) @ stored.poses[near]
    np.testing.assert_allclose(motion[:3], relative[:3, 3], atol=0.01)

    adapter = client.adapter("robot")
    assert adapter.split == "whole" and adapter.test.overall is None
    assert {room.name for room in adapter.calibration_rooms} == set(ROOMS[1:])


def test_navigation(client: seese3.Client) -> None:
    answer = client.navigate(ROOM, 20, to=30, steps=2, step_mode="snap")
    assert len(answer.steps) == 2 and answer.step_mode == "snap" and answer.inverse_variant == "homogeneous"
    assert answer.steps[-1].error is not None and answer.steps[-1].error.twist_norm > 0

    # The same motion as a twist leads to the same frame.
    assert client.navigate(ROOM, 20, twist=answer.motion, steps=2, step_mode="snap").frame.id == answer.frame.id

    queries = [NavigationQuery(20, to=30, steps=2, step_mode="snap"), NavigationQuery(20, to=9999)]
    batch = client.navigate_batch(ROOM, queries)
    assert isinstance(batch[0], seese3.Navigation) and batch[0].frame.id == answer.frame.id
    assert isinstance(batch[1], seese3.NotFoundError)
    # The error of a query has what the query alone would get.
    assert (batch[1].reason, batch[1].field) == ("NOT_SERVED", "motion.target_frame_id")

    route = client.plan_route(ROOM, 5, goal=60)
    assert route.outcome == "found" and len(route.hops) > 1
    at = route.start.pose
    for hop in route.hops:
        at = at @ seese3.exp_se3(hop.motion)
    np.testing.assert_allclose(at, route.hops[-1].frame.pose, atol=1e-9)
    assert route.hops[-1].distance_remaining_m <= 0.25
    nowhere = np.eye(4)
    nowhere[0, 3] = 100.0
    assert client.plan_route(ROOM, 5, goal_pose=nowhere).outcome == "goal_not_mapped"

    with pytest.raises(ValueError, match="exactly one of"):
        client.navigate(ROOM, 5)
    with pytest.raises(ValueError, match="step_mode: 'leap' is none of open_loop, snap, closed_loop"):
        client.navigate(ROOM, 5, to=6, step_mode="leap")  # type: ignore[arg-type]
    # The words of the command line are understood too.
    assert client.navigate(ROOM, 5, to=6, step_mode="closed-loop").step_mode == "closed_loop"  # type: ignore[arg-type]


def test_localization_of_features_and_images(client: seese3.Client, drawn: Path) -> None:
    room = seese3.Store(drawn).room(ROOM)
    assert room.images is not None
    pixels = cv2_pixels(room.images[33])
    views = (room.features[FEATURES][33], room.images[33], str(room.images[33]), room.images[33].read_bytes(), pixels)
    for view in views:
        found = client.localize(view, rooms=ROOM, top_k=3)
        assert found.frames[0].frame.id == 33 and len(found.frames) == 3
        # A mapped view lies within the room's limit, and its pose is known to some centimeters.
        assert found.pose is not None and found.novelty is not None and found.novelty < 1
        assert found.room.name == ROOM and found.method in ("fitted_adapter", "similar_frames")
        assert np.linalg.norm(found.pose[:3, 3] - room.poses[33][:3, 3]) < 0.05
        assert found.covariance is not None and found.covariance.shape == (6, 6)

    # A feature with its columns in another order is that of no image, though some frame is nearest.
    strange = client.localize(room.features[FEATURES][33][::-1], rooms=ROOM)
    assert strange.pose is None and strange.method is None and len(strange.frames) == 1
    assert strange.novelty is not None and strange.novelty > 1
    assert strange.reason is not None and "not in the map" in strange.reason

    # A batch has the answers of its queries alone, and the exceptions of those that fail.
    queries = [seese3.LocalizationQuery(room.features[FEATURES][33], ROOM), seese3.LocalizationQuery(1, "nowhere")]
    batch = client.localize_batch(queries)
    assert isinstance(batch[0], seese3.Localization) and batch[0].pose is not None and batch[0].exact
    np.testing.assert_array_equal(batch[0].pose, client.localize(views[0], rooms=ROOM).pose)
    assert isinstance(batch[1], seese3.NotFoundError) and batch[1].field == "rooms[0]"
    with pytest.raises(ValueError, match=r"queries\[0\]: top_k"):
        client.localize_batch([seese3.LocalizationQuery(1, ROOM, top_k=-1)])

    stored = client.localize(33, rooms=ROOM)
    assert stored.method == "recorded" and stored.pose is not None
    np.testing.assert_allclose(stored.pose, room.poses[33], atol=1e-9)
    with pytest.raises(ValueError, match="must be a Camera or"):
        client.localize(room.images[33], rooms=ROOM, camera="other")

    views = list(room.features[FEATURES][30:34])
    placed = client.relocalize(views)
    assert placed.rooms[0].room.name == ROOM
    assert placed.rooms[0].covariance is not None and placed.rooms[0].covariance.shape == (6, 6)
    # Of a room that is searched alone there is no second one to compare with.
    assert client.relocalize(views, rooms=[ROOM]).margin is None


def test_motions_and_latents(client: seese3.Client, drawn: Path) -> None:
    rows = seese3.Store(drawn).room(ROOM).features[FEATURES]
    encoding = client.encode([3, rows[9]], room=ROOM, with_features=True)
    assert encoding.features is not None and encoding.features[0] is None
    np.testing.assert_array_equal(encoding.features[1].values, rows[9])  # type: ignore[union-attr]

    by_rows = client.motion(3, 9, room=ROOM)
    # A latent names its adapter, and one that does not needs it beside it.
    by_latents = client.motion(encoding.latent(0), encoding.latent(1))
    bare = [seese3.Latent(values) for values in encoding.latents]
    with pytest.raises(seese3.InvalidFieldError, match="adapter"):
        client.motion(*bare, room=ROOM)
    np.testing.assert_array_equal(client.motion(*bare, adapter="robot").twist, by_latents.twist)
    np.testing.assert_allclose(by_rows.twist, by_latents.twist, atol=1e-9)
    assert by_rows.true_motion is not None and by_latents.true_motion is None and by_rows.covariance is None


def test_evaluation_and_predictions_of_ones_own(client: seese3.Client, drawn: Path) -> None:
    # The only adapter was trained on every frame: it is not evaluated unless it is named, and then says so.
    with pytest.raises(seese3.InvalidFieldError, match="held-out") as leaks:
        client.evaluate(ROOM)
    assert leaks.value.field == "adapter"

    progress: list[tuple[int, int]] = []
    report = client.evaluate(
        ROOM, adapter="robot", stride=10, on_progress=lambda done, total: progress.append((done, total))
    )
    scores = {one.name: one for one in report.navigators}
    assert scores["oracle"].hit(0.1).value == 1.0 and progress
    np.testing.assert_allclose(scores["oracle"].thresholds, [0.1, 0.2, 0.3, 0.5])
    with pytest.raises(KeyError):
        scores["oracle"].hit(0.15)
    table = report.table()
    assert list(table.index) == list(scores) and table.loc["oracle", "hit@0.1"] == 1.0
    baselines = {"identity", "random", "oracle"}
    assert report.leaks
    assert [name for name in table.index if table.loc[name, "leak"] != "LEAK"] == [
        name for name in table.index if name in baselines
    ]
    assert len(report.plot().lines) == len(scores)

    # A navigator that stays where it is scores what the identity scores, by the same pairs.
    pairs = client.split_pairs(ROOM, "whole", 10)
    sources, targets = pairs.test.T
    np.testing.assert_array_equal(targets - sources, 10)
    mine = client.score(
        ROOM, sources=sources, targets=targets, frames=sources, adapter="robot", split="whole", name="stay"
    )
    both = report.with_navigator(mine)
    assert [one.name for one in both.navigators][-1] == "stay" and mine.navigators[0].latent_r2 is None
    np.testing.assert_array_equal(both.navigators[-1].hits, scores["identity"].hits)
    assert [over and over.value for over in mine.navigators[0].over_identity] == [0.0] * len(mine.navigators[0].hits)
    assert set(scores["identity"].over_identity) == {None}
    over = scores["random"].over_identity[0]
    assert over is not None and over.low <= over.value <= over.high
    np.testing.assert_allclose(over.value, scores["random"].hits[0] - scores["identity"].hits[0], atol=1e-12)
    assert both.table().loc["random", "over_identity@0.1"] == over.value
    # Frames do not depend on the adapter, and its latents have seen the pairs.
    assert both.table().loc["stay", "leak"] == ""
    with pytest.raises(ValueError, match="different pairs: pair_count"):
        report.with_navigator(
            client.score(ROOM, predictions=[seese3.Prediction(0, 10, frame=0)], adapter="robot", split="whole")
        )
    with pytest.raises(ValueError, match="'stay' is in both"):
        both.with_navigator(mine)
    with pytest.raises(seese3.InvalidFieldError, match="twice"):
        client.score(ROOM, predictions=[seese3.Prediction(0, 10, frame=0)] * 2, adapter="robot")

    # By latents, the frames that are retrieved are those nearest to the targets' own latents: the targets.
    latents = client.encode(list(range(10, 20)), room=ROOM).latents
    exact = client.score(ROOM, range(10), range(10, 20), latents, adapter="robot")
    assert exact.navigators[0].top1.value == 1.0 and exact.stride == 10 and exact.split is None
    assert exact.navigators[0].leaks and exact.leaks
    for arrays in ({"targets": [1]}, {"sources": [1], "targets": [2, 3], "frames": [1]}, {"sources": [0.5]}):
        with pytest.raises(ValueError):
            client.score(ROOM, **arrays)  # type: ignore[arg-type]


def test_errors_say_which_field_and_why(client: seese3.Client) -> None:
    with pytest.raises(seese3.InvalidFieldError) as error:
        client.localize(np.zeros(3), rooms=ROOM)
    assert (error.value.field, error.value.reason) == ("view.feature.values", "INVALID_FIELD")
    assert isinstance(error.value, ValueError) and error.value.request_id

    with pytest.raises(seese3.NotFoundError, match="did you mean") as missing:
        client.room("studio7-000")
    assert missing.value.reason == "NOT_SERVED" and isinstance(missing.value, LookupError)

    with pytest.raises(seese3.DeadlineError):
        client.evaluate(ROOM, adapter="robot", deadline_s=1e-4)
    with pytest.raises(seese3.PreconditionError):
        client.delete_room(ROOM)


def test_no_server_is_said_so() -> None:
    with pytest.raises(seese3.UnavailableError, match="is it running"), seese3.Client("127.0.0.1:1", retries=0) as none:
        none.rooms()
    for address in ("localhost", "http://127.0.0.1:50051", ":50051", "host:port"):
        with pytest.raises(ValueError, match="HOST:PORT"):
            seese3.Client(address)


def test_reads_are_made_again_until_the_server_is_there(drawn: Path) -> None:
    with seese3.serve(drawn) as first:
        address = first.address
    # Nobody listens now; a server comes back while the client waits.
    with seese3.Client(address, retries=4) as client:
        begun = subprocess.Popen(
            [seese3.program.program(), "serve", "--store", drawn, "--listen", address], stdout=subprocess.DEVNULL
        )
        try:
            last = time.monotonic() + 30
            while True:
                try:
                    assert len(client.rooms()) == 3
                    break
                except seese3.UnavailableError:
                    assert time.monotonic() < last
        finally:
            begun.terminate()
            begun.wait()


def test_changes_of_the_catalog(store: Path) -> None:
    room = seese3.Store(store).room(ROOM)
    source, rows = room.sources[FEATURES], room.features[FEATURES]
    first, rest = slice(0, 80), slice(80, None)
    with seese3.serve(store, "--writable") as server, server.client(deadline_s=60) as client:
        upload = seese3.Upload(room.poses[first], [(source, rows[first])])
        assert client.server_info().writable
        assert client.upload_room("copy", upload, validate_only=True).revision is None
        made = client.upload_room("copy", upload)
        assert made.created and made.served and client.room("copy").frame_count == 80
        assert not client.upload_room("copy", upload).created

        # Nothing is replaced unasked.
        more = seese3.Upload(room.poses[rest], [(source, rows[rest])])
        with pytest.raises(seese3.ExistsError, match="exists in revision 1"):
            client.upload_room("copy", more)
        with pytest.raises(seese3.NotFoundError):
            client.upload_room("nowhere", more, mode="replace")
        assert client.upload_room("copy", more, mode="extend").revision.revision == 2
        np.testing.assert_array_equal(seese3.Store(store).room("copy").features[FEATURES], rows)

        # What is downloaded is what was uploaded.
        copy = client.download_room("copy")
        assert (copy.room.name, copy.room.revision) == ("copy", 2)
        np.testing.assert_array_equal(copy.features[FEATURES], rows)
        np.testing.assert_allclose(copy.poses, room.poses, atol=1e-12)
        assert len(client.download_room("copy", revision=1).poses) == 80
        described = client.room("copy")
        assert described.extent is not None and described.duration_s is None
        np.testing.assert_allclose(described.extent[0], room.poses[:, :3, 3].min(axis=0), atol=1e-12)

        manifest, weights = client.download_adapter("robot")
        assert (manifest, weights) == seese3.Store(store).adapter_files("robot")
        assert client.upload_adapter("again", manifest, weights).served
        assert "again" in [adapter.name for adapter in client.adapters()]

        # A default can be cleared, and names are those that other methods take.
        client.set_default(room=ROOM, adapter="again")
        assert client.clear_default(adapter_of_room=ROOM) == []

        done: list[int] = []
        fitted = client.fit_adapter("copy", feature_set=FEATURES, on_progress=lambda n, _: done.append(n))
        assert fitted.created and done
        defaults = client.set_default(room="copy", adapter="again")
        assert defaults == [seese3.CatalogDefault(room="copy", adapter="again")]
        assert seese3.CatalogDefault(adapter="again", revision=1) in client.set_default(adapter="again", revision=1)
        assert seese3.CatalogDefault(adapter="again", revision=1) in client.defaults()
        client.clear_default(adapter="again")
        assert client.room("copy").adapters[0] == "again"
        assert client.set_default(room="copy", revision=1) and client.room("copy").frame_count == 80
        assert client.room("copy", revision=2).frame_count == 120
        assert client.frames("copy", room_revision=2).poses.shape[0] == 120
        client.clear_default(room="copy")
        assert client.room("copy").frame_count == 120
        client.clear_default(adapter_of_room="copy")

        assert client.delete_room("copy", revision=1) == [1]
        client.delete_adapter(fitted.revision.name)
        assert client.delete_room("copy") == [2]
        assert client.delete_adapter("again") == [1]
        assert [one.name for one in client.rooms()] == list(ROOMS)


def test_unfit_uploads_are_refused_before_they_are_sent() -> None:
    source = seese3.FeatureSource("mine", 3)
    with pytest.raises(ValueError, match="poses: are"):
        seese3.Upload(np.eye(4))
    with pytest.raises(ValueError, match=r"'mine' is \(2, 3\)"):
        seese3.Upload(np.tile(np.eye(4), (2, 1, 1)), [(source, np.zeros((3, 3)))])
    two = np.tile(np.eye(4), (2, 1, 1))
    for argument, values, problem in (
        ("names", ["one"], "names: has 1"),
        ("names", ["one", 2], "names: row 1"),
        ("timestamps_ns", [0, 1.5], "timestamps_ns: row 1"),
        ("timestamps_ns", [0, 2**63], "timestamps_ns: row 1"),
        ("segments", [0, -1], "segments: row 1"),
        ("images", [b"", "x.jpg"], "images: row 1"),
        ("images", [b"", Path("/nowhere.jpg")], "is no file"),
    ):
        with pytest.raises(ValueError, match=problem):
            seese3.Upload(two, **{argument: values})


def test_tokens_and_tls(drawn: Path, tmp_path: Path) -> None:
    if shutil.which("openssl") is None:
        pytest.skip("openssl is not there to make a certificate")
    key, certificate = tmp_path / "key.pem", tmp_path / "cert.pem"
    request = ["openssl", "req", "-x509", "-newkey", "rsa:2048", "-nodes", "-keyout", key, "-out", certificate]
    names = ["-subj", "/CN=localhost", "-addext", "subjectAltName=IP:127.0.0.1", "-days", "2"]
    # Without this a certificate is one of an authority, which the server's library does not take as its own.
    names += ["-addext", "basicConstraints=critical,CA:FALSE"]
    subprocess.run([*request, *names], check=True, capture_output=True)

    token = secrets.token_hex(16)
    callers = tmp_path / "callers.toml"
    digest = hashlib.sha256(token.encode()).hexdigest()
    callers.write_text(f'[[principal]]\nname = "me"\ntoken_sha256 = "{digest}"\nverbs = ["catalog"]\nrooms = ["*"]\n')
    arguments = ["--tls-cert", certificate, "--tls-key", key, "--auth-file", callers]
    with seese3.serve(drawn, *arguments) as server:
        tls = seese3.Tls(authorities=certificate)
        with server.client(tls=tls, token=token) as client:
            assert len(client.rooms()) == 3
        with seese3.Client(server.address, tls=tls) as client, pytest.raises(seese3.ForbiddenError) as error:
            client.rooms()
        assert error.value.reason == "UNAUTHENTICATED"
        with server.client(tls=tls, token=token) as client, pytest.raises(seese3.ForbiddenError) as error:
            client.localize(0, rooms=ROOM)
        assert error.value.reason == "FORBIDDEN"
        with seese3.Client(server.address, retries=0) as client, pytest.raises(seese3.UnavailableError):
            client.rooms()


def test_a_command_that_fails_says_why(tmp_path: Path) -> None:
    with pytest.raises(seese3.CommandError, match="does not exist") as error:
        seese3.run("evaluate", "--store", tmp_path / "none", "--room", "kitchen")
    assert error.value.returncode == 1
    with pytest.raises(seese3.CommandError, match="does not exist"):
        seese3.serve(tmp_path / "none")


def test_arguments_that_are_none_are_refused_by_their_names(client: seese3.Client) -> None:
    for ask, problem in (
        (lambda: client.navigate(ROOM, -1, to=2), "frame's row"),
        (lambda: client.navigate(ROOM, 1, to=-2), "to: -2"),
        (lambda: client.navigate(ROOM, 1, to=2, steps=-1), "steps: -1"),
        (lambda: client.navigate(ROOM, 1, twist=0), "twist: is"),
        (lambda: client.navigate(ROOM, 1, twist=np.zeros(6, complex)), "complex"),
        (lambda: client.navigate_batch(ROOM, [NavigationQuery(1, to=2), NavigationQuery(1)]), r"queries\[1\]"),
        (lambda: client.localize(1, rooms=ROOM, deadline_s=float("nan")), "deadline_s"),
        (lambda: client.track(resume_token=b"x"), "last_sequence"),
        (lambda: client.set_default(revision=3), "room and adapter"),
        (lambda: seese3.Prediction(1, 2), "exactly one"),
        (lambda: seese3.Camera(640, 480, float("inf")), "focal length"),
        (lambda: seese3.Camera(640, 480, 525, distortion=[0.1]), "distortion has 1 coefficients"),
        (lambda: seese3.Camera(640, 480, 525, distortion_model="fov"), "distortion_model 'fov'"),
        (lambda: seese3.Client("127.0.0.1:99999"), "no server address"),
        (lambda: seese3.Client("127.0.0.1:1", token="a\nb"), "token"),
    ):
        with pytest.raises(ValueError, match=problem):
            ask()
    with pytest.raises(TypeError, match="views: is a sequence"):
        client.encode(b"an image")

    # For ever, and not a deadline that has passed.
    assert client.localize(1, rooms=ROOM, deadline_s=float("inf")).frames[0].frame.id == 1
    client.close()
    with pytest.raises(seese3.SeeseError, match="closed"):
        client.rooms()


def test_a_program_that_says_strange_things_is_heard(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    program = tmp_path / "program"
    program.write_text("#!/bin/sh\nhead -c 200000 /dev/urandom >&2\necho done\n")
    program.chmod(0o755)
    monkeypatch.setenv("SEESE3", str(program))
    assert seese3.run("anything") == "done\n"

    # A server that never says where it listens is given up.
    program.write_text("#!/bin/sh\nsleep 60\n")
    monkeypatch.setattr(seese3.program, "LOADING_S", 0.3)
    with pytest.raises(seese3.SeeseError, match="did not say"):
        seese3.serve(tmp_path)
