"""The asynchronous client gives what the synchronous one gives, which is made from it."""

import asyncio
import os
import signal
from pathlib import Path

import numpy as np
import pytest
import seese3
from conftest import FEATURES, ROOM


def test_both_clients_answer_alike(server: seese3.Server, client: seese3.Client, drawn: Path) -> None:
    rows = seese3.Store(drawn).room(ROOM).features[FEATURES]

    async def ask() -> tuple[list[int], list[str], int, list[str | None], seese3.Evaluation]:
        async with seese3.AsyncClient(server.address) as asynchronous:
            calls = [asynchronous.navigate(ROOM, row, to=row + 10) for row in range(20)]
            ends = [answer.frame.id for answer in await asyncio.gather(*calls)]
            names = [room.name for room in await asynchronous.rooms()]
            route = await asynchronous.plan_route(ROOM, 5, goal=60)

            async with asynchronous.track(seese3.TrackConfig(room=ROOM)) as track:
                updates = [await track.step(feature, row * 33_000_000) for row, feature in enumerate(rows[:20])]
            statuses = [getattr(update, "status", None) for update in updates]
            report = await asynchronous.evaluate(ROOM, adapter="robot", stride=10)

            with pytest.raises(seese3.InvalidFieldError) as error:
                await asynchronous.localize(np.zeros(3), rooms=ROOM)
            assert error.value.field == "view.feature.values"
            return ends, names, len(route.hops), statuses, report

    ends, names, steps, statuses, report = asyncio.run(ask())
    assert ends == [client.navigate(ROOM, row, to=row + 10).frame.id for row in range(20)]
    assert names == [room.name for room in client.rooms()]
    assert steps == len(client.plan_route(ROOM, 5, goal=60).hops)
    with client.track(seese3.TrackConfig(room=ROOM)) as track:
        updates = [track.step(feature, row * 33_000_000) for row, feature in enumerate(rows[:20])]
    assert statuses == [getattr(update, "status", None) for update in updates]
    assert report.table().equals(client.evaluate(ROOM, adapter="robot", stride=10).table())


def test_an_upload_is_sent_by_the_asynchronous_client_too(store: Path) -> None:
    room = seese3.Store(store).room(ROOM)
    upload = seese3.Upload(room.poses, [(room.sources[FEATURES], room.features[FEATURES])])

    async def send(address: str) -> seese3.answers.Publication:
        async with seese3.AsyncClient(address) as client:
            return await client.upload_room("copy", upload)

    with seese3.serve(store, "--writable") as server:
        assert asyncio.run(send(server.address)).served


def test_a_step_that_is_given_up_did_not_happen(drawn: Path) -> None:
    rows = seese3.Store(drawn).room(ROOM).features[FEATURES][:30]

    async def follow(server: seese3.Server, given_up: int | None) -> list[np.ndarray | None]:
        poses = []
        async with seese3.AsyncClient(server.address) as client, client.track(seese3.TrackConfig(room=ROOM)) as track:
            for row, feature in enumerate(rows):
                if row == given_up:
                    server._process.send_signal(signal.SIGSTOP)
                    os.waitpid(server._process.pid, os.WUNTRACED)
                    with pytest.raises(asyncio.TimeoutError):
                        await asyncio.wait_for(track.step(feature, row * 33_000_000), 0.2)
                    server._process.send_signal(signal.SIGCONT)
                    assert track.last_sequence_number == given_up, "its number is not used up"
                update = await track.step(feature, row * 33_000_000)
                assert isinstance(update, seese3.TrackUpdate)
                poses.append(update.camera.map_pose)
            assert track.resumed == (given_up is not None)
        return poses

    with seese3.serve(drawn) as server:
        resumed, whole = asyncio.run(follow(server, 15)), asyncio.run(follow(server, None))
    assert resumed[-1] is not None and whole[-1] is not None
    np.testing.assert_allclose(resumed[-1], whole[-1], atol=0.05)
