"""Numbers from episode traces: speed, power, return, footfalls and the gap between two worlds."""
