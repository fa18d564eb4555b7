"""The robot emulator: a microcontroller and a robot in one process, behind the wire protocol."""
