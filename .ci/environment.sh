# shellcheck shell=bash
# SPDX-License-Identifier: Apache-2.0
#
# Sourced by bringup.sh and test.sh: makes .venv, installs what is missing, builds the package with
# colcon and sets up this shell for it. Every step is skipped when its stamp says that nothing has
# changed, so that the second run takes about a second.
#
#     repository=…                       # absolute, before sourcing
#     environment_setup [test|view]      # "test": with the tools of test.sh, "view": with what the
#                                        # page in the browser needs; exits on failure
#
# Afterwards: $python is the interpreter, $executables the folder of the package's executables.

: "${repository:?is set before this file is sourced}"

TORCH_CPU_INDEX=https://download.pytorch.org/whl/cpu
PIP=26.3 # Debian's takes twice as long to find out what fits together
TORCH=$(sed -n 's/^torch==//p' "$repository/requirements.txt")

venv=$repository/.venv
executables=$repository/install/musculoskeletal_ae/lib/musculoskeletal_ae
python=$venv/bin/python

say() { printf '%s\n' "-- $*"; }

fail() {
  printf '%s\n' "$@" >&2
  exit 1
}

# --- one step, with progress -------------------------------------------------------------------

# Usage: step TITLE COMMAND…   Output goes to the set-up's log; its tail is shown on failure.
step() {
  local title=$1 pid status=0 start=$SECONDS shown=0 elapsed
  shift
  say "$title"
  printf '\n== %s\n%s\n' "$title" "$*" >>"$setup_log"
  set -m # a process group of its own, so that pip or apt-get ends with us and not after us
  "$@" >>"$setup_log" 2>&1 </dev/null &
  pid=$!
  set +m
  # shellcheck disable=SC2064  # the pid of now
  trap "kill -- -$pid 2>/dev/null; wait $pid; exit 130" INT
  # shellcheck disable=SC2064
  trap "kill -- -$pid 2>/dev/null; wait $pid; exit 143" TERM HUP
  while kill -0 "$pid" 2>/dev/null; do
    sleep 0.2
    elapsed=$((SECONDS - start))
    if [ -t 1 ]; then
      printf '\r   %d s  %.60s\033[K' "$elapsed" "$(tail -n 1 "$setup_log" | tr -cd '[:print:]')"
    elif [ $((elapsed - shown)) -ge 10 ]; then
      shown=$elapsed
      printf '   … %d s\n' "$elapsed"
    fi
  done
  [ -t 1 ] && printf '\r\033[K'
  wait "$pid" || status=$?
  trap - INT TERM HUP
  if [ $status -ne 0 ]; then
    printf '%s\n' "   failed with status $status; the end of $setup_log:" >&2
    tail -n 15 "$setup_log" >&2
  fi
  return $status
}

# --- ROS: sourced or wheels ----------------------------------------------------------------------

python_is_new_enough() {
  "$1" -c 'import sys; sys.exit(not (3, 10) <= sys.version_info[:2] <= (3, 13))' \
    >/dev/null 2>&1 </dev/null
}

# Sets $ros to "sourced" or "wheels", and $base_python to the Python that .venv is made from.
# base_python stays empty where none is found.
find_ros_and_python() {
  local candidate
  local -a candidates=(python3 python3.13 python3.12 python3.11 python3.10)
  ros=wheels
  base_python=
  if [ "${ROS_DISTRO:-jazzy}" != jazzy ]; then
    fail "ROS 2 '$ROS_DISTRO' is sourced in this shell, and this package is for jazzy." \
      "Source /opt/ros/jazzy/setup.bash in a new shell, or start one with no ROS sourced:" \
      "the ROS 2 Jazzy wheels are then installed into .venv."
  fi
  # A shell started from a Python with the ROS wheels hands down that Python's library folders.
  unset _ROS_WHEELS_BOOTSTRAP_COMPLETE
  LD_LIBRARY_PATH=$(printf '%s' "${LD_LIBRARY_PATH-}" | tr ':' '\n' |
    grep -v '/site-packages/ros_[^/]*\.libs$' | paste -sd : -)
  [ -n "$LD_LIBRARY_PATH" ] || unset LD_LIBRARY_PATH
  unset PYTHONHOME
  # Nor may our own .venv, where it is active, become the Python that it is made from.
  PATH=:$PATH:
  PATH=${PATH//":$venv/bin:"/:}
  PATH=${PATH#:}
  PATH=${PATH%:}

  if [ "${ROS_DISTRO-}" = jazzy ]; then
    for candidate in "${candidates[@]}" /usr/bin/python3; do
      if python_is_new_enough "$candidate" &&
        "$candidate" -c 'import rclpy' >/dev/null 2>&1 </dev/null; then # not .venv's: see PATH
        ros=sourced
        base_python=$(command -v "$candidate")
        return
      fi
    done
    say "ROS_DISTRO is jazzy, but no Python here can import rclpy: using the ROS wheels instead"
  fi
  # Nothing of another installation or virtual environment may leak in.
  unset ROS_DISTRO PYTHONPATH AMENT_PREFIX_PATH COLCON_PREFIX_PATH CMAKE_PREFIX_PATH
  if [ "${RMW_IMPLEMENTATION:-rmw_fastrtps_cpp}" != rmw_fastrtps_cpp ]; then
    say "RMW_IMPLEMENTATION=$RMW_IMPLEMENTATION is not among the wheels: using rmw_fastrtps_cpp"
    export RMW_IMPLEMENTATION=rmw_fastrtps_cpp
  fi
  for candidate in "${candidates[@]}"; do
    if python_is_new_enough "$candidate"; then
      base_python=$(command -v "$candidate")
      return
    fi
  done
}

# --- .venv ---------------------------------------------------------------------------------------

as_root() {
  if [ "$(id -u)" = 0 ]; then
    "$@"
  else
    sudo -n "$@"
  fi
}

venv_works() { "$python" -m pip --version >/dev/null 2>&1 </dev/null; }

make_venv_with_venv() {
  rm -rf "$venv"
  "$base_python" -m venv "${venv_options[@]}" "$venv" && venv_works
}

# Debian and Ubuntu keep ensurepip, which venv needs, in a package of its own.
install_python3_venv() {
  local version
  version=$("$base_python" -c 'import sys; print("%d.%d" % sys.version_info[:2])')
  export DEBIAN_FRONTEND=noninteractive
  as_root apt-get update
  as_root apt-get -y -o DPkg::Lock::Timeout=120 install --no-install-recommends \
    python3-venv "python$version-venv" ||
    as_root apt-get -y -o DPkg::Lock::Timeout=120 install --no-install-recommends python3-venv
}

# Into a temporary folder: nothing of the user's is changed, and PEP 668 does not forbid it.
make_venv_with_virtualenv() {
  local folder status=0
  rm -rf "$venv"
  if "$base_python" -m virtualenv --version; then
    "$base_python" -m virtualenv "${venv_options[@]}" "$venv" && venv_works
    return
  fi
  folder=$(mktemp -d)
  "$base_python" -m pip install --target "$folder" virtualenv &&
    PYTHONPATH=$folder${PYTHONPATH:+:$PYTHONPATH} \
      "$base_python" -m virtualenv "${venv_options[@]}" "$venv" && venv_works || status=$?
  rm -rf "$folder"
  return $status
}

make_venv() {
  local version
  if [ -z "$base_python" ]; then
    fail "No Python from 3.10 to 3.13 found (tried python3, python3.13 … python3.10)." \
      "On Debian or Ubuntu:  sudo apt-get install python3 python3-venv"
  fi
  if [ "$ros" = wheels ] && [ "$(uname -sm)" != 'Linux x86_64' ]; then
    say "the ROS 2 Jazzy wheels are made for Linux x86_64, this is $(uname -sm): source Jazzy here"
  fi
  venv_options=()
  [ "$ros" = sourced ] && venv_options=(--system-site-packages)
  version=$("$base_python" -c 'import platform; print(platform.python_version())')
  if step "making .venv with Python $version" make_venv_with_venv; then
    :
  elif command -v apt-get >/dev/null && as_root true 2>/dev/null &&
    step 'installing python3-venv with apt-get' install_python3_venv &&
    step 'making .venv again' make_venv_with_venv; then
    :
  elif step 'making .venv with virtualenv' make_venv_with_virtualenv; then
    :
  else
    rm -rf "$venv"
    fail "A virtual environment could not be made (log: $setup_log)." \
      "On Debian or Ubuntu:  sudo apt-get install python3-venv"
  fi
  touch "$venv/COLCON_IGNORE" # the wheels put package.xml files there
  printf '%s\n' "$repository" >"$venv/.made_for"
}

# A .venv that was interrupted, moved, or made for the other kind of ROS is made anew.
check_venv() {
  local want=false
  [ "$ros" = sourced ] && want=true
  if [ ! -e "$venv" ]; then
    make_venv
  elif [ -e "$venv/.installing" ]; then
    say 'the last installation was interrupted: starting over'
    make_venv
  elif ! grep -qi "^include-system-site-packages = $want" "$venv/pyvenv.cfg" 2>/dev/null; then
    say "the .venv here does not fit (ROS: $ros): making it anew"
    make_venv
  elif [ "$(cat "$venv/.made_for" 2>/dev/null || echo "$repository")" != "$repository" ]; then
    say '.venv was made in another place: making it anew'
    make_venv
  elif ! "$python" -c 'import pip' >/dev/null 2>&1 </dev/null; then
    say '.venv does not work: making it anew'
    make_venv
  fi
  [ -e "$venv/COLCON_IGNORE" ] || touch "$venv/COLCON_IGNORE"
}

# --- packages ------------------------------------------------------------------------------------

cpu_index_answers() {
  "$python" -c 'import sys, urllib.request
urllib.request.urlopen(sys.argv[1] + "/torch/", timeout=5).read(1)' \
    "$TORCH_CPU_INDEX" >/dev/null 2>&1 </dev/null
}

# What .venv should hold: changes with the requirements, the Python and the kind of ROS.
requirements_stamp() { # FILE…
  {
    "$python" -c 'import sys; print(sys.version)' </dev/null
    echo "$ros"
    cat "$@"
  } | sha256sum
}

# The page is tested in a real browser. Where there is none, and we may, as in CI, it is installed.
lacks_chromium() {
  ! command -v chromium chromium-browser google-chrome >/dev/null &&
    [ "$(id -u)" = 0 ] && command -v apt-get >/dev/null
}

install_chromium() {
  export DEBIAN_FRONTEND=noninteractive
  apt-get update &&
    apt-get -y -o DPkg::Lock::Timeout=120 install --no-install-recommends chromium
}

# Usage: beside FUNCTION COMMAND…   Runs both at once; the status is the command's.
beside() {
  local status=0
  "$1" &
  shift
  "$@" || status=$?
  wait
  return $status
}

install_packages() { # [test|view]
  local file title='installing torch, pinocchio, numba and colcon'
  local -a base=("$repository/requirements.txt") files arguments=() torch=() other=()
  if [ "$ros" = wheels ]; then
    base+=("$repository/.ci/requirements-ros.txt")
    title+=', the ROS 2 Jazzy wheels'
  fi
  files=("${base[@]}")
  # The tests look at the page too.
  [ -z "${1-}" ] || files+=("$repository/.ci/requirements-view.txt")
  if [ "${1-}" = test ]; then
    files+=("$repository/.ci/requirements-test.txt")
    title+=', the test tools'
    lacks_chromium && other=(beside install_chromium)
  fi
  if [ "$(cat "$venv/.installed${1:+-$1}" 2>/dev/null)" = "$(requirements_stamp "${files[@]}")" ]
  then
    return
  fi
  for file in "${files[@]}"; do arguments+=(-r "$file"); done
  if ! "$python" -c "from importlib.metadata import version
assert version('torch').split('+')[0] == '$TORCH'" >/dev/null 2>&1 </dev/null; then
    if cpu_index_answers; then # plain PyPI has torch with gigabytes of CUDA
      torch=("torch==$TORCH+cpu" --extra-index-url "$TORCH_CPU_INDEX")
    else
      say "PyTorch's index of CPU builds does not answer: taking torch from the default index"
    fi
  fi
  # The mark stays if pip is killed half-way, which can leave packages that only look complete; on
  # an error of its own pip installs nothing.
  touch "$venv/.installing"
  export PIP_USER=0 PIP_NO_INPUT=1 PIP_DISABLE_PIP_VERSION_CHECK=1
  step "installing pip $PIP" "$python" -m pip install "pip==$PIP" || say 'going on with the pip of .venv'
  if ! step "$title (minutes, the first time)" \
    "${other[@]}" "$python" -m pip install --no-compile --progress-bar off \
    "${arguments[@]}" "${torch[@]}"; then
    rm -f "$venv/.installing"
    fail "The packages could not be installed (log: $setup_log). Is the network there?" \
      "Run the same command again to go on."
  fi
  rm -f "$venv/.installing"
  requirements_stamp "${base[@]}" >"$venv/.installed"
  [ -z "${1-}" ] || requirements_stamp "${files[@]}" >"$venv/.installed-$1"
}

# --- colcon --------------------------------------------------------------------------------------

# One line per file that matters to the build: a changed, new or removed file changes the list.
package_files() {
  printf '%s\n' "$venv $ros $repository"
  (cd "$repository" && find musculoskeletal_ae config resource package.xml setup.py setup.cfg \
    -name __pycache__ -prune -o -type f ! -name '*.pyc' -print0 | LC_ALL=C sort -z |
    xargs -0 sha256sum)
}

colcon_build() {
  cd "$repository" &&
    "$venv/bin/colcon" --log-base log build --base-paths . --packages-select musculoskeletal_ae \
      --event-handlers console_cohesion+ console_direct- status- desktop_notification-
}

build_package() {
  local stamp=$repository/build/.stamp now
  now=$(package_files)
  if [ "$now" = "$(cat "$stamp" 2>/dev/null)" ] && [ -x "$executables/estimator" ] &&
    [ -e "$repository/install/setup.bash" ]; then
    return
  fi
  # setuptools never removes what it once copied.
  if [ -e "$stamp" ] && [ -n "$(LC_ALL=C comm -13 <(cut -c 67- <<<"$now" | LC_ALL=C sort) \
    <(cut -c 67- "$stamp" | LC_ALL=C sort))" ]; then
    rm -rf "$repository/build/musculoskeletal_ae" "$repository/install/musculoskeletal_ae"
  fi
  # numba asks only whether a file is the same, not whether what it imports is.
  if [ "$(grep '\.py$' <<<"$now")" != "$(grep '\.py$' "$stamp" 2>/dev/null)" ]; then
    find "$repository/musculoskeletal_ae" "$repository/install" -name '*.nb[ci]' -delete 2>/dev/null
  fi
  rm -f "$stamp"
  step 'building with colcon' colcon_build || fail "colcon build failed (log: $setup_log)."
  [ -x "$executables/estimator" ] ||
    fail "colcon build left no $executables/estimator (log: $setup_log)."
  printf '%s\n' "$now" >"$stamp"
}

# --- all of it -----------------------------------------------------------------------------------

# Where a node was killed, Fast DDS may leave shared memory through which its successor on the same
# ports hears nothing (eProsima/Fast-DDS 4737, 5053, 5469). On one machine UDP costs no more. Where
# the graph is kept to it, rmw_fastrtps adds shared memory whatever the first variable says, and the
# file keeps messages out of that.
use_udp() {
  export FASTDDS_BUILTIN_TRANSPORTS=${FASTDDS_BUILTIN_TRANSPORTS:-UDPv4}
  [ "${ROS_AUTOMATIC_DISCOVERY_RANGE-}" != LOCALHOST ] ||
    export FASTRTPS_DEFAULT_PROFILES_FILE=${FASTRTPS_DEFAULT_PROFILES_FILE:-$repository/config/udp.xml}
}

environment_setup() { # [test|view]
  local lock
  # Many containers set it; a dozen processes would each compile all of torch's sources.
  unset PYTHONDONTWRITEBYTECODE
  # Where HOME cannot be written (containers), caches and logs go into the repository.
  if [ ! -d "${HOME-}" ] || [ ! -w "${HOME-}" ]; then
    export XDG_CACHE_HOME=$repository/.cache PIP_CACHE_DIR=$repository/.cache/pip
    export MPLCONFIGDIR=$repository/.cache/matplotlib
    export ROS_LOG_DIR=${ROS_LOG_DIR:-$repository/log/ros}
  fi
  setup_log=$repository/log/setup.log
  local place
  mkdir -p "$repository/log" "$repository/build" "$repository/.cache" 2>/dev/null
  for place in "$repository"/{log,build,.cache,.venv,install,log/setup.log,.cache/setup.lock}; do
    if [ -e "$place" ] && [ ! -w "$place" ] || [ ! -d "$repository/log" ]; then
      fail "$place cannot be written: $repository belongs to $(stat -c %U "$repository"), and you are\
 $(id -un). Clone it into a folder of your own, or let its owner run this."
    fi
  done

  find_ros_and_python

  # One set-up at a time: a second one waits and then finds everything done. The lock goes when this
  # shell or the last program it started closes the file, so it is closed before any node starts.
  exec {lock}>"$repository/.cache/setup.lock"
  if ! flock -n "$lock"; then
    say 'another set-up is running here: waiting for it'
    flock "$lock"
  fi
  : >"$setup_log"
  check_venv
  export VIRTUAL_ENV=$venv PATH=$venv/bin:$PATH
  # The wheels are an installation of ROS like any other.
  [ "$ros" = wheels ] && export AMENT_PREFIX_PATH=$venv
  install_packages "$@"
  if [ "${1-}" = test ] && lacks_chromium; then
    step 'installing chromium with apt-get' install_chromium ||
      say 'no chromium: the page is not tested in a browser'
  fi
  build_package
  exec {lock}>&-

  # colcon's scripts read variables that are not set, and do not quote the path of their Python,
  # which a space in this repository's path would break: another Python does for them.
  local flags=$- COLCON_PYTHON_EXECUTABLE
  # shellcheck disable=SC2034
  COLCON_PYTHON_EXECUTABLE=${base_python:-$python}
  set +u
  # shellcheck disable=SC1091
  . "$repository/install/setup.bash"
  [[ $flags == *u* ]] && set -u
  return 0
}
