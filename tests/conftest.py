"""What several test modules share."""

import os
from pathlib import Path

import pytest
import torch

torch.set_num_threads(1)  # tests run side by side; threads that wait for each other would only slow them down


@pytest.fixture(scope="session")
def project_root() -> Path:
    return Path(__file__).resolve().parent.parent


@pytest.fixture(scope="session")
def shared() -> Path:
    """The reference material, for the tests that compare with it; they skip where it is not."""
    folder = os.environ.get("POLARNET_SHARED")
    if not folder:
        pytest.skip("POLARNET_SHARED is not set: no reference material to compare with")
    return Path(folder)
