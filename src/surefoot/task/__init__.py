"""The learning task: environment, reference gaits, observations, rewards, terminations and disturbances."""
