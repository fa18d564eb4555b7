"""Robot's end of a serial line: pseudo-terminal or socket, transmission times, line faults, lockstep."""
