"""What simulates: the engines of a model's states, and the backends of workers that make them."""

from collections.abc import Callable
from typing import ClassVar, Protocol, runtime_checkable

import mujoco

from farm.arrays import AnyArray, BoolArray, FloatArray, IntArray


class Rebound(Exception):  # noqa: N818  not an error
    """An output of the simulator was requested for the first time: the batch is restarted, now with
    its values.
    """


@runtime_checkable
class Engine(Protocol):
    """Simulates rows of states of one model. Made by a backend, or by the task itself."""

    model: mujoco.MjModel
    size: int
    """Rows."""

    def field(self, name: str) -> AnyArray:
        """A live array over all rows, (size, ...), by its name in MjData; outputs are read-only.

        Raises Rebound if its values exist only after the next call, AttributeError if there is no
        such array.
        """

    def reset(self, ids: IntArray) -> None:
        """Reset rows to the model's initial state."""

    def step(self, ids: IntArray, count: int) -> None:
        """Advance rows by physics steps."""

    def play(self, ids: IntArray, controls: FloatArray) -> None:
        """Advance rows by one physics step for each of their controls, (n, steps, nu)."""

    def forward(self, ids: IntArray) -> None:
        """Compute the outputs of rows from their states."""

    def copy(self, sources: IntArray) -> None:
        """Give row i the state of row sources[i]; rows are never copied downwards onto later
        sources.
        """

    def blown_up(self, ids: IntArray) -> BoolArray:
        """Rows whose state is no longer a reasonable number, (n,)."""

    def contact_forces(self, ids: IntArray) -> FloatArray:
        """MuJoCo's cfrc_ext of rows after their last step, (n, nbody, 6); may raise Rebound like
        `field`.
        """

    def expand(self, name: str) -> AnyArray:
        """A field of the model with values for each row, live, (size, ...)."""

    def set_const(self, ids: IntArray) -> None:
        """Update derived constants after writes to expanded fields."""

    def close(self) -> None:
        """Release its resources."""


class Backend(Protocol):
    """Makes a worker's engines for models; constructed without arguments.

    Example:
      ```python
      import mujoco

      from farm.sim.engines import BatchEngine

      class TwoThreads:
          capacity = 64

          def engine(self, model):
              return BatchEngine(model, self.capacity, threads=2)

      ball = "<mujoco><worldbody><body><freejoint/><geom size='0.1'/></body></worldbody></mujoco>"
      assert TwoThreads().engine(mujoco.MjModel.from_xml_string(ball)).size == 64
      ```
    """

    capacity: ClassVar[int]
    """Number of rollouts that are worth simulating at a time."""
    exact: ClassVar[bool]
    """Whether the backend's numbers are the same as those of `cpu` to the last bit; true where a
    class does not say.
    """

    def engine(self, model: mujoco.MjModel) -> Engine:
        """Make an engine for this many simulations of a model."""


MakeEngine = Callable[[mujoco.MjModel], Engine]
"""What makes an engine of a model."""
