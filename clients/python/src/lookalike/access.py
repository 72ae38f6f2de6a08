"""Channels to a server, in the clear or under TLS, and calls that say who makes them."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import urlsplit

import grpc

File = str | os.PathLike[str] | None


def channel(
    url: str, options: Sequence[tuple[str, Any]], *, ca: File, cert: File, key: File
) -> grpc.Channel:
    """A channel to `url`; reads the files of certificates that it needs."""
    parts = urlsplit(url)
    if parts.scheme not in ("http", "https") or not parts.netloc or parts.path not in ("", "/"):
        raise ValueError(
            f"{url!r} is no server address: use a URL such as http://127.0.0.1:7420 or https://HOST:7420"
        )
    if (cert is None) != (key is None):
        raise ValueError("a client certificate needs its key: give both cert and key")
    if parts.scheme == "http":
        return grpc.insecure_channel(parts.netloc, options=options)
    read = [None if file is None else Path(file).read_bytes() for file in (ca, key, cert)]
    credentials = grpc.ssl_channel_credentials(*read)
    return grpc.secure_channel(parts.netloc, credentials, options=options)


def saying_who(channel: grpc.Channel, token: str | None) -> grpc.Channel:
    """The same channel; its calls carry `token`, if there is one."""
    return grpc.intercept_channel(channel, _Bearer(token)) if token else channel


class _Details(NamedTuple):
    method: str
    timeout: float | None
    metadata: Sequence[tuple[str, str]] | None
    credentials: grpc.CallCredentials | None
    wait_for_ready: bool | None
    compression: grpc.Compression | None


class _CallDetails(_Details, grpc.ClientCallDetails):
    """What gRPC wants a call's details to be."""


class _Bearer(
    grpc.UnaryUnaryClientInterceptor,
    grpc.UnaryStreamClientInterceptor,
    grpc.StreamUnaryClientInterceptor,
):
    """Adds the token to every kind of call that this client makes."""

    def __init__(self, token: str) -> None:
        self._header = ("authorization", f"Bearer {token}")

    def _add(self, call: Callable[..., Any], details: Any, request: Any) -> Any:
        metadata = [*(details.metadata or ()), self._header]
        fields = {name: getattr(details, name, None) for name in _Details._fields}
        return call(_CallDetails(**{**fields, "metadata": metadata}), request)

    intercept_unary_unary = _add
    intercept_unary_stream = _add
    intercept_stream_unary = _add
