#!/usr/bin/env bash
# SPDX-License-Identifier: Apache-2.0
#
# Runs the whole system on an emulated arm or on your own. This is the launch file: the section
# "The system" at the end starts the nodes with their parameters.
set -u
# Without stdout or stderr, the next file that is opened would be taken for it.
{ : >&1; } 2>/dev/null || exec >/dev/null
{ : >&2; } 2>/dev/null || exec 2>/dev/null
unset CDPATH # otherwise cd may print the directory
here=$(cd "$(dirname "$(readlink -f "${BASH_SOURCE[0]}")")" && pwd -P) || exit 1
if [ -e "$here/setup.py" ]; then
  repository=$here
  is_installed=false
else
  # Installed as lib/musculoskeletal_ae/bringup.sh: the sourced workspace has everything else.
  repository=$(cd "$here/../../share/musculoskeletal_ae" && pwd -P) || exit 1
  is_installed=true
fi

usage() {
  cat <<'EOF'
Usage: ./bringup.sh [options]

Sets up what is missing, then runs the whole system on an emulated arm and prints one status line a
second: estimation error, anomaly A, samples learned, number of checkpoints. Ctrl-C stops it all.
doc/howto/your_robot.md is the guide for your own robot.

  --robot NAME|DIR           a robot under config/, or a directory with robot.urdf and muscles.yaml
                             (default: musashi_left_arm)
  --mujoco FILE.xml          a MuJoCo model instead of a robot: imports it, reports the changes,
                             trains, and emulates the model itself (doc/howto/mujoco.md). The
                             options --joints, --muscles, --without NAME,…, --base and --end NAME
                             are passed to import_robot
  --checkpoint FILE          network to start from (default: train one once, and cache it)
  --quick                    a tenth of the initial training, for a first try
  --hardware                 your own driver instead of the emulator: waits for its muscle_states,
                             reports faults, and starts the nodes when all checks pass
  --no-controller            start no controller, so that nothing moves the arm
  --combined                 estimator and controller in one process
  --bag DIR                  a recording instead of the emulator: no controller, no emulator. It has
                             to be one of the robot that --robot names
  --from-namespace NS        with --bag: namespace of the arm to play, if the recording has several
  --explore | --no-explore   random exploration, so that learning has data (default: on; with
                             --hardware off: a real arm moves only on request)
  --no-learner               no online learning
  --preset default|paper     the most accurate methods, or exactly those of the paper
                             (default: default)
  --seed N                   seed of the emulated individual and of the exploration (default: 0;
                             with --hardware another one at each start, so that an arm explores
                             other postures; for a MuJoCo model: the model without deviations)
  --reality kin|foreign|FILE.xml
                             emulator model: kin, foreign (with mechanics that the learner does not
                             model), or the model.xml that import_robot wrote for the robot
                             (default: kin)
  --joint-source sensor|marker|none
                             joint angles for the learner: from sensors, from a camera that observes
                             the hand, or none (the first network then takes 20 samples, about two
                             minutes); the status line still compares with the emulator's angles
                             (default: sensor)
  --params-file FILE         parameters of the nodes, in the format of config/nodes.yaml
  -p NODE:NAME:=VALUE        one parameter of one node, such as -p estimator:on_anomaly:=isolate;
                             like --params-file, it may be repeated, and overrides other options
  --namespace NS             run everything under /NS
  --network                  make an emulated arm visible in the network as far as
                             ROS_AUTOMATIC_DISCOVERY_RANGE permits, as with --hardware (default: on
                             this machine only)
  --duration S               stop after S seconds, counted from the first estimate
                             (default: run until Ctrl-C)
  --record DIR               record the topics to an mcap bag
  --view                     show the arm on a page, http://localhost:8080
  --port N                   port of the page (default: 8080)
  --read-only                a page without controls
  -h, --help                 this text

Exit status: 0 at the end of --duration or of a recording, 130 on Ctrl-C, 1 if a process failed or a
recording brought no estimate, 2 for a wrong option or a recording of another robot, 141 if a reader
of the output has closed it, as "| head" does: everything is then stopped.
EOF
}

refuse() {
  printf 'bringup.sh: %s\n' "$1" >&2
  exit 2
}

# --- options -------------------------------------------------------------------------------------
# The nodes and tools check the values and report errors.

robot=musashi_left_arm
mujoco=
chain=() # options of import_robot that select a part of the model
checkpoint=
quick=() # option of train
hardware=false
controller=true
combined=false
bag=
from=() # namespace of the recorded arm
explore= # empty: on, except with --hardware
learner=true
preset=default
seed=0
reality=kin
joint_source=sensor
parameters=() # each NODE:NAME:=VALUE
parameter_files=()
namespace=
network=false
duration= # empty: until Ctrl-C
record=
view=false
port=8080
read_only=()

nodes='controller|estimator|hardware_emulator|learner|sim'

sorted=$(getopt --name bringup.sh --options hp: --longoptions robot:,checkpoint:,hardware \
  --longoptions no-controller,combined,bag:,explore,no-explore,no-learner,preset:,seed:,reality: \
  --longoptions joint-source:,params-file:,namespace:,network,duration:,record:,view,port: \
  --longoptions read-only,quick,mujoco:,joints:,muscles:,without:,base:,end:,from-namespace:,help -- "$@") || refuse 'see ./bringup.sh --help for the legal options'
eval set -- "$sorted"
passed=$sorted
while [ $# -gt 0 ]; do
  case $1 in
    --robot) robot=$2 && shift ;;
    --mujoco) mujoco=$2 && shift ;;
    --joints | --muscles | --without | --base | --end) chain+=("$1" "$2") && shift ;;
    --checkpoint) checkpoint=$2 && shift ;;
    --quick) quick=(--quick) ;;
    --hardware) hardware=true ;;
    --no-controller) controller=false ;;
    --combined) combined=true ;;
    --bag) bag=$2 && shift ;;
    --from-namespace) from=("$2") && shift ;;
    --explore) explore=true ;;
    --no-explore) explore=false ;;
    --no-learner) learner=false ;;
    --preset) preset=$2 && shift ;;
    --seed) seed=$2 && shift ;;
    --reality) reality=$2 && shift ;;
    --joint-source) joint_source=$2 && shift ;;
    --params-file)
      [ -f "$2" ] || refuse "--params-file '$2' is not a file"
      parameter_files+=("$2") && shift
      ;;
    -p)
      [[ $2 =~ ^($nodes):[^:]+:=. ]] ||
        refuse "-p '$2' must be NODE:NAME:=VALUE, where NODE is one of ${nodes//|/, }"
      parameters+=("$2") && shift
      ;;
    --namespace) namespace=${2#/} && shift ;;
    --network) network=true ;;
    --duration)
      [[ $2 =~ ^[0-9]+(\.[0-9]+)?$ ]] || refuse "--duration '$2' must be a number of seconds"
      duration=$2 && shift
      ;;
    --record) record=$2 && shift ;;
    --view) view=true ;;
    --port) port=$2 && shift ;;
    --read-only) read_only=(--read-only) ;;
    -h | --help) usage && exit ;;
    --) [ $# = 1 ] || refuse "unexpected argument '$2'; see ./bringup.sh --help" ;;
  esac
  shift
done

is_given() { [[ " $passed " == *" $1 "* ]]; }

exclude() { # OPTION OTHER_OPTION…
  local other
  is_given "$1" || return 0
  for other in "${@:2}"; do
    ! is_given "$other" || refuse "$1 and $other cannot be used together; remove one of them"
  done
}
[ -n "$bag" ] || [ ${#from[@]} = 0 ] || refuse '--from-namespace requires --bag'
exclude --quick --checkpoint
exclude --bag --hardware --combined --explore --reality
exclude --hardware --reality
exclude --no-controller --combined --explore
exclude --no-learner --joint-source
exclude --mujoco --robot --hardware --bag --reality
[ -n "$mujoco" ] || [ ${#chain[@]} = 0 ] || refuse "${chain[0]} requires --mujoco"
[ -z "$mujoco" ] || [ -f "$mujoco" ] || refuse "--mujoco '$mujoco' is not a file"
for option in --port --read-only; do
  ! is_given "$option" || [ $view = true ] || refuse "$option requires --view"
done

robot_directory=$repository/config/$robot
[ -z "$mujoco" ] || robot_directory=$repository # until it is imported
[ -n "$mujoco" ] || [ -f "$robot_directory/muscles.yaml" ] || robot_directory=$robot
[ ! -f "$robot_directory" ] ||
  refuse "--robot '$robot' is a file: name a directory, or pass --mujoco for a MuJoCo model"
[ -d "$robot_directory" ] || refuse "--robot '$robot' is neither a directory nor one of: $(
  cd "$repository/config" && dirname -- */muscles.yaml | paste -sd ' '
)"

# --- environment ---------------------------------------------------------------------------------

# shellcheck source=.ci/environment.sh
. "$repository/.ci/environment.sh"
package=$repository/musculoskeletal_ae
log_folder=$repository/log
if [ $is_installed = true ]; then
  python=$(command -v python3)
  executables=$here
  package=$("$python" -c 'import musculoskeletal_ae; print(musculoskeletal_ae.__path__[0])') ||
    fail 'Source the workspace in which musculoskeletal_ae is installed, and its virtual environment.'
  log_folder=${ROS_LOG_DIR:-${ROS_HOME:-~/.ros}/log} # ~ is known without HOME, too
  mkdir -p "$log_folder" || exit 1
  setup_log=$log_folder/setup.log
  if [ -w "$package" ]; then # otherwise each node compiles into the cache of its user
    mkdir -p "$package/__pycache__"
    (flock 9 && compile_package "$package" "$package/__pycache__/.compiled") \
      9>"$package/__pycache__/.lock" || exit 1
  fi
else
  environment_setup
fi
trap 'exit 130' INT # after environment_setup, which resets it

# Keep an emulated arm off the network. A driver may run on another machine.
if [ $hardware = false ] && [ $network = false ]; then
  export ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST
  unset ROS_STATIC_PEERS
fi
# shellcheck source=.ci/udp.sh
. "$repository/.ci/udp.sh"

run_module() { # MODULE ARGUMENT…   Runs `main` of a module of the package; on Ctrl-C it ends silently.
  "$python" -m musculoskeletal_ae.executables "$@"
}

[ ${#parameters[@]} = 0 ] || run_module nodes.declared_parameters "${parameters[@]}" || exit
if [ -n "$bag" ]; then
  say "reading $bag"
  run_module tools.recorded_robot "$bag" "$robot" "${from[@]}" || exit 2
fi

# A namespace contains one arm. The lock is held until the last process has ended, which takes a
# moment after Ctrl-C.
in_use=/tmp/musculoskeletal_ae-${ROS_DOMAIN_ID:-0}-${namespace//\//.}.lock
[ -e "$in_use" ] || (umask 022 && : >>"$in_use") || exit 1
exec {arm_lock}<"$in_use"
flock -w 5 "$arm_lock" ||
  refuse "namespace '/$namespace' is in use by another bringup.sh (ROS_DOMAIN_ID ${ROS_DOMAIN_ID:-0}):\
 stop that one, or give this one a --namespace of its own"

logs=$(mktemp -d "$log_folder/bringup-$(date +%Y%m%d-%H%M%S)-XXXXXX") || exit 1
ln -sfn "${logs##*/}" "$log_folder/latest_bringup" # beside colcon's latest_build
export ROS_LOG_DIR=$logs
say "logs in $logs"
discover_many "$logs/udp.xml"

# --- processes: start, watch, stop, always by pid ------------------------------------------------

declare -A name_of=() # by pid

launch() { # NAME ARGUMENT…
  # If this script is killed with SIGKILL, the kernel ends the processes that setpriv has prepared.
  # In case the script was killed even earlier, sh first checks that it is still the parent. The
  # interpreter is stated because a path in a #! line cannot contain a space.
  # shellcheck disable=SC2016  # expanded by sh
  setpriv --pdeathsig TERM sh -c '[ "$PPID" = "$0" ] && exec "$@"' $$ \
    "$python" "$executables/$1" "${@:2}" </dev/null &
  name_of[$!]=$1
}

start() { # NAME ARGUMENT…   Output goes to NAME.log.
  say "starting $1"
  launch "$@" >"$logs/$1.log" 2>&1
}

# Starts a node with the common parameters and its own. Those of --params-file and -p come last and
# take precedence.
start_node() { # NAME PARAMETER…
  local file parameter nodes_here=" $1 "
  local -a chosen=()
  [ "$1" != combined ] || nodes_here=' estimator controller '
  for file in "${parameter_files[@]}"; do chosen+=(--params-file "$file"); done
  for parameter in "${parameters[@]}"; do
    [[ $nodes_here != *" ${parameter%%:*} "* ]] || chosen+=(-p "${parameter#*:}")
  done
  start "$1" "${common[@]}" "${@:2}" "${chosen[@]}"
}

died() { # NAME STATUS
  printf '%s\n' "$1 ended with status $2. The end of $logs/$1.log:" >&2
  tail -n 20 "$logs/$1.log" >&2
  exit 1
}

# wait_for NAME: waits until this process has ended, and returns its status. If another process ends
# first, bring-up has failed, except for a replay that has reached the end of its recording.
# bringup_status then ends too, and its status says whether there were estimates. If it has missed the
# end of the recording, it is ended here.
wait_for() {
  local pid name status other
  wait -n -p pid "${!name_of[@]}"
  status=$?
  name=${name_of[$pid]}
  unset "name_of[$pid]"
  [ "$name" = "$1" ] || [ "$name $status" = 'replay 0' ] || died "$name" "$status"
  [ "$name" = replay ] || return "$status"
  say 'end of the recording'
  for other in "${!name_of[@]}"; do
    [ "${name_of[$other]}" = "$1" ] || continue
    for _ in {1..100}; do kill -0 "$other" 2>/dev/null && sleep 0.1 || break; done
    kill -TERM "$other" 2>/dev/null
  done
  wait_for "$1"
}

# shellcheck disable=SC2329  # called by the trap
stop() {
  local pid patience start=$SECONDS
  local -a pids
  trap '' INT TERM HUP PIPE
  # Do not use name_of: a signal may arrive between the start of a process and its entry there.
  mapfile -t pids < <(jobs -pr)
  [ ${#pids[@]} -gt 0 ] || return
  say stopping
  kill -TERM "${pids[@]}"
  # Only a recording would lose something, so its process may take longer.
  for patience in 5 30; do
    while kill -0 "${pids[@]}" && ((SECONDS - start < patience)); do sleep 0.1; done
    for pid in "${pids[@]}"; do
      [ "${name_of[$pid]-}" != record ] || [ $patience = 30 ] || continue
      ! kill -KILL "$pid" ||
        say "${name_of[$pid]-process $pid} did not stop within $patience s and was killed"
    done
  done
  wait
  # Show what the recorder reports at its end: the numbers of recorded and of lost messages.
  [ -z "$record" ] || sed -n -e 's/^[0-9]* messages recorded/-- record: &/p' \
    -e 's/^warning: /-- record: &/p' "$logs/record.log"
} 2>/dev/null # without bash's own messages about killed processes
trap stop EXIT
trap 'exit 143' TERM
trap 'exit 129' HUP

# --- checkpoint ----------------------------------------------------------------------------------

# Sets $checkpoint to a file in the cache of initial networks, which `train --from-bag` shares.
train_once() {
  local training
  checkpoint=$(run_module tools.network_cache "$robot" "$preset" ${quick[@]:+quick}) || exit 1
  # Of several bringup.sh that start at the same time, only one trains.
  exec {training}>>"$checkpoint.lock" || exit 1
  if ! flock -n "$training"; then
    say 'waiting for another bringup.sh, which trains the same network'
    until flock -w 1 "$training"; do :; done # in between, bash handles signals
  fi
  if [ -s "$checkpoint" ]; then
    exec {training}>&-
    say "initial network from an earlier run (without what was learned since): $checkpoint"
    return
  fi
  say "training the initial network of $robot (once; it takes a minute or two)"
  # Its tables go to the log alone; prospects, warnings, progress and the error are also shown.
  launch train --robot "$robot" --preset "$preset" --out "$checkpoint" "${quick[@]}" \
    >>"$logs/train.log" 2> >(tee -pa "$logs/train.log")
  wait_for train || died train $?
  exec {training}>&-
}

# --- a MuJoCo model ------------------------------------------------------------------------------

# Sets $robot to a directory among the logs, into which the model is imported anew each time. This
# takes seconds, and the cached checkpoint is found again, because its file name depends on the name
# and the contents of this directory, not on its path.
import_mujoco() {
  local name
  name=$(basename "$mujoco" .xml)
  mujoco=$(realpath "$mujoco")
  robot=$logs/${name//[^A-Za-z0-9_.-]/_} && robot_directory=$robot
  say "importing $mujoco"
  launch import_robot "$mujoco" --out "$robot" "${chain[@]}" > >(tee -p "$logs/import.log") 2>&1
  wait_for import_robot || exit 1
  reality=$robot/model.xml
}

# --- The system ----------------------------------------------------------------------------------

# Prints the value that nodes get for a parameter; if their values differ, the largest one.
chosen_value() { # NAME NODE…
  local each
  local -a chosen=()
  for each in "${parameter_files[@]}"; do chosen+=(--params-file "$each"); done
  for each in "${parameters[@]}"; do chosen+=(-p "$each"); done
  run_module nodes.chosen_parameters "$@" "${common[@]}" "${chosen[@]}"
}

# Sets $kept to the parameters that choose a node's state directory. State of an emulated arm is saved
# with the logs, because the next run may emulate another arm. With hardware, the node uses its usual
# state directory, and continues from the state that it has saved there.
kept_in() { # NODE
  kept=()
  [ $hardware = true ] || kept=(-p "state_directory:=$(quoted "$logs/$1")")
}

if [ $hardware = true ] && ! is_given --seed; then
  seed=$RANDOM # otherwise, an arm would explore the same postures after every start
  say "seed of the exploration: $seed (--seed $seed repeats it)"
fi

quoted() { printf "'%s'" "${1//\'/\'\'}"; } # as YAML, the format of ROS parameters

[ -z "$mujoco" ] || import_mujoco
# MuJoCo may be too slow for real time. The emulator of a MuJoCo model therefore publishes /clock.
own_clock=false
if [[ ! $reality =~ ^(kin|foreign)$ ]]; then
  own_clock=true
  say 'nodes follow simulated time (/clock), which runs slower if MuJoCo is too slow for real time'
fi
[ -n "$checkpoint" ] || train_once

# Each process writes one log, to which `start` redirects its output; rcl would write a second one.
under=(--disable-external-lib-logs)
[ -z "$namespace" ] || under+=(-r "__ns:=/$namespace")
common=(--ros-args "${under[@]}" --params-file "$repository/config/nodes.yaml"
  -p "robot:=$(quoted "$robot")" -p "preset:=$preset" -p "seed:=$seed"
  -p "checkpoint:=$(quoted "$checkpoint")")
sim_time=() # for the recorder as well, so that its times agree with the stamps of the nodes
if [ -n "$bag" ] || [ $own_clock = true ]; then sim_time=(-p use_sim_time:=true); fi
common+=("${sim_time[@]}")

if [ $hardware = true ]; then
  # Start no node that could move the arm before the driver has passed the check.
  rate=$(chosen_value rate estimator controller) || exit
  zero_at_start=$(chosen_value zero_at_start estimator) || exit
  check=(--robot "$robot" --wait --seconds 3 --rate "$rate")
  [ "$zero_at_start" = false ] || check+=(--unzeroed)
  launch check_driver "${check[@]}" --ros-args "${under[@]}"
  wait_for check_driver || exit 1
elif [ -z "$bag" ]; then
  camera=()
  [ "$joint_source" != marker ] || camera=(-p 'sensors:=["joints", "marker:10"]')
  deviates=false
  [[ $reality =~ ^(kin|foreign)$ ]] || ! is_given --seed || deviates=true
  start_node hardware_emulator -p "reality:=$(quoted "$reality")" -p "deviates:=$deviates" \
    -p "clock:=$own_clock" "${camera[@]}"
fi

kept_in estimator
[ $combined = true ] || start_node estimator "${kept[@]}"
start_node sim
if [ $learner = true ]; then
  kept_in learner
  start_node learner "${kept[@]}" -p "joint_source:=$joint_source"
fi
[ -z "$record" ] || start record -o "$record" --robot "$robot" --ros-args "${under[@]}" "${sim_time[@]}"
if [ -n "$bag" ]; then
  # A recording contains time and commands, so no controller is started. These nodes receive every
  # message, however slow this computer is.
  receivers=estimator
  [ $learner = false ] || receivers+=,learner
  start replay "$bag" --robot "$robot" "${from[@]/#/--from-namespace=}" --clock --skip-pauses \
    --wait-for "$receivers" --ros-args "${under[@]}"
elif [ $controller = true ]; then
  [ -n "$explore" ] || explore=$([ $hardware = true ] && echo false || echo true)
  kept_in controller
  moving=(-p "explore:=$explore" "${kept[@]}")
  # A pause of a busy desktop must not stop an emulated arm.
  [ $hardware = true ] || moving+=(-p max_age:=1.0)
  name=controller
  [ $combined = false ] || name=combined
  start_node $name "${moving[@]}"
fi
if [ $view = true ]; then
  start view --robot "$robot" --port "$port" "${read_only[@]}" --ros-args "${under[@]}"
  # The page prints its address when it is ready.
  tail -n +1 -s 0.2 -f --pid="$!" "$logs/view.log" </dev/null 2>/dev/null |
    sed -un 's/^http:/-- the page is on http:/p' &
fi

# The status line. With --duration, it ends bring-up that long after the first estimate; if there is
# no estimate within `patience` [s], it fails.
limits=()
if [ -n "$duration" ]; then
  [[ $duration == *.* ]] || duration+=.0 # a ROS double
  limits=(-p "duration:=$duration" -p patience:=300.0)
fi
[ -z "$bag" ] || limits+=(-p end_with_replay:=true)
launch bringup_status "${common[@]}" "${limits[@]}" 2>"$logs/bringup_status.log"
wait_for bringup_status
status=$?
case $status in
  0 | 141) exit $status ;; # 141: the reader of the output has closed it
  *) died bringup_status $status ;;
esac
