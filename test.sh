#!/usr/bin/env bash
# SPDX-License-Identifier: Apache-2.0
#
# Sets up what is missing, then runs the linters and the tests. Arguments go to pytest:
#
#     ./test.sh                    everything
#     ./test.sh -x -k estimator    what pytest understands
set -u
unset CDPATH # with it, cd would print where it went
repository=$(cd "$(dirname "${BASH_SOURCE[0]}")" && pwd -P) || exit 1
# shellcheck source=.ci/environment.sh
. "$repository/.ci/environment.sh"
environment_setup test
cd "$repository" || exit 1

say 'ruff check'
"$python" -m ruff check . || exit 1
say 'ruff format --check'
"$python" -m ruff format --check . || exit 1
# What numba and Python compile: beside mypy, instead of in the middle of tests, three times.
PYTHONPATH=test:$PYTHONPATH "$python" -c 'import tempfile
from pathlib import Path
from robots import DRUM_ENDS, behind_a_drum
from musculoskeletal_ae.emulator.reality import make_arm
from musculoskeletal_ae.mae.training import initial_mae
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.simulation.simulation import Simulation
robot = Robot.load("arm26")
for reality in ("kin", "foreign"): make_arm(robot, 0, reality).step(0.001)
Simulation(robot, initial_mae(robot, steps=1).mae).step(0.01)
with tempfile.TemporaryDirectory() as folder: behind_a_drum(Path(folder), DRUM_ENDS["stays"])' &

say 'mypy'
"$python" -m mypy || exit 1
# What pytest compiles of the tests' sources, once instead of in each of its processes.
[ -d test/nodes/__pycache__ ] || "$python" -m pytest --collect-only -q >/dev/null 2>&1
wait $! || exit 1
# For the installed package too: it is the same, and numba goes by the time of a source.
cp -pr musculoskeletal_ae/. "$repository"/install/musculoskeletal_ae/lib/python3*/*/musculoskeletal_ae

# A graph of our own: not the network's, and not that of another run on this machine.
export ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST
use_udp
export ROS_DOMAIN_ID=$(($$ % 33 * 3 + 1)) # and the next two: each process of pytest has its own
export ROS_LOG_DIR=$repository/log/test
# Its processes take all cores: torch's threads would only fight for them.
export OMP_NUM_THREADS=1

say "pytest, on ROS_DOMAIN_ID $ROS_DOMAIN_ID"
exec "$python" -m pytest -n 3 --dist worksteal "$@"
