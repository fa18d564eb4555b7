"""PPO on rsl_rl: configuration, run folders, training with progress, exact resume."""

import os

# OpenMP reads this when torch is loaded. Threads of torch that wait by spinning take the cores from the physics: a
# training beside a browser that draws on the same two cores is four times as fast without that.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
