"""The robot's end of a serial line: a pseudo-terminal, transmission times, damage on the way, lockstep."""
