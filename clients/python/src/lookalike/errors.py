"""Everything that can go wrong. Each message says what, where, and what to do."""

from __future__ import annotations

from dataclasses import dataclass

import grpc
from google.rpc import error_details_pb2
from grpc_status import rpc_status

#: Domain of the `google.rpc.ErrorInfo` in every answer of a server.
DOMAIN = "lookalike"
#: The answers that are worth another try: the server is about to restart, or its database or objects
#: are away for a moment.
SHUTTING_DOWN, AWAY = "SHUTTING_DOWN", "AWAY"

_TRANSIENT = {
    grpc.StatusCode.UNAVAILABLE,
    grpc.StatusCode.UNKNOWN,
    grpc.StatusCode.CANCELLED,
    grpc.StatusCode.DEADLINE_EXCEEDED,
    grpc.StatusCode.INTERNAL,
    grpc.StatusCode.ABORTED,
}


class LookalikeError(Exception):
    """Any error of this package."""


class Unreachable(LookalikeError):
    """No server answers."""


class ServerNotStarted(LookalikeError):
    """A server of one's own did not come up."""


class ProtocolFault(LookalikeError):
    """The server broke a promise of the protocol."""


class Damaged(LookalikeError):
    """A file arrived with other bytes than the server has."""


class Refused(LookalikeError):
    """The server answered no.

    `code` is the gRPC status, `reason` a stable upper-snake-case code such as INVALID or NOT_FOUND,
    `faults` every faulty field of the request with its text.
    """

    def __init__(self, answer: Answer) -> None:
        lines = [f"{field}: {text}" for field, text in answer.faults]
        super().__init__("\n".join(lines) or answer.text)
        self.code = answer.code
        self.reason = answer.reason
        self.faults = dict(answer.faults)


class JobFailed(LookalikeError):
    """The job is at fault. `reason` is a stable code, `text` what, where, and what to do."""

    def __init__(self, job: str, reason: str, text: str) -> None:
        super().__init__(f"{job} failed: {reason}: {text}")
        self.job = job
        self.reason = reason
        self.text = text


class JobCancelled(LookalikeError):
    """Somebody cancelled the job. Files that were finished before can be fetched."""

    def __init__(self, job: str) -> None:
        super().__init__(f"{job} was cancelled; `Client.fetch` has the files finished before")
        self.job = job


@dataclass(frozen=True)
class Answer:
    """What a failed call tells: an answer of a server, or (no `reason`) a broken connection."""

    code: grpc.StatusCode
    text: str
    reason: str
    faults: tuple[tuple[str, str], ...]

    @property
    def is_transient(self) -> bool:
        """Whether the same call may work in a moment."""
        return self.reason in (SHUTTING_DOWN, AWAY) if self.reason else self.code in _TRANSIENT

    @staticmethod
    def read(error: grpc.RpcError) -> Answer:
        """Reads the status and its details."""
        code, text = error.code(), error.details() or ""
        info, faults = error_details_pb2.ErrorInfo(), error_details_pb2.BadRequest()
        try:
            status = rpc_status.from_call(error)
        except ValueError:
            # Details that contradict the status: not from a Lookalike server.
            status = None
        for detail in status.details if status else ():
            # Each leaves its message untouched when the detail is of another type.
            detail.Unpack(info)
            detail.Unpack(faults)
        reason = info.reason if info.domain == DOMAIN else ""
        violations = tuple((v.field, v.description) for v in faults.field_violations)
        return Answer(code, text, reason, violations)


def unreachable(url: str, why: str) -> Unreachable:
    """No server answers at `url`."""
    return Unreachable(
        f"no server answers at {url} ({why}): start one with `lookalike serve --data-dir DIR`, "
        "or name the URL of another"
    )
