"""Optuna's TPE sampler searches the finger gait's kernel centres, twenty trials at a time.

    python examples/optuna_search.py

It needs optuna: pip install -c constraints.txt '.[search]'.
"""

import sys

import farm

try:
    import optuna
except ImportError:
    sys.exit("this example needs optuna: pip install -c constraints.txt '.[search]'")

if __name__ == "__main__":
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    with farm.Farm("finger-gait", policy="kernel", workers=2) as pool:
        study = optuna.create_study(
            direction="maximize", sampler=optuna.samplers.TPESampler(seed=0)
        )
        space = {
            f"theta{i}": optuna.distributions.FloatDistribution(0.0, 3.0) for i in range(pool.size)
        }
        for batch in range(5):
            trials = [study.ask(space) for _ in range(20)]
            returns = pool.map([[trial.params[name] for name in space] for trial in trials])
            for trial, value in zip(trials, returns, strict=True):
                study.tell(trial, float(value))
            print(f"batch {batch}: best return {study.best_value:.3f}")
