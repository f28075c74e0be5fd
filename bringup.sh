#!/usr/bin/env bash
# SPDX-License-Identifier: Apache-2.0
#
# Runs the whole system on the emulated arm, or on your own. This is the launch file: what is started, with which
# parameters, stands at the end, under "The system".
set -u
unset CDPATH # with it, cd would print where it went
repository=$(cd "$(dirname "${BASH_SOURCE[0]}")" && pwd -P) || exit 1

usage() {
  cat <<'EOF'
Usage: ./bringup.sh [options]

Sets up what is missing, then runs the whole system on an emulated arm and prints one status line a
second: estimation error, anomaly A, samples learned, number of checkpoints. Ctrl-C stops it all.
doc/your_robot.md leads from a robot of your own to one that learns.

  --robot NAME|DIR           a robot under config/, or a directory with robot.urdf and muscles.yaml
                             (default: musashi_left_arm)
  --checkpoint FILE          MAE to start from (default: train one, once, and keep it in the cache)
  --hardware                 your own driver instead of the emulator: waits for its muscle_states,
                             says what is wrong with them, and starts once nothing is
  --no-controller            nothing may move the arm
  --combined                 estimator and controller in one process
  --bag DIR                  a recording instead of the emulator: no controller, no emulator
  --explore | --no-explore   random exploration, so that learning has data (default: on; with
                             --hardware off: a real arm moves when it is told to)
  --no-learner               no online learning
  --preset default|paper     the best we can measure, or as printed in the paper (default: default)
  --seed N                   which individual arm the emulator is (default: 0)
  --reality kin|foreign|FILE.xml
                             its body: the first, a second one whose mechanics are foreign to the
                             learner, or a MuJoCo model with the robot's names (default: kin)
  --joint-source sensor|marker|none
                             what the learner knows of joint angles: all of them, what a camera sees of
                             the hand, or nothing; the status line shows the emulator's own angles
                             (default: sensor)
  --namespace NS             run everything under /NS
  --duration S               stop after S seconds, counted from when the system is up
                             (default: run until Ctrl-C)
  --record DIR               record the topics to an mcap bag
  --view                     show the arm on a page, http://localhost:8080 (the first time: installs
                             what it needs)
  --port N                   of the page (default: 8080)
  --read-only                a page without controls
  -h, --help                 this text

Exit status: 0 at the end of --duration, 130 on Ctrl-C, 1 if a part died, 2 for a wrong option.
EOF
}

refuse() {
  printf 'bringup.sh: %s\n' "$1" >&2
  exit 2
}

# --- options -------------------------------------------------------------------------------------

robot=musashi_left_arm
checkpoint=
explore= # on, but for hardware
preset=default
seed=0
reality=kin
joint_source=sensor
namespace=
learner=true
controller=true
combined=false
hardware=false
bag=
record=
view=
port=8080
read_only=()
duration= # until Ctrl-C

while [ $# -gt 0 ]; do
  # Both "--seed 1" and "--seed=1".
  value= # that comes with its option
  if [[ $1 == --*=* ]]; then
    value=$1
    set -- "${1%%=*}" "${1#*=}" "${@:2}"
  fi
  case $1 in
    --robot | --checkpoint | --bag | --preset | --seed | --reality | --joint-source | --namespace | --duration | --record | --port)
      if [ $# -lt 2 ] || [ -z "$2" ] || [[ $2 == --* ]]; then refuse "$1 needs a value"; fi
      option=${1#--}
      printf -v "${option//-/_}" %s "$2" && shift
      value=
      ;;
    --view) view=view ;;
    --read-only) read_only=(--read-only) ;;
    --explore) explore=true ;;
    --no-explore) explore=false ;;
    --no-learner) learner=false ;;
    --hardware) hardware=true ;;
    --no-controller) controller=false ;;
    --combined) combined=true ;;
    -h | --help) usage && exit ;;
    *) refuse "unknown option '$1'; legal are $(usage | grep -o -e '--[a-z-]*' | sort -u | paste -sd ' ')" ;;
  esac
  [ -z "$value" ] || refuse "$1 takes no value, and '$value' gives it one"
  shift
done

if [ -f "$repository/config/$robot/muscles.yaml" ] && [[ $robot != */* ]]; then
  robot_directory=$repository/config/$robot
elif [ -d "$robot" ]; then
  robot=$(cd "$robot" && pwd -P) || exit 2
  robot_directory=$robot
else
  refuse "--robot '$robot' is neither a directory nor one of: $(
    cd "$repository/config" && for each in */muscles.yaml; do printf '%s ' "${each%/*}"; done
  )"
fi
if [ -n "$checkpoint" ]; then
  if [ ! -r "$checkpoint" ] || [ ! -f "$checkpoint" ]; then
    refuse "--checkpoint '$checkpoint' is not a file that can be read"
  fi
  checkpoint=$(cd "$(dirname "$checkpoint")" && pwd -P)/$(basename "$checkpoint")
fi
if [ -n "$bag" ]; then
  [ -e "$bag" ] || refuse "--bag '$bag' is neither a bag directory nor an .mcap file"
  bag=$(cd "$(dirname "$bag")" && pwd -P)/$(basename "$bag")
  [ $hardware = false ] || refuse '--bag and --hardware exclude each other: which of them is it?'
fi
if [ $combined = true ] && { [ $controller = false ] || [ -n "$bag" ]; }; then
  refuse '--combined is estimator and controller in one process: not with --no-controller or --bag'
fi
if [ -z "$view" ] && { [ "$port" != 8080 ] || [ ${#read_only[@]} -gt 0 ]; }; then
  refuse '--port and --read-only are of the page: they go with --view'
fi
if [ "$reality" != kin ] && { [ $hardware = true ] || [ -n "$bag" ]; }; then
  refuse '--reality is of the emulator: not with --hardware or --bag'
fi
if [ "$explore" = true ] && { [ $controller = false ] || [ -n "$bag" ]; }; then
  refuse '--explore moves the arm: not with --no-controller or --bag'
fi
if [ "$joint_source" = none ] && [ $learner = false ]; then
  refuse '--joint-source none is for the learner: not with --no-learner'
fi
[ -n "$explore" ] || explore=$([ $hardware = true ] && echo false || echo true)
if [ -n "$record" ]; then
  [ ! -e "$record" ] || refuse "--record '$record' is there already; name a new directory"
  record=$(realpath -m "$record")
fi
[[ $preset =~ ^(default|paper)$ ]] || refuse "--preset '$preset' must be default or paper"
[[ $seed =~ ^[0-9]{1,9}$ ]] || refuse "--seed '$seed' must be a whole number from 0 to 999999999"
seed=$((10#$seed))
if [[ ! $reality =~ ^(kin|foreign)$ ]]; then
  [ -f "$reality" ] || refuse "--reality '$reality' must be kin, foreign or an MJCF file"
  reality=$(realpath "$reality")
fi
[[ $joint_source =~ ^(sensor|marker|none)$ ]] ||
  refuse "--joint-source '$joint_source' must be sensor, marker or none"
if [ -n "$duration" ]; then
  [[ $duration =~ ^[0-9]{1,9}(\.[0-9]+)?$ && $duration =~ [1-9] ]] ||
    refuse "--duration '$duration' must be a number of seconds above 0, such as 30 or 2.5"
fi
if ! [[ $port =~ ^[0-9]{1,5}$ ]] || [ $((10#$port)) -lt 1 ] || [ $((10#$port)) -gt 65535 ]; then
  refuse "--port '$port' must be a whole number from 1 to 65535"
fi
namespace=${namespace#/}
[[ -z $namespace ||
  $namespace =~ ^[A-Za-z_][A-Za-z0-9_]*(/[A-Za-z_][A-Za-z0-9_]*)*$ && $namespace != *__* && ${#namespace} -le 100 ]] ||
  refuse "--namespace '$namespace' must be at most 100 letters, digits and single _ (and / between levels)"

# --- environment ---------------------------------------------------------------------------------

# shellcheck source=.ci/environment.sh
. "$repository/.ci/environment.sh"
environment_setup $view # installs nothing more without --view

# Emulated arms are nobody else's business on the network, unless the user says so. A driver may well
# run on another machine.
[ $hardware = true ] ||
  export ROS_AUTOMATIC_DISCOVERY_RANGE=${ROS_AUTOMATIC_DISCOVERY_RANGE:-LOCALHOST}
use_udp

# One arm to a namespace. The lock is held until the last of what is started here has ended, which
# after Ctrl-C takes a moment.
in_use=/tmp/musculoskeletal_ae-${ROS_DOMAIN_ID:-0}-${namespace//\//.}.lock
[ -e "$in_use" ] || (umask 022 && : >>"$in_use") || exit 1
exec {arm_lock}<"$in_use"
flock -w 5 "$arm_lock" ||
  refuse "namespace '/$namespace' is in use by another bringup.sh (ROS_DOMAIN_ID ${ROS_DOMAIN_ID:-0}):\
 stop that one, or give this one a --namespace of its own"

logs=$(mktemp -d "$repository/log/bringup-$(date +%Y%m%d-%H%M%S)-XXXXXX") || exit 1
export ROS_LOG_DIR=$logs
say "logs in $logs"

# --- processes: start, watch, stop, always by pid ------------------------------------------------

declare -A pid_of=()

# Even if this script is killed with SIGKILL, the kernel ends what it started.
with_us=()
if setpriv --pdeathsig TERM true 2>/dev/null; then with_us=(setpriv --pdeathsig TERM); fi

launch() { # NAME ARGUMENT…
  # Through $python, because a #! line cannot name a path with a space in it.
  "${with_us[@]}" "$python" "$executables/$1" "${@:2}" </dev/null &
  pid_of[$1]=$!
}

start() { # NAME ARGUMENT…   Output goes to NAME.log.
  say "starting $1"
  launch "$@" >"$logs/$1.log" 2>&1
}

is_running() { kill -0 "$1" 2>/dev/null; }

stop() {
  local name pid deadline=$((SECONDS + 5))
  for pid in "${pid_of[@]}"; do kill -TERM "$pid" 2>/dev/null; done
  for name in "${!pid_of[@]}"; do
    pid=${pid_of[$name]}
    while is_running "$pid" && [ $SECONDS -lt $deadline ]; do sleep 0.1; done
    if is_running "$pid"; then
      printf '%s\n' "$name did not stop within 5 s: killed" >&2
      kill -KILL "$pid"
    fi
    wait "$pid" 2>/dev/null
  done
  pid_of=()
}

finish() { # STATUS
  trap '' INT TERM HUP PIPE
  trap - EXIT
  stop
  [ -z "${training-}" ] || rm -rf "$training"
  exit "$1"
}
trap 'say stopping; finish 130' INT
trap 'finish 143' TERM
trap 'finish 129' HUP
trap 'finish 141' PIPE
trap 'finish $?' EXIT

died() { # NAME STATUS
  trap '' PIPE
  printf '%s\n' "$1 ended with status $2. The end of $logs/$1.log:" >&2
  tail -n 20 "$logs/$1.log" >&2
  finish 1
}

# Watches everything until NAME (or the replayed bag) has ended, and returns its status; any other end
# is a failure.
watch_until_ended() { # NAME
  local name status
  while true; do
    for name in "${!pid_of[@]}"; do
      if ! is_running "${pid_of[$name]}"; then
        status=0
        wait "${pid_of[$name]}" || status=$?
        unset "pid_of[$name]"
        [ "$name" = "$1" ] || [ "$name $status" = 'replay 0' ] || died "$name" "$status"
        return "$status"
      fi
    done
    sleep 0.2
  done
}

# --- checkpoint ----------------------------------------------------------------------------------

# Sets $checkpoint. The name of the cached file tells what it was made from, so that another robot or
# another network is another file.
train_once() {
  local cache=${XDG_CACHE_HOME:-${HOME-}/.cache}/musculoskeletal_ae hash status=0
  mkdir -p "$cache" 2>/dev/null && [ -w "$cache" ] || cache=$repository/.cache
  hash=$(
    {
      (cd "$robot_directory" && sha256sum robot.urdf muscles.yaml) # what a network is made from
      cd "$repository/musculoskeletal_ae" &&
        find robot mae presets.* tools/initial_training.py \( -name '*.py' -o -name '*.yaml' \) \
          -print0 | LC_ALL=C sort -z | xargs -0 sha256sum
    } | sha256sum | cut -c 1-16
  )
  checkpoint=$cache/$(basename "$robot_directory")-$preset-$hash.safetensors
  if [ -s "$checkpoint" ]; then
    say "checkpoint from an earlier run: $checkpoint"
    return
  fi
  # In a folder of its own, then renamed: neither an interruption nor a second run leaves half a file.
  training=$(mktemp -d "$cache/.training-XXXXXX") || exit 1
  [ -t 1 ] || export TQDM_MININTERVAL=5 # a progress bar in a file: a line now and then
  say "training the MAE of $(basename "$robot_directory"), once (about a minute)"
  launch train --robot "$robot" --preset "$preset" --out "$training/$(basename "$checkpoint")" \
    > >(tee "$logs/train.log") 2>&1
  watch_until_ended train || status=$?
  [ $status -eq 0 ] || died train $status
  mv -f "$training/$(basename "$checkpoint")" "$checkpoint" || exit 1
  rm -rf "$training"
  training=
}

# --- The system ----------------------------------------------------------------------------------

quoted() { printf "'%s'" "${1//\'/\'\'}"; } # as YAML, which ROS parameters are

common=(--ros-args --params-file "$repository/config/nodes.yaml"
  -p "robot:=$(quoted "$robot")" -p "preset:=$preset"
  -p "seed:=$seed")
remap=()
[ -z "$namespace" ] || remap=(--ros-args -r "__ns:=/$namespace")
[ -z "$namespace" ] || common+=(-r "__ns:=/$namespace")

# A recording brings its own time and its own commands: no emulator and no controller.
if [ -n "$bag" ]; then
  common+=(-p use_sim_time:=true)
elif [ $hardware = false ]; then
  camera=()
  [ "$joint_source" != marker ] || camera=(-p marker_pose_rate:=10.0)
  start hardware_emulator "${common[@]}" -p "reality:=$(quoted "$reality")" "${camera[@]}"
  # Whether a file is the same robot is for who started it to know, not for a log alone.
  tail -n +1 -s 0.2 -f --pid="${pid_of[hardware_emulator]}" "$logs/hardware_emulator.log" \
    </dev/null 2>/dev/null |
    sed -un 's/^\[WARN\][^:]*: \(reality .*\)/-- \1/p' &
fi

[ -n "$checkpoint" ] || train_once
if [ $hardware = true ]; then
  # Nothing that could move the arm is there before its driver says what it must.
  rate=$(sed -n 's/^    rate: *\([0-9.]*\).*/\1/p' "$repository/config/nodes.yaml")
  check=(--robot "$robot" --rate "$rate" --wait --seconds 3)
  ! grep -qiE '^    zero_at_start: *(true|yes|on)' "$repository/config/nodes.yaml" || check+=(--unzeroed)
  launch check_driver "${check[@]}" "${remap[@]}"
  status=0
  watch_until_ended check_driver || status=$?
  [ $status -eq 0 ] || finish 1
fi
common+=(-p "checkpoint:=$(quoted "$checkpoint")")

[ $combined = true ] || start estimator "${common[@]}"
start sim "${common[@]}"
# What is learned of an emulated arm stays with the logs: the next run may be another one. Hardware is
# the same arm tomorrow, and the learner goes on from where it was.
kept=(-p "state_directory:=$(quoted "$logs/learner")")
[ $hardware = false ] || kept=()
[ $learner = false ] || start learner "${common[@]}" "${kept[@]}" \
  -p "joint_source:=$joint_source"
[ -z "$record" ] || start record -o "$record" "${remap[@]}"
if [ -n "$bag" ]; then
  start replay "$bag" --clock "${remap[@]}"
elif [ $controller = true ]; then
  moving=(-p "explore:=$explore")
  # A pause of a busy desktop is no fault of an emulated arm.
  [ $hardware = true ] || moving+=(-p max_age:=1.0)
  name=controller
  [ $combined = false ] || name=combined
  start $name "${common[@]}" "${moving[@]}"
fi

if [ -n "$view" ]; then
  start view --robot "$robot" --port "$port" "${read_only[@]}" "${remap[@]}"
  say "the arm is on http://localhost:$port"
fi

# The status line. It counts --duration from when estimates arrive, however late that is on a slow
# machine, and ends after it; without any estimate it gives up.
seconds=${duration:-0} # 0: without end
[[ $seconds == *.* ]] || seconds+=.0 # a ROS double
launch bringup_status "${common[@]}" \
  -p "duration:=$seconds" ${duration:+-p patience:=300.0} 2>"$logs/bringup_status.log"

status=0
watch_until_ended bringup_status || status=$?
if [ $status -ne 0 ] || [ -z "$duration$bag" ]; then died bringup_status $status; fi
say stopping
finish 0
