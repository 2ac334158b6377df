"""What only Linux has is not needed to import the packages: simulated here, never tried on another
system.
"""

import subprocess
import sys

CODE = """
import os, pkgutil, sys
import rerun  # its psutil needs it on Linux
sys.modules["resource"] = None  # an import raises ImportError
del os.sched_getaffinity
import farm.plugins
optional = {
    "warp", "mujoco_warp", "wandb", "onnx", "cmaes", "gymnasium", "pyarrow", "tensorboardX",
    "cryptography",
}
count = 0
for name in ("farm", "learner", "workers"):
    package = farm.plugins.load(name)
    for module in pkgutil.walk_packages(package.__path__, f"{name}."):
        if module.name.endswith("__main__"):
            continue
        try:
            farm.plugins.load(module.name)
            count += 1
        except ImportError as error:
            assert (error.name or "").partition(".")[0] in optional, (module.name, error)
assert count > 120, count
assert sys.modules["resource"] is None
from farm.net.session import free_endpoint, listen
with listen(free_endpoint(), "f"):
    pass
from farm import processes
from farm import runner_process
assert processes.cores() == os.cpu_count()
sys.platform = "darwin"
class NoPrctl:
    def __getattr__(self, name):
        raise AttributeError(name)
runner_process.ctypes.CDLL = lambda name: NoPrctl()
runner_process.bound()
print("imported", count)
"""


def test_nothing_of_linux_alone_is_needed_at_import() -> None:
    ended = subprocess.run(
        [sys.executable, "-c", CODE], capture_output=True, text=True, timeout=60, check=False
    )
    assert ended.returncode == 0, ended.stderr
    assert ended.stdout.startswith("imported")
