"""The learning task: reference gait, observation, reward, fall, pushes and the environment."""
