"""How a client connects: TLS, tokens, message sizes, and which calls are made again when a server does not answer.

Reads are made again after UNAVAILABLE and RESOURCE_EXHAUSTED, as often as `retries` says, each time after a longer
wait.
Changes of the catalog carry a request id, with which a server gives the same change the same answer, so that they are
made again too. Uploads and other streams are not: a tracking stream resumes by its token instead (see `Track`).
"""

from __future__ import annotations

import asyncio
import json
import threading
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import grpc

# A page of frames with thumbnails, or a batch of answers, may be larger than the 4 MiB that gRPC allows by itself.
MESSAGE_BYTES = 64 << 20

# A server that answers nothing at all while calls are open is given up after so long, milliseconds: a machine that was
# switched off says no goodbye, and a stream without a deadline would wait for it for ever.
SILENCE_MS = 10_000
PING_ANSWER_MS = 10_000

# What a call raises that was cancelled here; only the asynchronous client's calls do.
CancelledError = asyncio.CancelledError

# How long an attempt to connect may take, and the longest wait before the next one, milliseconds. gRPC's own are 20 s
# and 2 minutes, in which a robot is long past a server that came back.
CONNECTING_MS = 2_000

# Longer deadlines than this, a year, are none: gRPC takes them for ones that have passed.
LONGEST_S = 3.2e7

RETRIED = {
    "CatalogService": (
        "ListRooms",
        "GetRoom",
        "ListFrames",
        "ListAdapters",
        "GetAdapter",
        "GetServerInfo",
        "SetDefault",
        "ClearDefault",
        "DeleteRoom",
        "DeleteAdapter",
    ),
    "NavigationService": ("Navigate", "BatchNavigate", "PlanRoute"),
    "LocalizationService": ("Localize", "Relocalize"),
    "OdometryService": ("EstimateMotion", "Encode"),
    "EvaluationService": ("ScorePredictions", "ListPairs"),
}


@dataclass(frozen=True)
class Tls:
    """Certificates in PEM files: whom to trust, and who the client is, if the server asks for that.

    Without `authorities`, those that gRPC brings along are trusted.
    """

    authorities: Path | str | None = None
    certificate: Path | str | None = None
    key: Path | str | None = None


def _credentials(tls: Tls) -> grpc.ChannelCredentials:
    if (tls.certificate is None) != (tls.key is None):
        raise ValueError("tls: a client's certificate and its key belong together; give both or neither")

    def content(path: Path | str | None) -> bytes | None:
        return None if path is None else Path(path).read_bytes()

    return grpc.ssl_channel_credentials(content(tls.authorities), content(tls.key), content(tls.certificate))


def _options(retries: int) -> list[tuple[str, Any]]:
    methods = [
        {"service": f"seese3.v1.{service}", "method": method} for service, names in RETRIED.items() for method in names
    ]
    policy = {
        "maxAttempts": retries + 1,
        "initialBackoff": "0.1s",
        "maxBackoff": "2s",
        "backoffMultiplier": 3,
        "retryableStatusCodes": ["UNAVAILABLE", "RESOURCE_EXHAUSTED"],
    }
    config = {"methodConfig": [{"name": methods, "retryPolicy": policy}]} if retries else {}
    return [
        ("grpc.service_config", json.dumps(config)),
        ("grpc.enable_retries", int(retries > 0)),
        ("grpc.initial_reconnect_backoff_ms", 100),
        ("grpc.min_reconnect_backoff_ms", CONNECTING_MS),
        ("grpc.max_reconnect_backoff_ms", CONNECTING_MS),
        ("grpc.keepalive_time_ms", SILENCE_MS),
        ("grpc.keepalive_timeout_ms", PING_ANSWER_MS),
        ("grpc.http2.ping_timeout_ms", PING_ANSWER_MS),
        ("grpc.http2.max_pings_without_data", 0),
        ("grpc.max_receive_message_length", MESSAGE_BYTES),
        ("grpc.max_send_message_length", MESSAGE_BYTES),
    ]


def _check(address: str, retries: int) -> None:
    if not isinstance(address, str):
        raise TypeError(f"address: is HOST:PORT as text, not {address!r}")
    host, colon, port = address.rpartition(":")
    is_port = port.isascii() and port.isdigit() and 0 < int(port) < 1 << 16
    if "://" in address or not (colon and host and is_port):
        raise ValueError(f"address: {address!r} is no server address; write HOST:PORT, for instance 127.0.0.1:50051")
    if not isinstance(retries, int) or not 0 <= retries <= 4:
        raise ValueError(f"retries: {retries!r} is not 0 to 4")


def metadata(token: str | None) -> list[tuple[str, str]]:
    """What is sent with every call."""
    if not token:
        return []
    if not (token.isascii() and token.isprintable()) or " " in token:
        raise ValueError("token: has a character that no token has, such as a space or the end of a line")
    return [("authorization", f"Bearer {token}")]


class SyncTimer:
    """Cancels a call after `deadline_s` seconds, unless it is stopped before; None is never."""

    def __init__(self, call: Any, deadline_s: float | None) -> None:
        self.is_over = False
        self._call = call
        self._timer: Any = None
        if deadline_s is not None:
            self._timer = self._started(deadline_s)

    def _started(self, deadline_s: float) -> Any:
        timer = threading.Timer(deadline_s, self._end)
        timer.daemon = True
        timer.start()
        return timer

    def _end(self) -> None:
        self.is_over = True
        self._call.cancel()

    def stop(self) -> None:
        if self._timer is not None:
            self._timer.cancel()


class AsyncTimer(SyncTimer):
    """The same on the event loop."""

    def _started(self, deadline_s: float) -> Any:
        return asyncio.get_running_loop().call_later(deadline_s, self._end)


def timeout(deadline_s: float | None) -> float | None:
    """The seconds as gRPC takes them; None, infinity and centuries are for ever."""
    if deadline_s is None or deadline_s > LONGEST_S:
        return None
    if not deadline_s >= 0:
        raise ValueError(f"deadline_s: {deadline_s} is no number of seconds")
    return deadline_s


def open_sync(address: str, tls: Tls | None, retries: int) -> Any:
    """A channel for the synchronous client."""
    _check(address, retries)
    if tls is None:
        return grpc.insecure_channel(address, _options(retries))
    return grpc.secure_channel(address, _credentials(tls), _options(retries))


def open_async(address: str, tls: Tls | None, retries: int) -> Any:
    """A channel for the asynchronous client."""
    import grpc.aio

    _check(address, retries)
    if tls is None:
        return grpc.aio.insecure_channel(address, _options(retries))
    return grpc.aio.secure_channel(address, _credentials(tls), _options(retries))
