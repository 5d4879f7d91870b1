"""The program `seese3` from Python: `run` for its commands, `serve` for a server that a notebook asks.

The program is, in this order: the one that the environment variable SEESE3 names, the one that this package carries,
the one in the PATH.
"""

from __future__ import annotations

import atexit
import contextlib
import os
import queue
import shutil
import subprocess
import sys
import threading
import time
import urllib.request
from collections import deque
from pathlib import Path
from types import TracebackType

from .channel import Tls
from .client import Client
from .errors import CommandError, SeeseError

# How long a server may take to load its store, and to stop, seconds.
LOADING_S = 120.0
STOPPING_S = 30.0
KEPT_LINES = 200


def program() -> str:
    """The path of the program."""
    named = os.environ.get("SEESE3")
    carried = Path(__file__).parent / "bin" / "seese3"
    found = named or (str(carried) if carried.exists() else _in_path())
    if found is None:
        raise SeeseError(
            "the program seese3 is not there: install a wheel that carries it, put it in the PATH, or name it in the "
            "environment variable SEESE3"
        )
    return found


def _in_path() -> str | None:
    """The program in the PATH. The script of this package has the same name there, and would call itself for ever."""
    for folder in os.environ.get("PATH", "").split(os.pathsep):
        found = shutil.which("seese3", path=folder)
        if found and b"seese3.program" not in _beginning(Path(found)):
            return found
    return None


def _beginning(path: Path) -> bytes:
    with path.open("rb") as file:
        return file.read(2000)


def main() -> None:
    """The console script: hands everything to the program."""
    try:
        path = program()
    except SeeseError as error:
        sys.exit(f"seese3: {error}")
    os.execv(path, [path, *sys.argv[1:]])


def run(*arguments: object) -> str:
    """Runs a command of the program, for instance `run("train", "--store", "store")`, and returns what it printed.

    Progress and warnings go to standard error as they come. A command that fails raises a `CommandError`.
    """
    command = [str(argument) for argument in arguments]
    said: deque[str] = deque(maxlen=KEPT_LINES)
    # What is no UTF-8, such as the name of a file, is shown as it can be.
    with subprocess.Popen(
        [program(), *command],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        encoding="utf-8",
        errors="backslashreplace",
    ) as process:
        listener = threading.Thread(target=_pass_on, args=(process, said), daemon=True)
        listener.start()
        assert process.stdout is not None
        try:
            printed = process.stdout.read()
            returncode = process.wait()
        except BaseException:
            process.terminate()
            raise
        listener.join()

    if returncode != 0:
        raise CommandError(command, returncode, "".join(said))
    return printed


def _pass_on(process: subprocess.Popen[str], said: deque[str]) -> None:
    assert process.stderr is not None
    for line in process.stderr:
        said.append(line)
        # A program whose output nobody takes would wait for ever, so that every line is read, wherever it goes.
        with contextlib.suppress(Exception):
            sys.stderr.write(line)


class Server:
    """A server of a store on this machine, for as long as it is open: `with seese3.serve("store") as server`.

    Without `with`, it runs until `stop`, or until Python ends. A Python that a signal ends leaves it behind.
    """

    def __init__(self, process: subprocess.Popen[str], address: str, log: deque[str]) -> None:
        self._process = process
        self._log = log
        self.address = address
        atexit.register(self.stop)

    def __enter__(self) -> Server:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stop()

    def client(self, *, token: str | None = None, tls: Tls | None = None, deadline_s: float | None = 30.0) -> Client:
        """A client of this server."""
        return Client(self.address, token=token, tls=tls, deadline_s=deadline_s)

    @property
    def log(self) -> str:
        """The last lines of the server's log."""
        return "".join(self._log)

    def stop(self) -> None:
        """Lets the server finish what it is asked, and ends it."""
        atexit.unregister(self.stop)
        if self._process.poll() is None:
            self._process.terminate()
            try:
                self._process.wait(STOPPING_S)
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._process.wait()


def serve(store: str | Path, *arguments: object, listen: str = "127.0.0.1:0") -> Server:
    """Starts a server of a store, and returns when it has loaded it; `listen` with port 0 takes a free port.

    More `arguments` are those of `seese3 serve`, for instance "--encoder", "model.onnx", or "--writable".
    """
    words = [str(argument) for argument in arguments]
    if "--quiet" in words:
        raise ValueError("--quiet: a server that says nothing does not say where it listens")
    if not any(word.split("=")[0] == "--metrics-listen" for word in words):
        # This port says when the store is loaded, whether the other one asks for TLS and tokens or not.
        words += ["--metrics-listen", "127.0.0.1:0"]
    command = ["serve", "--store", str(store), "--listen", listen, *words]
    process = subprocess.Popen(
        [program(), *command],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        encoding="utf-8",
        errors="backslashreplace",
    )
    log: deque[str] = deque(maxlen=KEPT_LINES)
    said: queue.Queue[str | None] = queue.Queue()
    server = Server(process, "", log)
    last = time.monotonic() + LOADING_S
    try:
        threading.Thread(target=_listen, args=(process, log, said), daemon=True).start()
        server.address = _address(said, "listening on ", last)
        operations = _address(said, "metrics on ", last)
        _wait_until_ready(process, operations, last)
        if process.poll() is not None or not server.address:
            raise CommandError(command, process.wait(), server.log)
    except BaseException:
        server.stop()
        raise
    return server


def _listen(process: subprocess.Popen[str], log: deque[str], said: queue.Queue[str | None]) -> None:
    """Takes all that a server says, until it ends: one that nobody listens to would wait for ever."""
    assert process.stdout is not None
    with process.stdout:
        for line in process.stdout:
            log.append(line)
            said.put(line)
    said.put(None)


def _address(said: queue.Queue[str | None], label: str, last: float) -> str:
    """The rest of the first line that begins with the label; "" if the program ended before it."""
    while True:
        try:
            line = said.get(timeout=max(0.0, last - time.monotonic()))
        except queue.Empty:
            raise SeeseError(f"the server did not say {label.strip()!r} within {LOADING_S:g} s") from None
        if line is None:
            # For whoever asks for the next label.
            said.put(None)
            return ""
        if line.startswith(label):
            return line.removeprefix(label).strip()


def _wait_until_ready(process: subprocess.Popen[str], operations: str, last: float) -> None:
    # A proxy of the environment has nothing to do with this machine's own ports.
    opener = urllib.request.build_opener(urllib.request.ProxyHandler({}))
    while operations and process.poll() is None:
        if time.monotonic() > last:
            raise SeeseError(f"the server did not load its store within {LOADING_S:g} s")
        try:
            with opener.open(f"http://{operations}/readyz", timeout=5):
                return
        except OSError:
            # Refused while it starts, and answered by 503 while it loads.
            time.sleep(0.02)
