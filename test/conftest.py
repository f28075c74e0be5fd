# SPDX-License-Identifier: Apache-2.0
"""Fixtures for all tests."""

import fcntl
import gc
import os
import signal
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any

import pytest
from hypothesis import settings

import musculoskeletal_ae  # noqa: F401  # chooses the pinocchio that tests import

# Each process of pytest-xdist has its own ROS domain, so that their nodes do not meet.
if worker := os.environ.get('PYTEST_XDIST_WORKER', '').removeprefix('gw'):
    os.environ['ROS_DOMAIN_ID'] = str(int(os.environ.get('ROS_DOMAIN_ID', '1')) + int(worker))

# A shell lets background processes ignore SIGINT, and the processes that tests start would inherit
# this. Restore the default.
signal.signal(signal.SIGINT, signal.default_int_handler)

# Hypothesis allows 200 ms for an example by default, but the first one loads compiled code, which
# takes longer. Every run tries the same examples; `./test.sh --hypothesis-profile search` tries new
# ones.
settings.register_profile('search', deadline=None)
settings.register_profile('repeatable', deadline=None, derandomize=True)
settings.load_profile('repeatable')


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Iterator[None]:
    """Switch off Python's garbage collection while pytest collects the tests.

    The collection of tests creates about a million objects that remain until the end, mainly by
    imports. Searching them for garbage would take a third of its time. They are frozen, so that
    later garbage collections skip them too.
    """
    gc.disable()
    try:
        return (yield)
    finally:
        gc.freeze()
        gc.enable()


def pytest_collection_modifyitems(items: list[Any]) -> None:
    """Sort the tests: each process of pytest-xdist begins with a different kind of slow tests.

    Slow tests are those that occupy both cores, those on a ROS graph and those of the experiments.
    They often wait, for messages or for other processes. Meanwhile, the other processes use the
    cores for the short tests, which come last. A process that has no tests left takes over some
    from another process.
    """
    remaining = items.copy()
    shares: list[list[Any]] = []
    for fixture in ('both_cores', 'graph', 'quick'):
        shares.append([item for item in remaining if fixture in item.fixturenames])
        remaining = [item for item in remaining if fixture not in item.fixturenames]
    # The option `--dist worksteal` divides the list into as many equal parts as there are
    # processes.
    processes = int(os.environ.get('PYTEST_XDIST_WORKER_COUNT', '1'))
    for share in shares[: processes - 1]:
        missing = max(0, len(items) // processes - len(share))
        share += remaining[:missing]
        remaining = remaining[missing:]
    items[:] = [*chain.from_iterable(shares), *remaining]


@contextmanager
def _alone(factory: pytest.TempPathFactory, what: str) -> Iterator[Path]:
    folder = factory.getbasetemp()
    folder = folder.parent if worker else folder  # a folder that all processes of the run share
    with (folder / f'{what}.lock').open('w') as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield folder


@pytest.fixture(scope='session')
def alone(tmp_path_factory) -> Callable[[str], AbstractContextManager[Path]]:
    """Return a function that makes a context manager: it admits one process at a time to its block.

    The block receives a folder that all processes of the test run share.
    """
    return partial(_alone, tmp_path_factory)


@pytest.fixture(scope='session', autouse=True)
def state_home(tmp_path_factory) -> None:
    """Let nodes save their state in a temporary folder instead of the home directory."""
    os.environ['XDG_STATE_HOME'] = str(tmp_path_factory.mktemp('state'))


@pytest.fixture
def both_cores(alone) -> Iterator[None]:
    """Run only one test at a time that occupies both cores, such as a whole real-time system."""
    with alone('cores'):
        yield


@pytest.fixture(scope='session')
def trained_files(alone) -> dict[str, Path]:
    """Return the files of briefly trained networks of arm26 by preset, trained once per run."""
    # These imports load torch, which only tests with a network need.
    from musculoskeletal_ae.mae import checkpoint
    from musculoskeletal_ae.mae.initial_training import initial_mae
    from musculoskeletal_ae.presets.registry import PRESETS
    from musculoskeletal_ae.robot.robot import Robot

    with alone('networks') as folder:
        files = {preset: folder / f'arm26_{preset}.safetensors' for preset in PRESETS}
        for preset, file in files.items():
            if not file.exists():
                mae = initial_mae(Robot.load('arm26'), preset, seed=3, steps=600)
                checkpoint.save(mae, file)
    return files


@pytest.fixture(scope='session')
def trained(trained_files) -> dict[str, Any]:
    """Return briefly trained networks of arm26 by preset."""
    from musculoskeletal_ae.mae import checkpoint

    return {preset: checkpoint.load(file) for preset, file in trained_files.items()}


@pytest.fixture(scope='session')
def trained_file(trained_files) -> str:
    """Return the checkpoint file of the network of preset `default`."""
    return str(trained_files['default'])
