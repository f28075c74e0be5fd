# SPDX-License-Identifier: Apache-2.0
"""One quick run of every experiment, which all tests here look at."""

from __future__ import annotations

from pathlib import Path

import pytest

from musculoskeletal_ae.tools import experiment


@pytest.fixture(scope='session')
def quick(tmp_path_factory) -> Path:
    """The folder of `experiment all --quick` on the small arm, from two processes."""
    folder = tmp_path_factory.mktemp('experiments')
    command = ['all', '--robot', 'arm26', '--quick', '--jobs', '2', '--out', str(folder)]
    assert experiment.main(command) == 0
    return folder
