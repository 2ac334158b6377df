"""Makes `benchmarks` importable: the scripts of the checkout are not installed."""

import sys
from pathlib import Path
from types import ModuleType

_found = ModuleType("benchmarks")
_found.__path__ = [str(Path(__file__).parents[2] / "benchmarks")]
sys.modules.setdefault("benchmarks", _found)
