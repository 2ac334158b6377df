"""Where the search starts: at a policy's own parameters, drawn from the seed, or at the algorithm's
mean.
"""

import numpy as np
import pytest
from controllers import ACTIONS, KINDS, act, make, states

from farm import seeds
from farm.policies.networks import Mlp, MlpConfig
from farm.policies.recurrent import Cpg, CpgConfig
from farm.tasks.base import TaskSpec


def test_an_mlp_starts_at_random_weights_by_layer():
    spec = TaskSpec(observation=50, action=40, steps=1, period=0.1)
    policy = Mlp(MlpConfig(layers=(60, 80)), spec, {})
    start = policy.start(np.random.default_rng(0))
    assert (start.shape, start.dtype) == ((policy.size,), np.float64)
    first = 0
    for inputs, units, scale in ((50, 60, 1.0), (60, 80, 1.0), (80, 40, 0.1)):
        layer = start[first : first + units * (inputs + 1)].reshape(units, inputs + 1)
        assert (layer[:, -1] == 0.0).all(), "biases"
        z = layer[:, :-1] * np.sqrt(inputs) / scale
        assert abs(z.mean()) < 4 / np.sqrt(z.size)
        assert abs(z.std() - 1.0) < 4 / np.sqrt(2 * z.size)
        first += layer.size
    assert first == policy.size


def test_a_start_is_determined_by_the_seed():
    policy = make("mlp")
    one, same, other = (policy.start(seeds.start(seed)) for seed in (3, 3, 4))
    assert one.tobytes() == same.tobytes()
    assert (one != other).any()
    assert seeds.start(3).random() != seeds.features(3).random()


def test_an_rnn_starts_as_an_mlp_of_what_it_sees_and_remembers():
    rnn = make("rnn", features=20)
    mlp = Mlp(
        MlpConfig(layers=(20,)), TaskSpec(observation=28, action=ACTIONS, steps=1, period=0.1), {}
    )
    one, other = (policy.start(np.random.default_rng(0)) for policy in (rnn, mlp))
    assert one.tobytes() == other.tobytes()


def test_oscillators_start_at_the_settings_and_act():
    policy = Cpg(
        CpgConfig(frequency=2.0, amplitude=0.3),
        TaskSpec(observation=8, action=2, steps=1, period=0.1),
        {},
    )
    assert policy.start(np.random.default_rng(0)).tolist() == [2.0, 0.3, 0.0, 0.0] * 2


@pytest.mark.parametrize("name", [name for name in KINDS if name not in ("mlp", "rnn", "cpg")])
def test_other_policies_start_at_the_algorithms_mean(name):
    assert make(name).start(np.random.default_rng(0)) is None


def test_the_first_mean_of_an_mlp_sees_the_observation():
    policy, x = make("mlp"), states(5)
    start = policy.start(np.random.default_rng(0))
    actions = act(policy, np.tile(start, (5, 1)), x)
    assert np.ptp(actions, axis=0).min() > 1e-3
    assert np.ptp(act(policy, np.zeros((5, policy.size)), x), axis=0).max() == 0.0
