"""To the robot: wire protocol, link, checks, control loop and safety. Nothing here needs a simulator."""
