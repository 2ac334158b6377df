"""A run from Python with its curves in TensorBoard; other loggers can be used in the same way.

    python examples/log_tensorboard.py && tensorboard --logdir runs

It needs tensorboardX: pip install -c constraints.txt '.[tensorboard]'; the program `tensorboard` is
a package of its own: pip install tensorboard. `farm run --log tensorboard` does the same.
"""

import sys
from dataclasses import asdict

import farm

try:
    from tensorboardX import SummaryWriter
except ImportError:
    sys.exit("this example needs tensorboardX: pip install -c constraints.txt '.[tensorboard]'")

if __name__ == "__main__":
    config = farm.configure("finger-gait", generations=30)
    with SummaryWriter("runs/logged/tensorboard") as writer:
        for report in farm.learn(config, "runs/logged/run", workers=2):
            for name, value in asdict(report.progress).items():
                if isinstance(value, int | float):
                    writer.add_scalar(name, value, report.progress.generation)
    print(f"logged {config.generations} generations: tensorboard --logdir runs/logged")
