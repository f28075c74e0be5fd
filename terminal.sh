# shellcheck shell=bash
# SPDX-License-Identifier: Apache-2.0
#
# Prepares a terminal for the commands of the documents:  . ./terminal.sh
#
# Installs and builds what is missing, enters .venv, and makes the executables of this package known
# to `ros2 run`. $bin is their folder, for terminals without the command `ros2`. If no ROS is
# sourced, the terminal sees only arms on this machine, unless ROS_AUTOMATIC_DISCOVERY_RANGE is set.
# Its nodes exchange messages over UDP, as those of bringup.sh (.ci/udp.sh).
# With CDPATH, cd might enter another directory, and print it.
if (
  repository=$(CDPATH='' cd "$(dirname "${BASH_SOURCE[0]}")" && pwd -P) || exit 1
  . "$repository/.ci/environment.sh"
  environment_setup
); then
  bin=$(CDPATH='' cd "$(dirname "${BASH_SOURCE[0]}")" && pwd -P)
  if [ -z "${ROS_DISTRO-}" ]; then
    export AMENT_PREFIX_PATH=$bin/.venv
    export ROS_AUTOMATIC_DISCOVERY_RANGE=${ROS_AUTOMATIC_DISCOVERY_RANGE:-LOCALHOST}
  fi
  # shellcheck disable=SC1091
  . "$bin/.venv/bin/activate"
  # shellcheck disable=SC1091
  COLCON_PYTHON_EXECUTABLE=$(readlink -f "$bin/.venv/bin/python") . "$bin/install/setup.bash"
  # shellcheck disable=SC1091
  . "$bin/.ci/udp.sh"
  # shellcheck disable=SC2034  # used by the commands of the documents
  bin=$bin/install/musculoskeletal_ae/lib/musculoskeletal_ae
else
  return 1
fi
