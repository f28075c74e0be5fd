# shellcheck shell=bash
# SPDX-License-Identifier: Apache-2.0
#
# Sourced by bringup.sh and test.sh. Installs missing packages into .venv, builds the package with
# colcon, and sets up this shell for it. Later runs take seconds.
#
#     repository=…               # absolute, before sourcing
#     environment_setup [test]   # "test": with the tools of test.sh; exits on failure
#
# Afterwards $python is the interpreter, and $executables the folder of the package's executables.

: "${repository:?must be set before this file is sourced}"

TORCH_CPU_INDEX=https://download.pytorch.org/whl/cpu

venv=$repository/.venv
python=$venv/bin/python
# shellcheck disable=SC2034  # used by scripts that source this file
executables=$repository/install/musculoskeletal_ae/lib/musculoskeletal_ae
setup_log=$repository/log/setup.log

say() { printf '%s\n' "-- $*" 2>/dev/null; } # even if the output is full

fail() {
  printf '%s\n' "$@" >&2
  exit 1
}

# Usage: step TITLE COMMAND…   Logs the output of the command, and shows the end of it on failure.
step() {
  say "$1"
  printf '\n== %s\n' "$*" >>"$setup_log"
  shift
  "$@" 2>&1 </dev/null | tee -a "$setup_log" | show_progress
  [ "${PIPESTATUS[0]}" -ne 0 ] || return 0
  printf '%s\n' "   failed; the end of $setup_log:" >&2
  tail -n 15 "$setup_log" >&2
  return 1
}

# On a terminal, each line replaces the previous one. Otherwise a line is shown every 20 s.
show_progress() {
  local line shown=$SECONDS
  while read -r line; do
    if [ -t 1 ]; then
      printf '\r   %.70s\033[K' "$line"
    elif ((SECONDS - shown >= 20)); then
      shown=$SECONDS
      printf '   %.70s\n' "$line"
    fi
  done
  [ ! -t 1 ] || printf '\r\033[K'
}

# --- ROS 2 Jazzy: sourced, or from PyPI ----------------------------------------------------------

# Sets $ros to "sourced" or "wheels".
find_ros() {
  case ${ROS_DISTRO-} in
    jazzy) ros=sourced ;;
    '')
      ros=wheels
      # The wheels are a separate installation of ROS; do not mix it with another one.
      unset PYTHONPATH PYTHONHOME LD_LIBRARY_PATH COLCON_PREFIX_PATH CMAKE_PREFIX_PATH \
        RMW_IMPLEMENTATION _ROS_WHEELS_BOOTSTRAP_COMPLETE
      export AMENT_PREFIX_PATH=$venv
      ;;
    *)
      fail "ROS 2 '$ROS_DISTRO' is sourced in this shell, but this package requires jazzy." \
        'Source /opt/ros/jazzy/setup.bash in a new shell, or use a shell without ROS:' \
        'ROS 2 Jazzy is then installed into .venv.'
      ;;
  esac
}

# --- .venv ---------------------------------------------------------------------------------------

# Written when an installation is complete. The first line names the ROS and the repository that
# .venv was made for; the other lines list the installed requirements.
installed=$venv/.installed

venv_is_complete() {
  [ "$(head -n 1 "$installed" 2>/dev/null)" = "# $ros $repository" ] &&
    "$python" -c 'import pip' 2>/dev/null
}

make_venv() {
  local base_python=${PYTHON:-python3} version
  local -a missing=() options=()
  version=$("$base_python" -c 'import sys; print("%d.%d" % sys.version_info[:2])' 2>/dev/null)
  case $version in
    3.10 | 3.11 | 3.12 | 3.13) ;;
    *)
      fail "Python 3.10 to 3.13 is required, but $base_python is ${version:-not installed}." \
        "Choose another Python:  PYTHON=python3.12 $0"
      ;;
  esac
  if [ "$ros" = sourced ]; then
    options=(--system-site-packages)
    "$base_python" -c 'import rclpy' || fail \
      "ROS_DISTRO is jazzy, but $base_python (Python $version) cannot import rclpy." \
      'Source /opt/ros/jazzy/setup.bash in a shell in which python3 is the Python of the system.'
  elif [ "$(uname -m)" != x86_64 ]; then
    fail "PyPI has ROS 2 Jazzy for x86_64 only, but this machine is $(uname -m)." \
      'Install ROS 2 Jazzy, source /opt/ros/jazzy/setup.bash, and try again.'
  fi
  # Minimal installations of Debian and Ubuntu lack venv's pip and a library of pinocchio.
  "$base_python" -c 'import ensurepip' 2>/dev/null || missing+=("python$version-venv")
  "$base_python" -c 'import ctypes; ctypes.CDLL("libgomp.so.1")' 2>/dev/null || missing+=(libgomp1)
  if [ ${#missing[@]} -gt 0 ]; then
    install_with_apt "${missing[@]}" || fail \
      "This machine lacks ${missing[*]}. On Debian or Ubuntu:  sudo apt-get install ${missing[*]}"
  fi
  rm -rf "$venv"
  step "creating .venv with Python $version" "$base_python" -m venv "${options[@]}" "$venv" ||
    fail '.venv could not be created.'
}

# Fails without apt-get, or if sudo would require a password.
install_with_apt() { # PACKAGE…
  local -a as_root=()
  [ "$(id -u)" = 0 ] || as_root=(sudo -n)
  command -v apt-get >/dev/null && "${as_root[@]}" true 2>/dev/null || return
  step 'updating the package lists of apt-get' "${as_root[@]}" apt-get update &&
    step "installing $* with apt-get" "${as_root[@]}" env DEBIAN_FRONTEND=noninteractive \
      apt-get -y -o DPkg::Lock::Timeout=120 install --no-install-recommends "$@"
}

# Installs the requirements, unless every line of them was installed before.
install_requirements() { # FILE…
  local file
  local -a arguments=()
  if [ -e "$installed" ] && ! cat "$@" | grep -qvxFf "$installed"; then return; fi
  for file in "$@"; do arguments+=(-r "$file"); done
  # Torch from PyPI contains gigabytes of CUDA; the CPU build is sufficient.
  if "$python" -c "import urllib.request
urllib.request.urlopen('$TORCH_CPU_INDEX/torch/', timeout=5)" 2>/dev/null; then
    arguments+=(--extra-index-url "$TORCH_CPU_INDEX")
  fi
  # A killed pip may leave an installation that looks complete. While $installed is missing, .venv
  # counts as incomplete and the next run creates it again.
  rm -f "$installed"
  step "installing ${*##*/} into .venv (this takes minutes the first time)" \
    "$python" -m pip install --no-compile "${arguments[@]}" ||
    fail 'The packages could not be installed. Check the connection to the internet,' \
      'and run the same command again to continue.'
  { echo "# $ros $repository" && cat "$@"; } >"$installed"
}

# --- the package ---------------------------------------------------------------------------------

# The build links to the sources. It is therefore repeated only if a file that describes the package,
# or the list of installed files, has changed.
build_package() {
  local stamp=build/.built described
  described=$(
    {
      printf '%s\n' "$ros" "$repository" "$(readlink -f "$python")"
      cat setup.py setup.cfg package.xml requirements.txt
      find bags config resource -type f | LC_ALL=C sort
    } | sha256sum
  )
  if [ -e install/setup.bash ] && [ "$(cat $stamp 2>/dev/null)" = "$described" ]; then return; fi
  rm -f $stamp
  step 'building the package with colcon' "$python" -m colcon --log-base log build \
    --symlink-install --base-paths . --packages-select musculoskeletal_ae \
    --event-handlers desktop_notification- || fail 'The package could not be built.'
  printf '%s\n' "$described" >$stamp
}

# Compiles all numba functions, so that nodes need not compile when they start. Numba's cache does
# not notice changes of functions that are called from another file. All functions are therefore
# compiled again after a change to any file that contains one.
compile_package() { # PACKAGE STAMP
  local package=$1 stamp=$2
  if [ -e "$stamp" ] && [ -z "$(find "$package" -name '*.py' -newer "$stamp" \
    -exec grep -l njit {} +)" ]; then return; fi
  find "$package" -name '*.nb[ci]' -delete
  step 'compiling with numba (half a minute the first time, or minutes on a busy computer)' \
    env PYTHONPATH="${package%/*}${PYTHONPATH:+:$PYTHONPATH}" "$python" "$repository/.ci/compile.py" ||
    fail 'The package could not be compiled.'
  touch "$stamp"
}

# --- all of it -----------------------------------------------------------------------------------

environment_setup() { # [test]
  local - folder # "-" restores the options of the shell at the end
  local -a requirements=(requirements.txt)
  trap 'exit 130' INT
  PATH=${PATH//"$venv/bin:"/} # so that .venv is not created from itself
  unset PYTHONDONTWRITEBYTECODE # if set, each process would compile all of torch's Python files
  find_ros
  [ "$ros" = sourced ] || requirements+=(.ci/requirements-ros.txt)
  [ "${1-}" != test ] || requirements+=(.ci/requirements-test.txt)
  for folder in "$repository" "$repository"/{.venv,build,install,log}; do
    [ ! -e "$folder" ] || [ -w "$folder" ] ||
      fail "$folder cannot be written: it belongs to $(stat -c %U "$folder"), and you are $(id -un)." \
        'Clone the repository into a folder of your own, or let the owner run this script.'
  done
  mkdir -p "$repository/log" "$repository/build"

  # Only one set-up runs at a time. A second one waits, and then has nothing to do.
  (
    flock -n 9 || { say 'waiting for another set-up in this repository to finish' && flock 9; }
    : >"$setup_log"
    cd "$repository" || exit
    venv_is_complete || make_venv
    install_requirements "${requirements[@]}"
    build_package
    compile_package "$repository/musculoskeletal_ae" build/.compiled
  ) 9>"$repository/log/setup.lock" || exit 1
  trap - INT

  export VIRTUAL_ENV=$venv PATH=$venv/bin:$PATH
  # colcon's scripts read unset variables, and do not quote the path of Python.
  set +u
  # shellcheck disable=SC1091
  COLCON_PYTHON_EXECUTABLE=$(readlink -f "$python") . "$repository/install/setup.bash"
}

# Lets as many processes of this machine discover each other as Fast DDS has ports for, which are 101.
# With ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST, rmw_fastrtps sends announcements to the ports of the
# first 32 processes only. The profile that is written here names the other ports of the domain.
discover_many() { # FILE
  local id port peers=
  [ "${FASTRTPS_DEFAULT_PROFILES_FILE-}" = "$repository/config/udp.xml" ] || return 0
  [[ ${ROS_DOMAIN_ID:-0} =~ ^[0-9]+$ ]] || return 0 # rcl will refuse it
  for ((id = 32; id <= 100; id++)); do
    port=$((7400 + 250 * 10#${ROS_DOMAIN_ID:-0} + 10 + 2 * id)) # RTPS specification, 9.6.1.1
    peers+="<locator><udpv4><address>127.0.0.1</address><port>$port</port></udpv4></locator>"
  done
  sed "s|<rtps>|&<builtin><initialPeersList>$peers</initialPeersList></builtin>|" \
    "$FASTRTPS_DEFAULT_PROFILES_FILE" >"$1" && export FASTRTPS_DEFAULT_PROFILES_FILE=$1
}
