"""One Track stream: requests in, answers out, by however many calls it takes."""

import collections
import threading

from .v1 import odometry_pb2, stub

# Frames that may wait for the server; the oldest is dropped for another. Two, because a frame that waited for other
# cameras is offered together with the next one.
FRAMES = 2
# Requests other than frames, such as an initial pose, that may wait for the server; the oldest is dropped for another.
WAITING = 8
# Most inertial samples of a frame: the server's limit.
SAMPLES = 2_000


def keep_samples(dropped, following):
    """Gives the inertial samples of a dropped frame to the one that follows it."""
    samples = [*dropped.inertial_samples, *following.inertial_samples][-SAMPLES:]
    del following.inertial_samples[:]
    following.inertial_samples.extend(samples)


class Requests:
    """Requests that wait for the server, in order. Only the newest frames wait: none is sent late."""

    def __init__(self):
        self.waiting, self.changed, self.call = collections.deque(), threading.Condition(), 0

    def offer(self, request):
        """Adds a request; returns whether another was dropped for it."""
        is_frame = request.HasField("frame")
        with self.changed:
            alike = [other for other in self.waiting if other.HasField("frame") == is_frame]
            is_dropped = len(alike) >= (FRAMES if is_frame else WAITING)
            if is_dropped:
                self.waiting.remove(alike[0])
                if is_frame:
                    keep_samples(alike[0].frame, (alike[1:] or [request])[0].frame)
            self.waiting.append(request)
            self.changed.notify_all()
            return is_dropped

    def begin(self):
        """Begins a new call, and returns its number: an earlier call gets no more requests."""
        with self.changed:
            self.call += 1
            self.changed.notify_all()
            return self.call

    def of_call(self, call):
        """The requests of a call, until the next one begins."""
        while True:
            with self.changed:
                self.changed.wait_for(lambda: self.waiting or self.call != call)
                if self.call != call:
                    return
                request = self.waiting.popleft()
            yield request


class Stream:
    """Frames in, answers out; goes on with the last token when the server goes away."""

    def __init__(self, channel, config, metadata=()):
        self.stub, self.config, self.token = stub("OdometryService", channel), config, b""
        self.metadata = metadata
        self.requests = Requests()
        self.call, self.is_cancelled = None, False

    def offer(self, request):
        """Adds a request; returns whether another was dropped for it."""
        return self.requests.offer(request)

    def cancel(self):
        """Ends the current call."""
        self.is_cancelled = True
        self.requests.begin()
        if self.call is not None:
            self.call.cancel()

    def begin_anew(self):
        """Ends the current call; the next one begins with the configuration, and not with the last token."""
        self.token = b""
        self.cancel()

    def was_cancelled(self):
        """Whether the last call ended by `cancel`, which is then forgotten."""
        is_cancelled, self.is_cancelled = self.is_cancelled, False
        return is_cancelled

    def sent(self, call):
        resumed = odometry_pb2.TrackConfig(resume_token=self.token)
        yield odometry_pb2.TrackRequest(config=resumed if self.token else self.config)
        yield from self.requests.of_call(call)

    def answers(self):
        """Answers until the call ends."""
        call = self.requests.begin()
        self.is_cancelled = False
        self.call = self.stub.Track(self.sent(call), metadata=self.metadata)
        try:
            for answer in self.call:
                if not self.is_cancelled:
                    self.token = answer.resume_token or self.token
                yield answer
        finally:
            self.requests.begin()
