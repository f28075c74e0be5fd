#!/usr/bin/env bash
# SPDX-License-Identifier: Apache-2.0
#
# Sets up what is missing, then runs the linters and the tests. Arguments go to pytest:
#
#     ./test.sh                    everything
#     ./test.sh -x -k estimator    with options of pytest
set -u
unset CDPATH # otherwise cd may print the directory
repository=$(cd "$(dirname "${BASH_SOURCE[0]}")" && pwd -P) || exit 1
# shellcheck source=.ci/environment.sh
. "$repository/.ci/environment.sh"
environment_setup test
cd "$repository" || exit 1

# Tests of the page need a browser.
if ! command -v chromium chromium-browser google-chrome >/dev/null; then
  install_with_apt chromium || say 'chromium is not installed, so the page is not tested in a browser'
fi

say 'ruff check'
"$python" -m ruff check . || exit 1
say 'ruff format --check'
"$python" -m ruff format --check . || exit 1
say 'mypy'
"$python" -m mypy || exit 1

# Use a private ROS graph, separate from the network and from other runs on this machine.
export ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST
# shellcheck source=.ci/udp.sh
. "$repository/.ci/udp.sh"
export ROS_DOMAIN_ID=$(($$ % 25 * 4 + 1)) # and the next three, one for each process of pytest
export ROS_LOG_DIR=$repository/log/test
# Because many tests wait for messages in real time, it takes four processes of pytest to keep two
# cores busy. Further threads of torch would slow them down.
export OMP_NUM_THREADS=1

say "pytest, on ROS_DOMAIN_ID $ROS_DOMAIN_ID"
# Fast DDS may block a process of pytest forever while a node is destroyed or another one disappears
# (eProsima/Fast-DDS 6193, 6502). The process then ends after faulthandler_timeout (pyproject.toml).
# Its test is run once more and reported as RERUN, as after a crash. A test that failed is not run
# again, because no failure matches the pattern (?!).
exec "$python" -m pytest -n 4 --dist worksteal --reruns 1 --only-rerun '(?!)' "$@"
