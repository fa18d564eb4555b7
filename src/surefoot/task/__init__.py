"""What is to be learned: reference gait, observation, reward, fall, pushes and the environment."""
