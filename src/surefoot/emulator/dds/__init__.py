"""Emulated Unitree Go2 with its DDS topics and services."""
