"""A whole training is traced with annotations checked; `make test-types` checks them in all tests that CI runs."""

import os
import subprocess
import sys

import pytest
from support.running import ROOT

pytestmark = pytest.mark.ci

TRAINING = ["experiment=drive", "weather=mixed", "traffic=idm", "spawning=routes"]


def test_a_training_keeps_to_its_annotations():
    call = [sys.executable, ROOT / "tests" / "support" / "checked_annotations.py", *TRAINING]
    done = subprocess.run(call, capture_output=True, text=True, env=os.environ | {"PYTHONPATH": str(ROOT)})
    assert done.returncode == 0, done.stderr[-3000:]
