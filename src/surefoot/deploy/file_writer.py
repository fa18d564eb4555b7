"""Writes standard input to a file: the child process of `background_file`. It imports little, so that it starts fast.

    python -I -S file_writer.py PATH PERIOD

Data are written every PERIOD seconds and when the input ends. The file is created or replaced with the first data. An
error is written to standard output.
"""

import os
import select
import sys

_CHUNK = 1 << 20


def write_input(path: str, period: float) -> None:
    """Write standard input to a file, every `period` [s] until it ends."""
    end = select.poll()
    end.register(0, 0)  # no events, so that only the end of the input ends the wait early
    file = -1
    while data := os.read(0, _CHUNK):
        if file < 0:
            file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o666)
        while data:
            data = data[os.write(file, data) :]
        end.poll(1e3 * period)
    if file >= 0:
        os.close(file)  # some file systems report a full disk only now


if __name__ == "__main__":
    try:
        write_input(sys.argv[1], float(sys.argv[2]))
    except OSError as error:
        os.write(1, (error.strerror or str(error)).encode())
        sys.exit(1)
