"""Deployment on a robot: wire protocol, links, checks, control loop and safety. Nothing here needs a simulator."""
