"""Shared by benchmarks: a process that answers requests, perhaps in another Python installation.

Only the standard library, so that a rival's interpreter can also import it. A request is a line of JSON, [name,
arguments]; the answer is a line of JSON, {"result": ...} or {"error": message}.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Any


class WorkerError(Exception):
    """A request that failed; the message is one line."""


def serve(functions: Mapping[str, Callable[..., Any]]) -> None:
    """Answer requests on standard input until it ends; all other output goes to standard error.

    A `WorkerError` becomes the request's error. Any other exception ends the process with its traceback.
    """
    answers = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)
    for line in sys.stdin:
        name, arguments = json.loads(line)
        try:
            answer = {"result": functions[name](**arguments)}
        except WorkerError as error:
            answer = {"error": str(error)}
        print(json.dumps(answer), file=answers, flush=True)


class Worker:
    """A process that runs a script which calls `serve`, with a given number of threads for numerical libraries.

    Args:
        python: its interpreter.
        script: its path, or the name of a file next to this one.
        threads: threads of BLAS and OpenMP.

    Raises:
        WorkerError: there is no such interpreter.
    """

    def __init__(self, python: str | Path, script: str | Path, threads: int) -> None:
        path = Path(__file__).parent / script
        self._name = path.name
        names = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
        try:
            self._process = subprocess.Popen(
                [str(python), str(path)],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                text=True,
                encoding="utf-8",
                env={**os.environ, **dict.fromkeys(names, str(threads))},
            )
        except OSError as error:
            raise WorkerError(f"{python}: can't be started: {error.strerror}") from error

    def ask(self, name: str, /, **arguments: Any) -> Any:
        """Return the answer to a request.

        Raises:
            WorkerError: the request failed, or the process ended.
        """
        requests, answers = self._process.stdin, self._process.stdout
        assert requests is not None
        assert answers is not None
        with suppress(BrokenPipeError):  # the end of the process is reported below
            requests.write(json.dumps([name, arguments]) + "\n")
            requests.flush()
        line = answers.readline()
        if not line:
            code = self._process.wait()
            raise WorkerError(f"{self._name}: ended with exit code {code} in '{name}'; its messages are above")
        answer = json.loads(line)
        if "error" in answer:
            raise WorkerError(answer["error"])
        return answer["result"]

    def close(self) -> None:
        """End the process."""
        assert self._process.stdin is not None
        with suppress(BrokenPipeError):  # a request that a dead process never read
            self._process.stdin.close()
        try:
            self._process.wait(timeout=10)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()

    def __enter__(self) -> Worker:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is not None:
            self._process.kill()
        self.close()
