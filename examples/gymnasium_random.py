"""Random actions in the finger gait as a Gymnasium environment.

    python examples/gymnasium_random.py [--episodes 5] [--seed 0]

No learner or worker is needed: use the environment with any library that learns in Gymnasium
environments.
"""

import argparse

import gymnasium

ID = "farm.tasks.finger_gait.env:rolloutfarm/FingerGait-v0"


def main() -> None:
    """Play episodes, and print a line for each."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--episodes", type=int, default=5)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()

    env = gymnasium.make(ID, state="joints+tactile", perturb=True)
    env.action_space.seed(arguments.seed)
    for episode in range(arguments.episodes):
        env.reset(seed=arguments.seed + episode)
        total, steps, over = 0.0, 0, False
        while not over:
            _, reward, terminated, truncated, info = env.step(0.3 * env.action_space.sample())
            total, steps, over = total + float(reward), steps + 1, terminated or truncated
        end = "dropped" if terminated else "success" if info["is_success"] else "held"
        print(f"episode {episode}: {steps:2d} steps, sum of rewards {total:8.3f}, {end}")
    env.close()


if __name__ == "__main__":
    main()
