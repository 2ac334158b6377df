"""The gait with measures of its last grip: the middle finger's share, and the object's shift."""

import numpy as np

from farm import Measure
from farm.tasks.finger_gait.task import FingerGait


class Grips(FingerGait):
    """The same task, reward and settings as finger-gait."""

    measures = (
        Measure(name="middle", low=0.0, high=0.5),  # share of all force on fingertips
        Measure(name="shift", low=0.0, high=0.015, unit="m"),
    )

    def outcomes(self, record):
        rows, last = np.arange(len(record.steps)), record.steps - 1
        # Forces of index, middle and thumb [N], (B, 3)
        force = record.frames["force"][rows, last].sum(axis=-1)
        place = slice(8, 11)  # the object's position in qpos, after eight joints
        way = record.frames["qpos"][rows, last, place] - record.start["qpos"][:, place]
        values = {
            "middle": force[:, 1] / np.maximum(force.sum(axis=1), 1e-9),
            "shift": np.sqrt((way**2).sum(axis=1)),
        }
        return {
            each.name: np.clip(values[each.name], each.low, each.high) for each in self.measures
        }
