"""Settings of policies that make no sense are named."""

import math

import pytest

from farm.errors import ConfigError
from farm.policies.fourier import FeaturesConfig, KernelConfig
from farm.policies.networks import MlpConfig
from farm.policies.radial import RbfConfig, WeightedKernelConfig
from farm.policies.recurrent import CpgConfig, RnnConfig


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
