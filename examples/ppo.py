"""Proximal policy optimization learns a task of the farm as an environment of Gymnasium.

    python examples/ppo.py [--task examples/tasks/pendulum.py:Pendulum] [--steps 100000] [--out RUN]

The farm learns the same task with as many control steps. Both are tried from the same 100 starts:
those of `farm evaluate`. It needs stable-baselines3: pip install stable-baselines3.
"""

import argparse
import json
import sys
import time
from importlib.util import find_spec
from pathlib import Path

import farm

STARTS = 100
PENDULUM = Path(__file__).parent / "tasks" / "pendulum.py"


def learnt(task: str, steps: int) -> float:
    """The mean return of PPO's policy after control steps: the sum of rewards from each start."""
    import torch
    from stable_baselines3 import PPO
    from stable_baselines3.common.env_util import make_vec_env
    from stable_baselines3.common.vec_env import VecNormalize

    torch.set_num_threads(1)  # small networks are slower with more
    envs = VecNormalize(make_vec_env(lambda: farm.environment(task), n_envs=8, seed=0))
    model = PPO("MlpPolicy", envs, n_steps=256, batch_size=256, seed=0, device="cpu")
    model.learn(steps)
    env = farm.environment(task)
    total = 0.0
    for seed in range(STARTS):
        x, _ = env.reset(seed=seed)
        over = False
        while not over:
            action, _ = model.predict(envs.normalize_obs(x), deterministic=True)
            x, reward, terminated, truncated, _ = env.step(action)
            total = total + reward
            over = terminated or truncated
    return total / STARTS


def main() -> None:
    """Learn twice, and print both results."""
    formatter = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=formatter)
    parser.add_argument("--task", default=f"{PENDULUM}:Pendulum")
    parser.add_argument("--steps", type=int, default=100_000)
    parser.add_argument("--out", type=Path, default=Path("runs/beside-ppo"))
    arguments = parser.parse_args()
    if find_spec("stable_baselines3") is None:
        sys.exit("this example needs stable-baselines3: pip install stable-baselines3")

    began = time.monotonic()
    config = farm.configure(arguments.task, generations=10_000, stop_after_steps=arguments.steps)
    for _ in farm.learn(config, arguments.out, workers=2):
        pass
    summary = json.loads((arguments.out / "summary.json").read_text("utf-8"))
    print(f"farm run  {summary['robust_return']:8.2f}  {time.monotonic() - began:5.1f} s")

    began = time.monotonic()
    ppo = learnt(arguments.task, arguments.steps)
    print(f"PPO       {ppo:8.2f}  {time.monotonic() - began:5.1f} s")
    print(f"mean return from {STARTS} starts, after {arguments.steps} control steps; see also")
    print(f"farm evaluate {arguments.out}")


if __name__ == "__main__":
    try:
        main()
    except farm.FarmError as error:
        sys.exit(f"ppo.py: {error}")
