"""Before any test: the environment that `import bstcad` sets, since some tests import torch first."""

import os

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
