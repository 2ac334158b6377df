"""The scripts of the checkout are no installed package: this is where `benchmarks` is found."""

import sys
from pathlib import Path
from types import ModuleType

_found = ModuleType("benchmarks")
_found.__path__ = [str(Path(__file__).parents[2] / "benchmarks")]
sys.modules.setdefault("benchmarks", _found)
