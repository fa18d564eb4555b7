"""Train with PPO from Stable-Baselines3, and export a policy file. Needs: pip install stable-baselines3."""

import sys

from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecNormalize

import surefoot
from surefoot.envs import make_vector
from surefoot.learn.sb3 import SB3VecEnv


def main(steps: int = 500_000, path: str = "sb3-trot.onnx", robots: int = 64, episodes: int = 20) -> None:
    """Train a trot of Go2 for a number of control steps in total over all robots; write and evaluate the policy."""
    batch = make_vector("trot", num_envs=robots, robot="go2")
    env = VecNormalize(SB3VecEnv(batch))  # its statistics become part of the file
    model = PPO("MlpPolicy", env, n_steps=64, batch_size=1024, policy_kwargs={"log_std_init": -1.6}, device="cpu")
    model.learn(steps)
    policy = surefoot.export(model, path, name="sb3-trot")
    print(surefoot.evaluate(policy, episodes=episodes))


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 500_000)  # then: surefoot drive sb3-trot.onnx
