"""Tracking streams, and that a stream which is cut goes on as if it had not been."""

import os
import signal
import threading
from pathlib import Path

import numpy as np
import pytest
import seese3
from conftest import FEATURES, ROOM
from seese3 import channel

PERIOD_NS = 33_333_333


def followed(track: seese3.Track, rows: np.ndarray, start: int = 0) -> list[seese3.TrackUpdate]:
    updates = []
    for row, feature in enumerate(rows, start):
        update = track.step(feature, row * PERIOD_NS)
        assert isinstance(update, seese3.TrackUpdate)
        updates.append(update)
    return updates


def poses_of(updates: list[seese3.TrackUpdate]) -> np.ndarray:
    unknown = np.full((4, 4), np.nan)
    return np.array([unknown if one.camera.map_pose is None else one.camera.map_pose for one in updates])


def is_near(found: list[seese3.TrackUpdate], expected: list[seese3.TrackUpdate]) -> None:
    """A resumed stream has nearly the map poses of one that was not cut, where both have one."""
    ends = poses_of(found)[:, :3, 3] - poses_of(expected)[:, :3, 3]
    assert np.nanmax(np.linalg.norm(ends, axis=1)) < 0.05


def test_a_camera_is_followed(client: seese3.Client, drawn: Path) -> None:
    room = seese3.Store(drawn).room(ROOM)
    # The room was recorded in two visits, and a camera cannot jump from one to the other.
    assert room.segments is not None
    first_visit = int((room.segments == 0).sum())
    config = seese3.TrackConfig(room=ROOM, initial_pose=seese3.InitialPose(room.poses[0]))
    with client.track(config) as track:
        updates = followed(track, room.features[FEATURES][:first_visit])
        refused = track.step(room.features[FEATURES][0], 0)
    assert [one.sequence_number for one in updates] == list(range(1, first_visit + 1))
    assert {one.status for one in updates[10:]} == {"tracking"}

    # The frames are the map's own: whoever finds the nearest frame knows the pose.
    errors = np.linalg.norm(poses_of(updates)[:, :3, 3] - room.poses[:first_visit, :3, 3], axis=1)
    assert np.median(errors) < 0.05
    assert updates[-1].camera.map_covariance is not None and updates[-1].base is None
    assert isinstance(refused, seese3.TrackRefusal) and refused.reason == "late"


def test_a_stream_that_is_cut_goes_on_as_if_it_had_not_been(drawn: Path, tmp_path: Path) -> None:
    key = tmp_path / "key"
    key.write_bytes(bytes(range(32)))
    rows = seese3.Store(drawn).room(ROOM).features[FEATURES][:60]
    arguments = ("--token-key-file", key)
    config = seese3.TrackConfig(room=ROOM, token_every=7)

    with seese3.serve(drawn, *arguments) as server, server.client() as client, client.track(config) as track:
        whole = followed(track, rows)
        assert track.resumed == 0

    first = seese3.serve(drawn, *arguments)
    with first.client() as client, client.track(config) as track:
        updates = followed(track, rows[:30])
        first.stop()
        with seese3.serve(drawn, *arguments, listen=first.address):
            updates += followed(track, rows[30:], start=30)
            assert track.resumed >= 1
            token = track.resume_token
            assert token

    np.testing.assert_array_equal(poses_of(updates)[:30], poses_of(whole)[:30])
    is_near(updates, whole)
    assert updates[-1].status == whole[-1].status


def test_a_server_that_stands_still_is_given_up(drawn: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(channel, "SILENCE_MS", 500)
    monkeypatch.setattr(channel, "PING_ANSWER_MS", 500)
    monkeypatch.setattr(seese3.client, "RESUMPTIONS", 0)
    monkeypatch.setattr(channel, "CONNECTING_MS", 500)
    rows = seese3.Store(drawn).room(ROOM).features[FEATURES][:3]
    with seese3.serve(drawn) as server, server.client() as client:
        with client.track(seese3.TrackConfig(room=ROOM)) as track:
            followed(track, rows[:2])
            server._process.send_signal(signal.SIGSTOP)
            os.waitpid(server._process.pid, os.WUNTRACED)
            try:
                with pytest.raises(seese3.UnavailableError):
                    track.step(rows[2], 2 * PERIOD_NS)
            finally:
                server._process.send_signal(signal.SIGCONT)


def test_a_recording_is_followed_ahead_of_its_answers(drawn: Path, tmp_path: Path) -> None:
    key = tmp_path / "key"
    key.write_bytes(bytes(range(32)))
    rows = seese3.Store(drawn).room(ROOM).features[FEATURES][:60]
    frames = [(row * PERIOD_NS, feature) for row, feature in enumerate(rows)]
    config = seese3.TrackConfig(room=ROOM, token_every=7)

    server = seese3.serve(drawn, "--token-key-file", key)
    with server.client() as client:
        with client.track(config) as track:
            whole = followed(track, rows)
        with client.track(config) as track:
            ahead = list(track.follow(iter(frames), ahead=16))
        with client.track(config) as track:
            # One answer is taken, and the rest of those on their way are left.
            next(iter(track.follow(iter(frames[:20]), ahead=16)))
            after = followed(track, rows[20:], start=20)

        # The server is another one in the middle, while frames are on their way.
        with client.track(config) as track:
            answers = track.follow(iter(frames), ahead=16)
            cut = [next(answers) for _ in range(10)]
            server.stop()
            with seese3.serve(drawn, "--token-key-file", key, listen=server.address):
                cut += answers
            assert track.resumed >= 1

    for updates in (ahead, cut):
        assert [one.sequence_number for one in updates] == list(range(1, 61))
        is_near(updates, whole)
    np.testing.assert_array_equal(poses_of(ahead), poses_of(whole))
    # 17 frames had been sent; nobody asked for the answers to 16 of them, and the stream knows them all the same.
    assert after[0].sequence_number == 18


def test_newer_frames_that_take_the_place_of_older_ones_are_counted(client: seese3.Client, drawn: Path) -> None:
    """One refusal stands for all frames that were superseded: whoever waits for an answer to each waits for ever."""
    rows = seese3.Store(drawn).room(ROOM).features[FEATURES]
    frames = [(row * PERIOD_NS, feature) for row, feature in enumerate(rows)]
    with client.track(seese3.TrackConfig(room=ROOM, newest_only=True)) as track:
        answers = list(track.follow(iter(frames), ahead=64))
        assert track.start is not None and track.start.adapter is not None
        assert track.start.adapter.name == "robot"
    refused = sum(one.frame_count for one in answers if isinstance(one, seese3.TrackRefusal))
    assert refused + sum(isinstance(one, seese3.TrackUpdate) for one in answers) == len(frames)
    assert answers[-1].sequence_number == len(frames)


def test_a_token_carries_a_stream_to_another_client(server: seese3.Server, drawn: Path) -> None:
    rows = seese3.Store(drawn).room(ROOM).features[FEATURES][:40]
    with server.client() as client, client.track(seese3.TrackConfig(room=ROOM)) as track:
        whole = followed(track, rows)
    with server.client() as client, client.track(seese3.TrackConfig(room=ROOM)) as track:
        followed(track, rows[:20])
        token, sent = track.resume_token, track.last_sequence_number
    assert sent == 20
    with server.client() as client, client.track(resume_token=token, last_sequence_number=sent) as track:
        rest = followed(track, rows[20:], start=20)
    is_near(rest, whole[20:])
    # The odometry begins anew.
    np.testing.assert_allclose(rest[0].camera.odom_pose[:3, 3], 0, atol=0.1)


def test_what_a_stream_refuses(client: seese3.Client) -> None:
    with pytest.raises(seese3.NotFoundError), client.track(seese3.TrackConfig(room="nowhere")):
        pass
    with pytest.raises(ValueError, match="token_every"):
        client.track(seese3.TrackConfig(room=ROOM, token_every=0))
    with pytest.raises(ValueError, match="exactly one"):
        client.track()
    with pytest.raises(ValueError, match="ahead"), client.track(seese3.TrackConfig(room=ROOM)) as track:
        list(track.follow(iter([]), ahead=-1))
    # A stream that is refused leaves no thread behind.
    threads = threading.active_count()
    for _ in range(5):
        with pytest.raises(seese3.NotFoundError), client.track(seese3.TrackConfig(room="nowhere")):
            pass
    assert threading.active_count() <= threads + 1
    with client.track(seese3.TrackConfig(room=ROOM)) as track:
        refused = track.step(np.zeros(3), 0)
        assert isinstance(refused, seese3.TrackRefusal) and refused.reason == "view"
        track.reset()
        with pytest.raises(seese3.InvalidFieldError):
            track.set_initial_pose(seese3.InitialPose(np.eye(4), position_deviation_m=-1.0))


def test_a_camera_is_followed_with_an_inertial_sensor(client: seese3.Client, drawn: Path) -> None:
    room = seese3.Store(drawn).room(ROOM)
    sensor = seese3.InertialSensor(np.eye(4), gyroscope_noise=1e-3, time_offset_ns=1_000_000)
    config = seese3.TrackConfig(
        room=ROOM, initial_pose=seese3.InitialPose(room.poses[0]), inertial_sensor=sensor, trust_odometry=True
    )
    # A sensor that says the opposite of the views: it turns by 2 rad/s, and they by far less.
    rate, up = np.tile([0.0, 2.0, 0.0], (5, 1)), np.tile([0.0, 0.0, 9.8], (5, 1))
    noise = np.diag([1e-4] * 6)
    with client.track(config) as track:
        assert track.start is not None and not track.start.has_visual_odometry
        for row in range(20):
            begins = max(row - 1, 0) * PERIOD_NS - 1_000_000
            samples = seese3.InertialSamples(begins + np.arange(5) * (PERIOD_NS // 5), rate, up)
            wheels = seese3.Odometry(room.poses[row], velocity_covariance=noise)
            moved = None if row == 0 else samples
            update = track.step(
                room.features[FEATURES][row], row * PERIOD_NS, odometry=wheels, inertial=moved, exposure_ns=2_000_000
            )
            assert isinstance(update, seese3.TrackUpdate), update
        assert update.contradicted == ("inertial",)

        # Samples that are known already are left out; samples out of order are refused.
        again = track.step(room.features[FEATURES][20], 20 * PERIOD_NS, inertial=samples)
        assert isinstance(again, seese3.TrackUpdate)
        reverse = seese3.InertialSamples(21 * PERIOD_NS - np.arange(5), rate, up)
        refused = track.step(room.features[FEATURES][21], 21 * PERIOD_NS, inertial=reverse)
        assert isinstance(refused, seese3.TrackRefusal) and refused.reason == "inertial"
    with pytest.raises(ValueError, match=r"angular_velocity.*\(5, 3\)"):
        seese3.InertialSamples(np.arange(5), rate[:4], up).messages()
