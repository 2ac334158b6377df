"""Tasks by name."""

from typing import Final

from farm.tasks.finger_gait import FingerGait

TASKS: Final = {"finger-gait": FingerGait}
"""What a worker can simulate; a run's specification names one, never code."""
