"""Robot emulator: microcontroller and simulated robot in one process, behind the wire protocol."""
