"""PPO on rsl_rl: configuration, run folders, training with progress, exact resume."""
