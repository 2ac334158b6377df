"""Random features and controllers compared with their formulas; rows do not depend on their batch."""

import math
from itertools import pairwise

import numpy as np
import pytest
from covering import any_two
from hypothesis import given
from hypothesis import strategies as st

from farm import seeds
from farm.errors import ConfigError, UnservedError
from farm.policies.base import Policy
from farm.policies.fourier import Cosine, Direct, FeaturesConfig, Kernel, KernelConfig, Projected
from farm.policies.networks import Linear, Mlp, MlpConfig
from farm.policies.radial import Rbf, RbfConfig, WeightedKernel, WeightedKernelConfig
from farm.policies.recurrent import Cpg, CpgConfig, Rnn, RnnConfig
from farm.tasks.base import TaskSpec

ACTIONS = 3
FOURIER = {"direct": Direct, "projected": Projected, "kernel": Kernel, "cosine": Cosine}
SINGLE = {f"{name}, single": kind for name, kind in FOURIER.items() if name != "kernel"}
KINDS = (
    FOURIER
    | SINGLE
    | {"linear": Linear, "linear, no bias": Linear, "mlp": Mlp, "rbf": Rbf, "weighted-kernel": WeightedKernel}
    | {"rnn": Rnn, "cpg": Cpg}
)


def make(name: str = "projected", features: int = 50, size: int = 8, seed: int = 0, bandwidth: float = 1.0) -> Policy:
    kind, spec = KINDS[name], TaskSpec(observation=size, action=ACTIONS, steps=1, period=0.1)
    own = {
        "kernel": {"bandwidth": bandwidth},
        "linear": {},
        "linear, no bias": {"bias": False},
        "mlp": {"layers": (features, 5)},
        "rbf": {"centres": features, "bandwidth": bandwidth},
        "weighted-kernel": {"width": bandwidth},
        "rnn": {"units": features},
        "cpg": {},
    }.get(name, {"features": features, "bandwidth": bandwidth})
    if name in SINGLE:
        own["precision"] = "single"
    config, rng = kind.Config(**own), np.random.default_rng(seed)
    constants = kind.draw(config, spec, rng)
    if kind.standardised:
        constants |= {"origin": rng.normal(size=size), "spread": rng.uniform(0.1, 2.0, size)}
    return kind(config, spec, constants)


def states(count, size=8, seed=3):
    return np.random.default_rng(seed).uniform(0.0, 1.2, (count, size))


def parameters(policy, count, seed=4, scale=1.0):
    return np.random.default_rng(seed).normal(0.5, scale, (count, policy.size))


def memories(policy, x):
    """Memories (B, m) that differ from row to row, in a tuple; an empty one for a policy without."""
    with np.errstate(over="ignore"):
        return () if policy.memory is None else (x[:, :1] * np.linspace(0.1, 1.0, len(policy.memory)),)


def act(policy, theta, x):
    given = policy.act(policy.prepare(theta), x, *memories(policy, x))
    return given[0] if isinstance(given, tuple) else given


def acted(policy, prepared, x):
    """Actions, followed by the next memory if there is one, a row each."""
    given = policy.act(prepared, x, *memories(policy, x))
    return np.concatenate(given, axis=1) if isinstance(given, tuple) else given


# ---------------------------------------------------------------- features


def kernel_error(features, size, bandwidth, seed):
    policy = make("direct", features, size, seed, bandwidth)
    x, y = states(12, size, 1) * bandwidth, states(12, size, 2) * bandwidth
    exact = [math.exp(-(math.dist(a, b) ** 2) / (2 * bandwidth**2)) for a, b in zip(x, y, strict=True)]
    errors = (policy.features(x) * policy.features(y)).sum(axis=1) - exact
    return np.sqrt(np.mean(np.square(errors)))


@pytest.mark.parametrize(("size", "bandwidth"), [(8, 1.0), (8, 0.3), (17, 2.0)])
def test_features_approximate_the_gaussian_kernel_better_with_more_of_them(size, bandwidth):
    coarse, middle, fine = (
        np.mean([kernel_error(count, size, bandwidth, seed) for seed in range(4)]) for count in (50, 800, 12800)
    )
    assert fine < 0.02
    assert 2 < coarse / middle < 8  # as 1 / sqrt(D): 4
    assert 2 < middle / fine < 8


def test_features_are_as_written():
    constants = {
        "frequencies": np.array([[1.0, -2.0], [0.5, 0.25], [0.0, 3.0]]),
        "phases": np.array([0.1, 2.0, 6.0]),
    }
    spec = TaskSpec(observation=2, action=1, steps=1, period=0.1)
    policy = Direct(FeaturesConfig(features=3, bandwidth=0.5), spec, constants)
    x = [0.3, -0.7]
    expected = [
        math.sqrt(2 / 3) * math.cos(sum(w * v for w, v in zip(row, x, strict=True)) / 0.5 + c)
        for row, c in zip(constants["frequencies"].tolist(), constants["phases"].tolist(), strict=True)
    ]
    np.testing.assert_allclose(policy.features(np.array([x])), [expected], rtol=1e-12)


def test_constants_are_drawn_from_their_distributions_and_the_kernel_has_none():
    drawn = make("direct", 20_000).constants
    frequencies, phases = drawn["frequencies"], drawn["phases"]
    assert (frequencies.shape, phases.shape) == ((20_000, 8), (20_000,))
    np.testing.assert_allclose(frequencies.mean(axis=0), 0.0, atol=0.04)
    np.testing.assert_allclose(frequencies.std(axis=0), 1.0, atol=0.03)
    assert 0 <= phases.min() < 0.01 < 2 * np.pi - 0.01 < phases.max() <= 2 * np.pi
    assert phases.mean() == pytest.approx(np.pi, abs=0.05)
    again = make("direct", 20_000).constants
    assert again["frequencies"].tobytes() == frequencies.tobytes()
    assert make("kernel").constants == {}


@pytest.mark.parametrize("name", ["frequencies", "phases"])
@pytest.mark.parametrize(
    "wrong", [None, np.zeros((50, 17)), np.zeros(49), np.zeros((8, 50)), np.zeros((0, 8))], ids=str
)
def test_constants_of_another_size_are_a_clear_error(name, wrong):
    policy = make("direct")
    constants = {key: values for key, values in policy.constants.items() if key != name}
    constants |= {} if wrong is None else {name: wrong}
    with pytest.raises(UnservedError, match=rf"constant '{name}' of the policy is .*; expected an array of shape \(50"):
        Direct(policy.config, policy.spec, constants)


# ---------------------------------------------------------------- controllers


@pytest.mark.parametrize("name", FOURIER)
@pytest.mark.parametrize("bandwidth", [1.0, 0.4])
def test_actions_are_as_written(name, bandwidth):
    policy = make(name, features=20, bandwidth=bandwidth)
    direct = make("direct", features=20, bandwidth=bandwidth)

    def features(x):
        return direct.features(x[None])[0]

    assert policy.size == ACTIONS * {"direct": 20, "cosine": 20}.get(name, 8)
    theta, x = parameters(policy, 3), states(3)
    actions = act(policy, theta, x)
    assert actions.shape == (3, ACTIONS)
    for i in range(3):
        z = features(x[i])
        for joint, own in enumerate(theta[i].reshape(ACTIONS, -1)):
            parts = {"projected": features, "cosine": np.cos}.get(name, np.asarray)(own)
            if name == "kernel":
                expected = math.exp(-(math.dist(own, x[i]) ** 2) / (2 * bandwidth**2))
            else:
                expected = sum(a * b for a, b in zip(parts, z, strict=True))
            assert actions[i, joint] == pytest.approx(expected, rel=1e-9, abs=1e-12)


@pytest.mark.parametrize("name", SINGLE)
def test_single_precision_changes_actions_by_rounding_alone(name):
    single, double = make(name, features=8000), make(name.partition(",")[0], features=8000)
    theta, x = parameters(single, 20), states(20)
    found, wanted = act(single, theta, x), act(double, theta, x)
    assert found.dtype == np.float64
    assert 0.0 < np.abs(found - wanted).max() < 2e-6


def test_single_precision_overflows_like_double():
    policy = make("direct, single")
    theta, x = parameters(policy, 3), states(3)
    theta[1], x[2, 0] = 1e300, 1e300
    found = act(policy, theta, x)
    assert np.isfinite(found).all(axis=1).tolist() == [True, False, False]


def plain(policy, theta, x):
    """One rollout's actions (A,), by numpy's own products and functions."""
    config, a, d = policy.config, ACTIONS, len(x)
    if isinstance(policy, Rnn):
        (memory,) = memories(policy, x[None])
        hidden, output = np.split(theta, [config.units * (d + config.units + 1)])
        h = np.tanh(hidden.reshape(config.units, -1) @ np.concatenate([x, memory[0], [1.0]]))
        return output.reshape(a, -1) @ np.append(h, 1.0)
    if isinstance(policy, Cpg):
        (turns,), (_, amplitude, shift, offset) = memories(policy, x[None]), theta.reshape(a, 4).T
        return offset + amplitude * np.sin(2.0 * np.pi * turns[0] + shift)
    if isinstance(policy, Mlp):
        for inputs, units in pairwise((d, *config.layers, a)):
            rows, theta = theta[: units * (inputs + 1)].reshape(units, -1), theta[units * (inputs + 1) :]
            out = rows @ np.append(x, 1.0)
            x = np.tanh(out)
        return out
    if isinstance(policy, Linear):
        return theta.reshape(a, -1) @ (np.append(x, 1.0) if config.bias else x)
    if isinstance(policy, Rbf):
        k = config.centres
        distance = np.linalg.norm(theta[: k * d].reshape(k, d) - x, axis=1)
        return theta[k * d :].reshape(a, k) @ np.exp(-(distance**2) / (2 * config.bandwidth**2))
    rows, y = theta.reshape(a, -1), (x - policy.constants["origin"]) / policy.constants["spread"]
    distance = np.linalg.norm(rows[:, :-1] - y, axis=1)
    return config.weight_scale * rows[:, -1] * np.exp(-(distance**2) / (2 * d * config.width**2))


@pytest.mark.parametrize("name", [name for name in KINDS if name not in FOURIER | SINGLE])
@pytest.mark.parametrize("size", [1, 8, 62])
def test_actions_are_those_of_plain_numpy(name, size):
    policy = make(name, features=7, size=size, bandwidth=1.3)
    sizes = {"mlp": 7 * (size + 1) + 5 * 8 + 3 * 6, "rbf": 7 * (size + 3), "linear, no bias": 3 * size}
    sizes |= {"rnn": 7 * (size + 7 + 1) + 3 * 8, "cpg": 12}
    assert policy.size == sizes.get(name, 3 * (size + 1))
    theta, x = parameters(policy, 5), states(5, size)
    wanted = [plain(policy, *row) for row in zip(theta, x, strict=True)]
    np.testing.assert_allclose(act(policy, theta, x), wanted, rtol=1e-11, atol=1e-13)


def test_the_hidden_layer_of_an_rnn_is_its_next_memory():
    policy, x = make("rnn", features=4), states(3)
    theta = parameters(policy, 3)
    [memory] = memories(policy, x)
    _, after = policy.act(policy.prepare(theta), x, memory)
    rows = theta[:, : 4 * 13].reshape(3, 4, 13)  # 8 observations, 4 memories, a bias
    for row, seen, known, found in zip(rows, x, memory, after, strict=True):
        np.testing.assert_allclose(found, np.tanh(row @ np.concatenate([seen, known, [1.0]])), rtol=1e-12)
    assert policy.memory.tolist() == [0.0] * 4


def test_oscillators_are_sines_of_the_time_with_the_written_numbers():
    policy = make("cpg")
    frequency, amplitude, shift, offset = [0.7, 3.0, -1.3], [1.0, -0.5, 2.0], [0.0, 0.4, 9.0], [0.1, 0.2, -0.3]
    prepared = policy.prepare(np.array([frequency, amplitude, shift, offset]).T.reshape(1, -1))
    memory = policy.memory[None]
    for step in range(500):
        action, memory = policy.act(prepared, states(1), memory)
        angle = 2.0 * np.pi * np.array(frequency) * step * policy.spec.period + shift
        np.testing.assert_allclose(action[0], offset + amplitude * np.sin(angle), atol=1e-11)
        assert ((memory >= 0.0) & (memory < 1.0)).all()


def test_a_weighted_kernel_begins_at_rest_and_may_act_with_either_sign():
    policy, x = make("weighted-kernel"), states(4)
    theta = parameters(policy, 4).reshape(4, ACTIONS, -1)
    theta[:, :, -1] = [0.0, 2.0, -2.0]
    actions = act(policy, theta.reshape(4, -1), x)
    assert (actions[:, 0] == 0.0).all()
    assert (actions[:, 1] > 0.0).all()
    assert (actions[:, 2] < 0.0).all()


def test_a_weighted_kernel_needs_its_task_s_origin_and_spread():
    policy = make("weighted-kernel")
    for constants in ({}, {"origin": np.zeros(8)}, {"origin": np.zeros(8), "spread": np.ones(9)}):
        with pytest.raises(UnservedError, match="constant '(origin|spread)' of the policy is"):
            WeightedKernel(policy.config, policy.spec, constants)


def test_projected_tends_to_kernel():
    kernel = make("kernel")
    theta, x = parameters(kernel, 4), states(4)
    exact = act(kernel, theta, x)
    errors = [np.sqrt(np.mean((act(make(features=count), theta, x) - exact) ** 2)) for count in (50, 800, 12800)]
    assert errors[0] > 2 * errors[1] > 4 * errors[2]
    assert errors[2] < 0.02


@given(seed=st.integers(0, 1000), features=st.integers(1, 40), scale=st.sampled_from([0.1, 1.0, 100.0, 1e12]))
def test_projected_actions_are_bounded_by_two(seed, features, scale):
    policy = make(features=features, seed=seed)
    actions = act(policy, parameters(policy, 4, seed, scale), states(4, seed=seed))
    assert (np.abs(actions) <= 2.0 + 1e-12).all()


@given(seed=st.integers(0, 1000), scale=st.sampled_from([0.1, 1.0, 1e3, 1e200]))
def test_kernel_actions_lie_between_zero_and_one(seed, scale):
    policy = make("kernel")
    actions = act(policy, parameters(policy, 4, seed, scale), states(4, seed=seed))
    assert ((actions >= 0) & (actions <= 1)).all()


def test_the_kernel_is_one_at_its_centre():
    policy, x = make("kernel", bandwidth=0.1), states(2)
    np.testing.assert_array_equal(act(policy, np.tile(x, ACTIONS), x), 1.0)


# ---------------------------------------------------------------- rows do not know of each other


@pytest.mark.parametrize(*any_two(name=KINDS, size=(1, 8, 62), features=(1, 7, 50, 300)))
def test_a_row_does_not_depend_on_its_batch(name, size, features):
    policy = make(name, features, size)
    theta, x = parameters(policy, 32), states(32, size)
    alone = [acted(policy, policy.prepare(theta[i : i + 1]), x[i : i + 1])[0].tobytes() for i in range(32)]

    def check(rows, some_theta, some_x):
        prepared = policy.prepare(some_theta)
        for actions in (acted(policy, prepared, some_x), acted(policy, np.asfortranarray(prepared), some_x)):
            assert [row.tobytes() for row in actions] == [alone[i] for i in rows]

    check(range(7), theta[:7], x[:7])
    order = np.random.default_rng(0).permutation(32)
    check(order, theta[order], x[order])
    check(range(31, -1, -1), theta[::-1], x[::-1])
    check(range(0, 32, 3), theta[::3], x[::3])
    check(range(32), np.asfortranarray(theta), np.asfortranarray(x))
    wide_theta, wide_x = np.zeros((32, 2 * policy.size)), np.zeros((32, 3 * size))
    wide_theta[:, ::2], wide_x[:, 1::3] = theta, x
    check(range(32), wide_theta[:, ::2], wide_x[:, 1::3])


def test_constants_in_another_memory_order_are_the_same():
    policy = make("direct")
    other = {
        "frequencies": np.asfortranarray(policy.constants["frequencies"]),
        "phases": np.repeat(policy.constants["phases"], 2)[::2],
    }
    two = Direct(policy.config, policy.spec, other)
    theta, x = parameters(policy, 3), states(3)
    assert act(policy, theta, x).tobytes() == act(two, theta, x).tobytes()


@pytest.mark.parametrize("name", KINDS)
def test_inputs_are_left_alone(name):
    policy = make(name)
    theta, x = parameters(policy, 3), states(3)
    prepared = policy.prepare(theta).copy()
    for values in (theta, x, prepared, *policy.constants.values()):
        values.setflags(write=False)
    assert acted(policy, policy.prepare(theta), x).tobytes() == acted(policy, prepared, x).tobytes()


@pytest.mark.parametrize("name", KINDS)
@pytest.mark.parametrize("scale", [1e155, 1e300, 1e308])
def test_huge_parameters_and_observations_warn_of_nothing(name, scale):
    policy = make(name)
    theta = np.clip(np.random.default_rng(0).normal(size=(2, policy.size)), -1, 1) * scale
    for x in (states(2), states(2) * scale):
        assert act(policy, theta, x).shape == (2, ACTIONS)


# ---------------------------------------------------------------- configuration


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"features": 0}, "features is 0; expected 1 to 10000000"),
        ({"features": 10_000_001}, "features is 10000001"),
        ({"bandwidth": 0.0}, "bandwidth is 0.0; expected a positive"),
        ({"bandwidth": math.inf}, "bandwidth is inf"),
    ],
)
def test_a_wrong_setting_is_named(options, message):
    with pytest.raises(ConfigError, match=message):
        FeaturesConfig(**options)
    assert KernelConfig(bandwidth=2).bandwidth == 2.0


@pytest.mark.parametrize(
    ("kind", "options", "message"),
    [
        (MlpConfig, {"layers": ()}, "layers are 0; expected 1 to 20 hidden layers"),
        (MlpConfig, {"layers": (1,) * 21}, "layers are 21; expected 1 to 20"),
        (MlpConfig, {"layers": (32, 0)}, "layers has 0; expected 1 to 10000 units in each"),
        (MlpConfig, {"layers": (10_001,)}, "layers has 10001; expected 1 to 10000"),
        (MlpConfig, {"layers": (1.5,)}, "layers has 1.5"),
        (MlpConfig, {"layers": "32"}, "layers is '32'; expected tuple"),
        (RbfConfig, {"centres": 0}, "centres is 0; expected 1 to 100000"),
        (RbfConfig, {"bandwidth": -1.0}, "bandwidth is -1.0; expected a positive"),
        (RnnConfig, {"units": 0}, "units is 0; expected 1 to 10000"),
        (CpgConfig, {"frequency": 0.0}, "frequency is 0.0; expected a positive"),
        (CpgConfig, {"amplitude": -1.0}, "amplitude is -1.0; expected 0 to 1000"),
        (WeightedKernelConfig, {"width": 0.0}, "width is 0.0; expected a positive"),
        (WeightedKernelConfig, {"weight_scale": 0.0}, "weight-scale is 0.0; expected a positive"),
    ],
)
def test_a_wrong_setting_of_the_others_is_named(kind, options, message):
    with pytest.raises(ConfigError, match=message):
        kind(**options)


# ---------------------------------------------------------------- where the search starts


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
    mlp = Mlp(MlpConfig(layers=(20,)), TaskSpec(observation=28, action=ACTIONS, steps=1, period=0.1), {})
    one, other = (policy.start(np.random.default_rng(0)) for policy in (rnn, mlp))
    assert one.tobytes() == other.tobytes()


def test_oscillators_start_at_the_settings_and_act():
    policy = Cpg(CpgConfig(frequency=2.0, amplitude=0.3), TaskSpec(observation=8, action=2, steps=1, period=0.1), {})
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
