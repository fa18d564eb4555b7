"""What is looked at before a robot runs: link, computer, robot at rest, motors on a rack, tilt on the ground."""
