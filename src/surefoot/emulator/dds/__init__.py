"""An emulated Unitree Go2 behind its own topics and services over DDS."""
