"""Controllers with memory: a recurrent network, and oscillators. Pure, batched.

    rnn   h' = tanh(W x + U h + b),  a = V h' + c,  h = 0 at the start
          (Elman 1990, Finding structure in time)
    cpg   a_i = o_i + r_i sin(phi_i + p_i),  phi_i advances by 2 pi f_i dt,  phi_i = 0 at the start
          (Ijspeert, Crespi, Ryczko & Cabelguen 2007, From swimming to walking with a salamander
          robot driven by a spinal cord model: one of its oscillators per actuator, without
          coupling, at its final amplitude)

dt is the control step. The cpg's observation plays no part: it is open loop. Its phases are kept in
turns from 0 to 1, so that they stay exact in long rollouts.
"""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from farm import elementary
from farm.arrays import FloatArray
from farm.policies.base import Graph, Policy, PolicyConfig
from farm.policies.networks import Mlp, affine
from farm.settings import setting


@dataclass(frozen=True, kw_only=True)
class RnnConfig(PolicyConfig):
    """Settings of the recurrent network."""

    units: int = setting(16, least=1, most=10_000)
    """Units of the hidden layer, whose values it remembers."""


@dataclass(frozen=True, kw_only=True)
class CpgConfig(PolicyConfig):
    """Settings of the oscillators."""

    frequency: float = setting(1.0, above=0.0, most=1000.0)
    """Frequency of every oscillator where the search starts [Hz]."""
    amplitude: float = setting(0.5, least=0.0, most=1000.0)
    """Amplitude of every action where the search starts."""


class Rnn(Mlp):
    """Elman's network: a hidden layer of tanh units that also sees its own last values, and a
    linear output.

    Parameters are (W_i, U_i, b_i) of each hidden unit, then (V_i, c_i) of each action. The search
    starts at random weights, as that of an mlp.
    """

    Config: ClassVar[type[PolicyConfig]] = RnnConfig

    @property
    def _sizes(self) -> tuple[int, ...]:
        units: int = self.config.units
        return self.spec.observation + units, units, self.spec.action

    @property
    def memory(self) -> FloatArray:
        """Values of the hidden units, (units,)."""
        return np.zeros(self.config.units)

    def act(  # type: ignore[override]
        self, prepared: FloatArray, x: FloatArray, memory: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Actions (B, A), which may be huge or not finite, and the hidden units' next values (B,
        units).
        """
        hidden, output = self._matrices(prepared)
        with np.errstate(over="ignore", invalid="ignore"):
            after = elementary.tanh(affine(*hidden, np.concatenate([x, memory], axis=1)))
            return affine(*output, after), after

    def onnx(self, graph: Graph, theta: FloatArray, x: str, memory: str) -> tuple[str, str]:
        """Add the layers to a graph, the first of which also sees the memory; return the names of
        the outputs.
        """
        hidden, out = self._layers(graph, theta, graph.put("Concat", x, memory, axis=1))
        return out, graph.put("Tanh", hidden)


class Cpg(Policy):
    """A sine oscillator for each action, without feedback.

    Parameters are, for each action: frequency f_i [Hz], amplitude r_i, phase offset p_i [rad],
    offset o_i.
    """

    Config: ClassVar[type[PolicyConfig]] = CpgConfig

    @property
    def size(self) -> int:
        """4 A."""
        return 4 * self.spec.action

    @property
    def memory(self) -> FloatArray:
        """Phase of each oscillator [turns], (A,)."""
        return np.zeros(self.spec.action)

    @property
    def scale(self) -> FloatArray:
        """A fifth of the frequency at the start, half an action, a radian, half an action."""
        return np.tile([0.2 * self.config.frequency, 0.5, 1.0, 0.5], self.spec.action)

    def start(self, rng: np.random.Generator) -> FloatArray:  # noqa: ARG002
        """The frequency and amplitude of the settings, offsets of 0."""
        return np.tile([self.config.frequency, self.config.amplitude, 0.0, 0.0], self.spec.action)

    def prepare(self, theta: FloatArray) -> FloatArray:
        """Frequency, amplitude, phase offset and offset of each action, (B, A, 4)."""
        return theta.reshape(len(theta), self.spec.action, 4)

    def act(  # type: ignore[override]
        self,
        prepared: FloatArray,
        x: FloatArray,  # noqa: ARG002
        memory: FloatArray,
    ) -> tuple[FloatArray, FloatArray]:
        """Actions (B, A), and the next phases [turns] (B, A)."""
        frequency, amplitude, shift, offset = (prepared[:, :, i] for i in range(4))
        with np.errstate(over="ignore", invalid="ignore"):
            action = offset + amplitude * elementary.sin(2.0 * np.pi * memory + shift)
            turns = memory + frequency * self.spec.period
            return action, turns - np.floor(turns)

    def onnx(self, graph: Graph, theta: FloatArray, x: str, memory: str) -> tuple[str, str]:  # noqa: ARG002
        """Add the oscillators to a graph; return the names of the outputs."""
        frequency, amplitude, shift, offset = self.prepare(theta[None])[0].T.copy()
        angle = graph.put("Add", graph.put("Mul", memory, 2.0 * np.pi), shift)
        action = graph.put("Add", graph.put("Mul", graph.put("Sin", angle), amplitude), offset)
        turns = graph.put("Add", memory, frequency * self.spec.period)
        return action, graph.put("Sub", turns, graph.put("Floor", turns))
