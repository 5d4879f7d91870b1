"""Newest-frame mode: a camera that is faster than the server skips frames instead of falling behind."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import AsyncIterable, AsyncIterator, Iterable, Iterator
from typing import Generic, TypeVar

T = TypeVar("T")


class Newest(Generic[T]):
    """Iterates over the newest items of `source`, which a thread reads as fast as it gives them.

        newest = seese3.Newest(camera())                  # yields (timestamp_ns, image)
        for update in track.follow(newest):
            ...

    An item that a newer one replaces before it is asked for is dropped, and counted in `dropped`. The last item is
    always returned. An exception of the source is raised here, after the last item. The thread is a daemon thread. It
    ends with the source, or at its next item after `close`.
    """

    def __init__(self, source: Iterable[T]) -> None:
        self.dropped = 0
        self._waiting: list[T] = []
        self._error: BaseException | None = None
        self._is_over = False
        self._changed = threading.Condition()
        threading.Thread(target=self._read, args=(source,), daemon=True).start()

    def _read(self, source: Iterable[T]) -> None:
        try:
            for item in source:
                with self._changed:
                    if self._is_over:
                        return
                    self.dropped += len(self._waiting)
                    self._waiting[:] = [item]
                    self._changed.notify()
        except BaseException as error:
            self._error = error
        finally:
            with self._changed:
                self._is_over = True
                self._changed.notify()

    def close(self) -> None:
        """Ends the iteration, and the reading at the next item of the source."""
        with self._changed:
            self._is_over = True
            self._waiting.clear()
            self._changed.notify()

    def __iter__(self) -> Iterator[T]:
        return self

    def __next__(self) -> T:
        with self._changed:
            self._changed.wait_for(lambda: self._waiting or self._is_over)
            if self._waiting:
                return self._waiting.pop()
        if self._error is not None:
            raise self._error
        raise StopIteration


class AsyncNewest(Generic[T]):
    """Asynchronous counterpart of `Newest`. A task reads the source; `aclose` cancels it."""

    def __init__(self, source: AsyncIterable[T]) -> None:
        self.dropped = 0
        self._waiting: list[T] = []
        self._is_over = False
        self._changed = asyncio.Event()
        self._task = asyncio.ensure_future(self._read(source))

    async def _read(self, source: AsyncIterable[T]) -> None:
        try:
            async for item in source:
                self.dropped += len(self._waiting)
                self._waiting[:] = [item]
                self._changed.set()
        finally:
            self._is_over = True
            self._changed.set()

    async def aclose(self) -> None:
        """Ends the reading and the iteration."""
        self._task.cancel()
        await asyncio.gather(self._task, return_exceptions=True)
        self._waiting.clear()
        self._is_over = True
        self._changed.set()

    def __aiter__(self) -> AsyncIterator[T]:
        return self

    async def __anext__(self) -> T:
        while not self._waiting:
            if self._is_over:
                if not self._task.cancelled():
                    # Raises the exception of the source.
                    await self._task
                raise StopAsyncIteration
            await self._changed.wait()
            self._changed.clear()
        return self._waiting.pop()
