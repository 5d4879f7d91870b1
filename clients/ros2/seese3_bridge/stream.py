"""One Track stream: requests in, answers out, by however many calls it takes."""

import queue
import threading

from seese3.v1 import odometry_pb2, odometry_pb2_grpc

# So many requests wait for the server; the oldest goes when another comes.
WAITING = 8


class Stream:
    """Frames in, answers out; goes on with the last token when the server goes away."""

    def __init__(self, channel, config):
        self.stub, self.config, self.token = odometry_pb2_grpc.OdometryServiceStub(channel), config, b""
        self.frames, self.lock = queue.Queue(maxsize=WAITING), threading.Lock()

    def requests(self, frames):
        resumed = odometry_pb2.TrackConfig(resume_token=self.token)
        yield odometry_pb2.TrackRequest(config=resumed if self.token else self.config)
        while (request := frames.get()) is not None:
            yield request

    def offer(self, request):
        """Takes a request; whether the oldest that waited went, because there was no room."""
        with self.lock:
            is_full = self.frames.full()
            if is_full:
                self.frames.get_nowait()
            self.frames.put_nowait(request)
            return is_full

    def begin(self):
        """A queue for a new call, with what waits for one: an old call must not take a new one's frames."""
        with self.lock:
            waiting, self.frames = self.frames, queue.Queue(maxsize=WAITING)
            while not waiting.empty():
                if (request := waiting.get_nowait()) is not None:
                    self.frames.put_nowait(request)
            return self.frames

    def answers(self):
        """Answers until the call ends."""
        frames = self.begin()
        try:
            for answer in self.stub.Track(self.requests(frames)):
                self.token = answer.resume_token or self.token
                yield answer
        finally:
            # Ends the requests of the call that is over; what waits is for the next one.
            with self.lock:
                waiting = queue.Queue(maxsize=WAITING)
                while not frames.empty():
                    waiting.put_nowait(frames.get_nowait())
                frames.put_nowait(None)
                if self.frames is frames:
                    self.frames = waiting
