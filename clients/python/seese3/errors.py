"""What can go wrong, as exceptions. All are `SeeseError`; every call that fails raises a `RefusedError`.

The reasons and their codes are listed in docs/errors.md of the repository. Each class of the most frequent reasons also
is what Python programs expect: a `ValueError`, `LookupError`, `TimeoutError`, `ConnectionError` or `PermissionError`.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable
from typing import Any, ParamSpec, TypeVar

import grpc
from google.protobuf.message import DecodeError
from google.rpc import error_details_pb2, status_pb2

# The longest wait that a server may ask for, seconds.
LONGEST_RETRY_S = 60.0

P = ParamSpec("P")
T = TypeVar("T")


class SeeseError(Exception):
    """Everything that this package raises on purpose."""


class AnswerError(SeeseError):
    """An answer of the server cannot be understood: it is damaged, or the server is newer than this package."""


class DamagedError(SeeseError, ValueError):
    """A file of a store is truncated or altered."""


class CommandError(SeeseError):
    """The program ended with an error. `returncode` is its exit code, `stderr` what it said."""

    def __init__(self, command: list[str], returncode: int, stderr: str) -> None:
        super().__init__(f"seese3 {' '.join(command)}: exit code {returncode}\n{stderr.strip()}")
        self.command = command
        self.returncode = returncode
        self.stderr = stderr


class RefusedError(SeeseError):
    """A call failed.

    - `code`: the gRPC code, for instance "INVALID_ARGUMENT".
    - `reason`: the server's reason, for instance "INVALID_FIELD"; None if the call never reached the server.
    - `field`: the path of the request field to change, for instance "view.feature"; None if there is none.
    - `retry_after_s`: how long the server asks to wait before the same call; None if it says nothing.
    - `request_id`: the id under which the server's log has the call; None if it is not known.
    """

    def __init__(
        self,
        message: str,
        *,
        code: str,
        reason: str | None = None,
        field: str | None = None,
        retry_after_s: float | None = None,
        request_id: str | None = None,
    ) -> None:
        super().__init__(message)
        self.message = message
        self.code = code
        self.reason = reason
        self.field = field
        self.retry_after_s = retry_after_s
        self.request_id = request_id


class InvalidFieldError(RefusedError, ValueError):
    """A field of the request has a value that is not accepted; `field` names it."""


class NotFoundError(RefusedError, LookupError):
    """A room, an adapter or a frame of this name is not there."""


class ExistsError(RefusedError, ValueError):
    """An upload would replace a room or an adapter with other content."""


class PreconditionError(RefusedError):
    """The request is right, and what the server holds does not allow it."""


class BusyError(RefusedError):
    """As much as the server takes is waiting or open."""


class ConflictError(RefusedError):
    """Somebody else changed the same thing meanwhile: make the change again."""


class ForbiddenError(RefusedError, PermissionError):
    """There is no valid credential, or it does not allow this."""


class DeadlineError(RefusedError, TimeoutError):
    """No answer came within the deadline."""


class UnavailableError(RefusedError, ConnectionError):
    """The server cannot be reached, is loading its store, or is stopping."""


CLASSES: dict[grpc.StatusCode, type[RefusedError]] = {
    grpc.StatusCode.INVALID_ARGUMENT: InvalidFieldError,
    grpc.StatusCode.OUT_OF_RANGE: InvalidFieldError,
    grpc.StatusCode.NOT_FOUND: NotFoundError,
    grpc.StatusCode.ALREADY_EXISTS: ExistsError,
    grpc.StatusCode.FAILED_PRECONDITION: PreconditionError,
    grpc.StatusCode.RESOURCE_EXHAUSTED: BusyError,
    grpc.StatusCode.ABORTED: ConflictError,
    grpc.StatusCode.UNAUTHENTICATED: ForbiddenError,
    grpc.StatusCode.PERMISSION_DENIED: ForbiddenError,
    grpc.StatusCode.DEADLINE_EXCEEDED: DeadlineError,
    grpc.StatusCode.UNAVAILABLE: UnavailableError,
}


def understood(convert: Callable[P, T]) -> Callable[P, T]:
    """The conversion of an answer, which raises `AnswerError` where the answer is malformed."""

    @functools.wraps(convert)
    def converted(*args: P.args, **kwargs: P.kwargs) -> T:
        try:
            return convert(*args, **kwargs)
        except (ValueError, TypeError, LookupError, AttributeError, OverflowError) as error:
            raise AnswerError(f"an answer of the server cannot be understood: {error}") from error

    return converted


def refused(error: Any) -> RefusedError:
    """The exception of a `grpc.RpcError`, with what the server said of it."""
    code: grpc.StatusCode = error.code()
    message: str = printable(error.details() or code.name)
    if code is grpc.StatusCode.UNAVAILABLE and not _metadata(error, "grpc-status-details-bin"):
        message = f"the server cannot be reached: {message}; is it running, and is its address right?"

    details = _details(error)
    return CLASSES.get(code, RefusedError)(
        message, code=code.name, request_id=_text(_metadata(error, "x-request-id")), **details
    )


def printable(text: str) -> str:
    """Text of a server without what could change what a terminal shows."""
    return "".join(character if character.isprintable() else " " for character in text)


def refused_part(status: status_pb2.Status) -> RefusedError:
    """The exception of one request of a batch, with what the server said of it."""
    for code in grpc.StatusCode:
        if code.value[0] == status.code:
            return CLASSES.get(code, RefusedError)(printable(status.message), code=code.name, **_details_of(status))
    return RefusedError(printable(status.message), code=str(status.code), **_details_of(status))


def _metadata(error: Any, key: str) -> bytes | str | None:
    for metadata in (error.trailing_metadata(), error.initial_metadata()):
        pairs: Iterable[tuple[str, bytes | str]] = metadata or ()
        for name, value in pairs:
            if name == key:
                return value
    return None


def _text(value: bytes | str | None) -> str | None:
    return value.decode("ascii", "replace") if isinstance(value, bytes) else value


def _details(error: Any) -> dict[str, Any]:
    packed = _metadata(error, "grpc-status-details-bin")
    if not isinstance(packed, bytes):
        return {}

    try:
        return _details_of(status_pb2.Status.FromString(packed))
    except DecodeError:
        return {}


def _details_of(status: status_pb2.Status) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for detail in status.details:
        for kind in (
            error_details_pb2.ErrorInfo,
            error_details_pb2.BadRequest,
            error_details_pb2.ResourceInfo,
            error_details_pb2.RetryInfo,
        ):
            message = kind()
            try:
                is_known = detail.Unpack(message)
            except DecodeError:
                continue
            if is_known:
                _note(message, found)
    return found


def _note(detail: Any, found: dict[str, Any]) -> None:
    if isinstance(detail, error_details_pb2.ErrorInfo):
        found["reason"] = detail.reason
    elif isinstance(detail, error_details_pb2.BadRequest) and detail.field_violations:
        found["field"] = detail.field_violations[0].field
    elif isinstance(detail, error_details_pb2.RetryInfo):
        delay_s = detail.retry_delay.seconds + detail.retry_delay.nanos * 1e-9
        found["retry_after_s"] = min(max(delay_s, 0.0), LONGEST_RETRY_S)
