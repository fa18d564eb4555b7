"""Training with the PPO of rsl_rl: configuration, run folders, training loop, warm starts and exact resume."""

import os

# OpenMP reads this variable when torch is loaded. Otherwise torch's waiting threads spin and take the cores from the
# physics: a training next to a browser that renders on the same two cores is four times as fast with it.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
