"""Newest-frame mode. Oracles: by hand, which items a slow reader sees of a fast source."""

import asyncio
import threading
import time
from collections.abc import AsyncIterator, Iterator

import pytest
import seese3

PERIOD_S = 0.01
COUNT = 60


def camera() -> Iterator[int]:
    begun = time.monotonic()
    for number in range(COUNT):
        time.sleep(max(0.0, begun + number * PERIOD_S - time.monotonic()))
        yield number


def test_a_slow_reader_does_not_fall_behind() -> None:
    begun = time.monotonic()
    newest = seese3.Newest(camera())
    seen, lags = [], []
    for number in newest:
        lags.append(time.monotonic() - begun - number * PERIOD_S)
        seen.append(number)
        time.sleep(5 * PERIOD_S)
    # The first and the last are seen, in order, and those between are seen or counted.
    assert seen[0] <= 1 and seen[-1] == COUNT - 1
    assert seen == sorted(set(seen))
    assert newest.dropped == COUNT - len(seen) > 0
    # Read one by one, the last of 60 would come 2.4 s late.
    assert max(lags) < 1.0


def test_an_error_of_the_source_comes_after_the_last_item() -> None:
    def failing() -> Iterator[int]:
        yield 1
        raise OSError("no camera")

    newest = seese3.Newest(failing())
    assert next(newest) == 1
    for _ in range(2):
        with pytest.raises(OSError, match="no camera"):
            next(newest)


def test_a_closed_one_ends() -> None:
    newest = seese3.Newest(camera())
    assert next(newest) >= 0
    newest.close()
    assert list(newest) == []


def test_every_item_of_a_slow_source_is_seen() -> None:
    released = threading.Semaphore(0)

    def source() -> Iterator[int]:
        for number in range(5):
            released.acquire()
            yield number

    newest = seese3.Newest(source())
    seen = []
    for _ in range(5):
        released.release()
        seen.append(next(newest))
    assert seen == [0, 1, 2, 3, 4] and newest.dropped == 0
    assert list(newest) == []


def test_the_asynchronous_one_is_alike() -> None:
    async def source(count: int) -> AsyncIterator[int]:
        for number in range(count):
            yield number
            await asyncio.sleep(0)
        if count == 3:
            raise OSError("no camera")

    async def read() -> None:
        newest = seese3.AsyncNewest(source(20))
        seen = []
        async for number in newest:
            seen.append(number)
            await asyncio.sleep(PERIOD_S)
        assert seen[-1] == 19 and newest.dropped == 20 - len(seen) > 0
        with pytest.raises(OSError, match="no camera"):
            async for _ in seese3.AsyncNewest(source(3)):
                pass
        endless = seese3.AsyncNewest(source(10**9))
        assert await anext(endless) >= 0
        await endless.aclose()
        assert [number async for number in endless] == []
        unstarted = seese3.AsyncNewest(source(10**9))
        await unstarted.aclose()
        assert [number async for number in unstarted] == []

    asyncio.run(read())
