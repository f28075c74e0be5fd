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

# The page is tested in a real browser.
if ! command -v chromium chromium-browser google-chrome >/dev/null; then
  install_with_apt chromium || say 'no chromium: the page is not tested in a browser'
fi

say 'ruff check'
"$python" -m ruff check . || exit 1
say 'ruff format --check'
"$python" -m ruff format --check . || exit 1
say 'mypy'
"$python" -m mypy || exit 1

# A graph of our own: not the network's, and not that of another run on this machine.
export ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST
use_udp
export ROS_DOMAIN_ID=$(($$ % 33 * 3 + 1)) # and the next two: each process of pytest has its own
export ROS_LOG_DIR=$repository/log/test
# Its processes take all cores: torch's threads would only fight for them.
export OMP_NUM_THREADS=1

say "pytest, on ROS_DOMAIN_ID $ROS_DOMAIN_ID"
exec "$python" -m pytest -n 3 --dist worksteal "$@"
