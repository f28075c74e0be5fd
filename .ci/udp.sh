# shellcheck shell=bash
# SPDX-License-Identifier: Apache-2.0
#
# Makes Fast DDS use UDP only. After a node was killed or suspended, its shared memory may prevent it
# or its successor from receiving messages (eProsima/Fast-DDS 4737, 5053, 5469). On one machine, UDP
# is not slower. With ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST, rmw_fastrtps adds shared memory in
# spite of FASTDDS_BUILTIN_TRANSPORTS; the profile file keeps messages out of it.

export FASTDDS_BUILTIN_TRANSPORTS=${FASTDDS_BUILTIN_TRANSPORTS:-UDPv4}
if [ "${ROS_AUTOMATIC_DISCOVERY_RANGE-}" = LOCALHOST ]; then
  export FASTRTPS_DEFAULT_PROFILES_FILE=${FASTRTPS_DEFAULT_PROFILES_FILE:-$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd -P)/config/udp.xml}
fi
