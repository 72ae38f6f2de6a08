"""A server of one's own, as a child process: for notebooks, examples and tests."""

from __future__ import annotations

import os
import select
import shutil
import subprocess
import time
from collections.abc import Iterable
from pathlib import Path

from lookalike import errors

_START_SECS = 30.0


class Server:
    """`lookalike serve` on a free port of this machine, until the `with` block ends.

    `binary` defaults to `lookalike` on the PATH. What the server logs is in `{data_dir}.log`.
    `flags` are further flags of `lookalike serve`.
    """

    def __init__(
        self,
        data_dir: str | os.PathLike[str],
        binary: str | os.PathLike[str] = "lookalike",
        *,
        workers: int = 1,
        device: str = "auto",
        flags: Iterable[str] = (),
    ) -> None:
        self.data_dir = Path(data_dir)
        self.log = self.data_dir.with_name(f"{self.data_dir.name}.log")
        #: Where it listens, once it has started. Stays the same when it is started again.
        self.url = "http://127.0.0.1:0"
        self._binary = os.fspath(binary)
        self._flags = [f"--workers={workers}", f"--device={device}", *flags]
        self._process: subprocess.Popen[bytes] | None = None

    def start(self) -> None:
        """Starts the server and returns when it listens."""
        program = shutil.which(self._binary)
        if program is None:
            raise errors.ServerNotStarted(
                f"{self._binary} is no program: build it with `cargo build --release`, "
                "and give its path"
            )
        command = [program, "serve", f"--data-dir={self.data_dir}"]
        command += [f"--listen={self.url.removeprefix('http://')}", "--metrics-listen=127.0.0.1:0"]
        with self.log.open("ab") as log:
            self._process = subprocess.Popen(
                command + self._flags, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=log
            )
        line = self._first_line(self._process)
        if not line.startswith("listening on "):
            self.kill()
            last = self.log.read_text(errors="replace").strip().splitlines()[-3:]
            raise errors.ServerNotStarted("\n".join([f"{program} did not start:", *last]))
        self.url = line.removeprefix("listening on ").strip()

    def stop(self, timeout_secs: float = 20.0) -> None:
        """Asks the server to end: workers hand their jobs back. Kills it when it takes too long."""
        if self._process is not None:
            self._process.terminate()
            try:
                self._process.wait(timeout_secs)
            except subprocess.TimeoutExpired:
                pass
            self.kill()

    def kill(self) -> None:
        """Kills the server, as a power cut would. `start` brings it back under the same URL."""
        if self._process is not None:
            self._process.kill()
            self._process.wait()
            if self._process.stdout is not None:
                self._process.stdout.close()
            self._process = None

    def workers(self) -> list[int]:
        """Process ids of the server's own workers (on Linux)."""
        if self._process is None:
            return []
        pid = self._process.pid
        found = Path(f"/proc/{pid}/task").glob("*/children")
        return sorted(int(child) for path in found for child in path.read_text().split())

    def __enter__(self) -> Server:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    @staticmethod
    def _first_line(process: subprocess.Popen[bytes]) -> str:
        """The first line of the output; empty when there is none in time."""
        assert process.stdout is not None
        end, text = time.monotonic() + _START_SECS, b""
        while not text.endswith(b"\n") and (left := end - time.monotonic()) > 0:
            if select.select([process.stdout], [], [], left)[0]:
                chunk = os.read(process.stdout.fileno(), 4096)
                if not chunk:
                    break
                text += chunk
        return text.decode(errors="replace")
