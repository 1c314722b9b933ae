#!/bin/bash
# Tests job arrays of sweeps on a real Slurm on this machine. Jobs finish, are cancelled, are preempted, lose their
# node, or reach their time limit. Their results must equal those of undisturbed runs.
#
#   apt-get install slurmctld slurmd slurm-client munge
#   tests/slurm.sh [FLOTILLA [PART...]]
#
# The parts are page, array, cancelled, preempted, node and limit. Without PART, all run. Needs root, because munged
# runs as its own user and slurmd starts jobs. All daemons have their own ports, have their files in a temporary
# directory, and are always stopped. Takes five to ten minutes: Slurm's shortest time limit is a minute, and two jobs
# must reach it.
set -euo pipefail

flotilla=$(realpath "${1:-target/debug/flotilla}")
page=$(realpath "$(dirname "$0")/../docs/how-to/clusters.md")
parts=("${@:2}")
[ ${#parts[@]} != 0 ] || parts=(page array cancelled preempted node limit)
for program in slurmctld slurmd sbatch munged; do
    PATH=$PATH:/usr/sbin command -v "$program" > /dev/null || { echo "skipped: $program is not installed"; exit 0; }
done
[ "$(id -u)" = 0 ] || { echo "skipped: this needs root"; exit 0; }
PATH=$PATH:/usr/sbin
unset "${!SLURM@}" "${!SBATCH@}"

work=$(mktemp -d)
chmod 755 "$work"
export SLURM_CONF=$work/slurm.conf
daemons=()

stop() {
    code=$?
    trap - EXIT INT TERM HUP
    set +e
    [ "$code" = 0 ] || say "FAILED; the logs of Slurm and its tasks:"
    [ "$code" = 0 ] || tail -n 25 "$work"/*.log "$work"/*/slurm-*.log 2> /dev/null
    timeout 10 scancel --user=root 2> /dev/null
    for _ in $(seq 20); do
        [ -z "$(timeout 5 squeue --noheader 2> /dev/null)" ] && break
        sleep 0.5
    done
    for daemon in "${daemons[@]}"; do kill "$daemon" 2> /dev/null; done
    sleep 1
    for daemon in "${daemons[@]}"; do kill -KILL "$daemon" 2> /dev/null; done
    # Kill all other processes that this Slurm started. They have its configuration in their environment.
    for process in /proc/[0-9]*; do
        [ "${process#/proc/}" != $$ ] && grep -qz "^SLURM_CONF=$SLURM_CONF\$" "$process/environ" 2> /dev/null \
            && kill -KILL "${process#/proc/}" 2> /dev/null
    done
    rm -rf "$work"
    exit "$code"
}
trap stop EXIT
trap 'exit 130' INT TERM HUP

say() { printf '%(%T)T  %s\n' -1 "$*"; }

start_slurm() {
    local node port=$((20000 + RANDOM % 20000))
    node=$(hostname -s)
    mkdir "$work/munge" "$work/state" "$work/spool"
    head -c 1024 /dev/urandom > "$work/munge/key"
    chown -R munge "$work/munge"
    chmod 600 "$work/munge/key"
    cat > "$SLURM_CONF" <<CONF
ClusterName=flotilla
SlurmctldHost=$node(127.0.0.1)
SlurmctldPort=$port
SlurmdPort=$((port + 1))
SlurmUser=root
SlurmdUser=root
AuthType=auth/munge
AuthInfo=socket=$work/munge/socket
CredType=cred/munge
StateSaveLocation=$work/state
SlurmdSpoolDir=$work/spool
SlurmctldPidFile=$work/slurmctld.pid
SlurmdPidFile=$work/slurmd.pid
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
SwitchType=switch/none
MpiDefault=none
SelectType=select/cons_tres
SelectTypeParameters=CR_CPU
AccountingStorageType=accounting_storage/none
JobAcctGatherType=jobacct_gather/none
JobCompType=jobcomp/none
ReturnToService=2
KillWait=10
MinJobAge=600
SchedulerParameters=sched_interval=2,sched_min_interval=0
NodeName=$node NodeAddr=127.0.0.1 CPUs=$(nproc) State=UNKNOWN
PreemptType=preempt/partition_prio
PreemptMode=REQUEUE
PartitionName=all Nodes=ALL Default=YES MaxTime=INFINITE State=UP PriorityTier=1
PartitionName=graceful Nodes=ALL MaxTime=INFINITE State=UP PriorityTier=1 GraceTime=20
PartitionName=urgent Nodes=ALL MaxTime=INFINITE State=UP PriorityTier=10 PreemptMode=OFF
CONF
    setpriv --reuid munge --regid "$(id -g munge)" --clear-groups munged --foreground --key-file "$work/munge/key" \
        --socket "$work/munge/socket" --pid-file "$work/munge/pid" --log-file "$work/munge/log" \
        --seed-file "$work/munge/seed" > "$work/munged.log" 2>&1 &
    daemons+=($!)
    for _ in $(seq 50); do [ -S "$work/munge/socket" ] && break; sleep 0.1; done
    slurmctld -D -f "$SLURM_CONF" > "$work/slurmctld.log" 2>&1 &
    daemons+=($!)
    start_node
}

# Starts this machine's node and waits until it accepts jobs.
start_node() {
    slurmd -D -f "$SLURM_CONF" -N "$(hostname -s)" >> "$work/slurmd.log" 2>&1 &
    node_daemon=$!
    daemons+=("$node_daemon")
    for _ in $(seq 60); do
        [ "$(timeout 5 sinfo --noheader --partition=all --format=%T 2> /dev/null)" = idle ] && return
        sleep 0.5
    done
    say "the node did not start"
    exit 1
}

# Waits for a job to end: wait_for JOB SECONDS
#
# Starts requeued tasks without Slurm's usual pause and without their time limit. If a time limit stopped a task twice
# within minutes, Slurm would revoke its credential. Slurm holds a task that starts in the second of a revocation; such
# a task is released. If squeue fails, the job is still assumed to run.
wait_for() {
    local job=$1 until=$((SECONDS + $2)) left task why since
    local -A pending=()
    while sleep 1; do
        [ $SECONDS -lt $until ] || { say "timeout for job $job"; squeue --array; scontrol show "job=$job"; exit 1; }
        left=$(squeue --noheader --jobs="$job" --array --format='%F_%K %T %r' 2> /dev/null) || continue
        [ -n "$left" ] || break
        while read -r task why; do
            case $why in
                "PENDING BeginTime")
                    # A node refuses a job that returns while its last run is still being cleaned up.
                    since=${pending[$task]:=$SECONDS}
                    [ $((SECONDS - since)) -lt 5 ] || scontrol update "JobId=$task" StartTime=now TimeLimit=UNLIMITED
                    ;;
                *[Hh]eld*) scontrol release "$task" ;;
            esac 2> /dev/null || true
        done <<< "$left"
    done
}

# Collects the results of a sweep and compares them with another sweep's: compare SWEEP FOLDER EXPECTED [FLAG...]
compare() {
    "$flotilla" sweep "$1" --out "$2" --collect "${@:4}" > /dev/null
    for file in results.csv points.csv final.svg sweep.toml; do
        cmp "$2/$file" "$3/$file"
    done
    for point in "$3"/points/*; do
        cmp "$2/points/${point##*/}/policies.safetensors" "$point/policies.safetensors"
    done
}

cat > "$work/small.toml" <<'SWEEP'
[learning]
population = 20
generations = 30
trials = 2
[checkpoint]
generations = 5
[grid]
followers_per_leader = [0, 1, 2, 4]
"world.coupling" = [1, 2, 3]
"learning.fitness" = ["G", "Df"]
SWEEP
# The same sweep with more trials and fewer checkpoints, so that it takes long.
sed -e 's/trials = 2/trials = 20/' -e 's/generations = 5$/generations = 200/' "$work/small.toml" > "$work/long.toml"

say "starting munge and Slurm $(slurmctld -V | cut -d' ' -f2) in $work"
start_slurm

# Runs the commands of the documentation's page about clusters.
part_page() {
    local job command
    say "page: the commands of ${page##*/}"
    mkdir "$work/page" "$work/bin"
    ln -s "$flotilla" "$work/bin/flotilla"
    awk '/^```toml/ { on = 1; next } /^```/ { on = 0 } on' "$page" > "$work/page/sweep.toml"
    while read -r command; do
        case $command in
            sbatch*)
                # shellcheck disable=SC2086 # the arguments have to be split
                job=$(cd "$work/page" && sbatch --parsable ${command#sbatch})
                wait_for "$job" 300
                ;;
            *) (cd "$work/page" && PATH=$work/bin:$PATH bash -c "$command") ;;
        esac < /dev/null
    done < <(awk '/^## / { slurm = $2 == "Slurm" } /^```/ { on = !on; next } slurm && on' "$page")
    [ "$(tail -n +2 "$work/page/cluster/points.csv" | wc -l)" = 6 ] || { say "points are missing"; exit 1; }
    say "all points were trained"
}

part_array() {
    local job
    say "array: 4 tasks"
    "$flotilla" sweep "$work/small.toml" --out "$work/whole" --backend cpu --quiet > /dev/null
    "$flotilla" sweep "$work/small.toml" --out "$work/array" --backend cpu --threads 1 --shards 4 \
        --slurm="$work/array.sh"
    job=$(sbatch --parsable --chdir="$work" "$work/array.sh")
    wait_for "$job" 300
    compare "$work/small.toml" "$work/array" "$work/whole"
    [ "$(ls "$work"/array/slurm-*.log | wc -l)" = 4 ]
    say "same bytes as without shards"

    say "array: a hand-written script whose ids start at 7"
    printf '#!/bin/bash\nexec %q sweep %q --out %q --backend cpu --threads 1 --quiet\n' \
        "$flotilla" "$work/small.toml" "$work/plain" > "$work/plain.sh"
    job=$(sbatch --parsable --chdir="$work" --array=7-9 --output="$work/plain-%a.log" "$work/plain.sh")
    wait_for "$job" 300
    compare "$work/small.toml" "$work/plain" "$work/whole"
    say "same bytes as without shards"
}

# Writes the batch script of the long sweep for the directory $work/$1: prepare NAME [FLAG...]
#
# The first call also starts an undisturbed run of the sweep. A calibration run determines how many generations take one
# thread about 75 s of processor time. This is longer than the shortest time limit on any machine.
undisturbed=
generations=
prepare() {
    local seconds TIMEFORMAT=%U
    if [ -z "$generations" ]; then
        seconds=$({ time "$flotilla" sweep "$work/long.toml" --out "$work/probe" --backend cpu --threads 1 \
            --generations 60 --quiet > /dev/null 2>&1; } 2>&1)
        generations=$(awk -v seconds="$seconds" 'BEGIN { print int(75 * 61 / seconds) }')
        flags=(--generations "$generations")
        "$flotilla" sweep "$work/long.toml" --out "$work/unlimited" --backend cpu --threads 1 --quiet "${flags[@]}" \
            > /dev/null &
        undisturbed=$!
    fi
    "$flotilla" sweep "$work/long.toml" --out "$work/$1" --backend cpu --threads 1 "${flags[@]}" --slurm="$work/$1.sh" \
        "${@:2}"
}

# Compares the directory $work/$1 with the undisturbed sweep.
same_as_undisturbed() {
    [ -z "$undisturbed" ] || wait "$undisturbed"
    undisturbed=
    compare "$work/long.toml" "$work/$1" "$work/unlimited" "${flags[@]}"
    say "same bytes as undisturbed"
}

fail() {
    say "$1"
    exit 1
}

# Waits until a command succeeds: until_true DESCRIPTION COMMAND...
until_true() {
    local end=$((SECONDS + 120))
    until "${@:2}"; do
        [ $SECONDS -lt $end ] || fail "timeout while waiting until $1"
        sleep 0.5
    done
}

# Prints a property of the only task of a job.
property() { scontrol show "job=$1" 2> /dev/null | tr ' ' '\n' | sed -n "s/^$2=//p" | head -n 1; }
is_in_state() { [ "$(property "$1" JobState)" = "$2" ]; }
has_sessions() { [ "$(grep -l "\"sessions\": $2" "$work/$1"/points/*/run.json 2> /dev/null | wc -l)" -gt 0 ]; }

has_checkpoint() { ls "$work/$1"/points/0000/checkpoints/*.safetensors > /dev/null 2>&1; }

# Submits $work/$1.sh and waits until its task trains in session $2.
submit() {
    job=$(sbatch --parsable --chdir="$work" "${@:3}" "$work/$1.sh")
    until_true "session $2 of $1 starts" has_sessions "$1" "$2"
}

saves() { grep -q "everything is saved" "$work/$1"/slurm-*.log; }

# Checks that the ended task in $work/$1 saved its runs before it ended.
saved() {
    saves "$1" || fail "the task did not save"
    ! grep -q '"state": "running"' "$work/$1"/points/*/run.json || fail "a run was stopped before it was saved"
}

# Checks that a job ends in state $2 and is not requeued.
ended_for_good() {
    until_true "job $1 ends" is_in_state "$1" "$2"
    sleep 5
    is_in_state "$1" "$2" || fail "the job was requeued after $2: $(property "$1" JobState)"
    [ "$(property "$1" Restarts)" = 0 ] || fail "the job was restarted after $2"
}

part_cancelled() {
    say "cancelled: a task is cancelled and submitted again"
    prepare cancelled
    submit cancelled 1
    scancel "$job"
    ended_for_good "$job" CANCELLED
    saved cancelled
    say "the task saved and was not requeued"
    submit cancelled 2
    wait_for "$job" 900
    same_as_undisturbed cancelled
}

part_preempted() {
    local partition
    for partition in all graceful; do
        say "preempted: a task in partition $partition is preempted"
        prepare "preempted-$partition"
        submit "preempted-$partition" 1 --partition="$partition"
        sbatch --parsable --chdir="$work" --partition=urgent --exclusive --wrap="sleep 1" --output=/dev/null > /dev/null
        wait_until_restarted "$job"
        until_true "the task saves" saves "preempted-$partition"
        wait_for "$job" 900
        same_as_undisturbed "preempted-$partition"
    done
}

is_restarted() { [ "$(property "$1" Restarts)" -gt 0 ] 2> /dev/null; }
wait_until_restarted() { until_true "job $1 is requeued" is_restarted "$1"; }

# Kills processes of this Slurm's jobs: those with the name $1, or all processes inside jobs if $1 is empty.
kill_processes() {
    local process
    for process in /proc/[0-9]*; do
        grep -qz "^SLURM_CONF=$SLURM_CONF\$" "$process/environ" 2> /dev/null || continue
        if [ -n "$1" ]; then
            [ "$(cat "$process/comm" 2> /dev/null)" = "$1" ] || continue
        else
            grep -qz "^SLURM_JOB_ID=" "$process/environ" 2> /dev/null || continue
        fi
        kill -KILL "${process#/proc/}" 2> /dev/null || true
    done
}

part_node() {
    say "node: the node of a task fails"
    prepare node
    submit node 1
    until_true "there is a checkpoint" has_checkpoint node
    # Kill slurmstepd before the processes of the job, because it would report that the step ended.
    kill -KILL "$node_daemon"
    kill_processes slurmstepd
    kill_processes ""
    scontrol update "NodeName=$(hostname -s)" State=DOWN Reason=test
    wait_until_restarted "$job"
    scontrol update "NodeName=$(hostname -s)" State=RESUME
    start_node
    wait_for "$job" 900
    same_as_undisturbed node
}

part_limit() {
    say "limit: a task reaches its limit of a minute"
    prepare limited --time 00:01:00
    # The script asks for a warning a minute before the limit, which would leave no time here. Slurm's warnings may be
    # up to 30 s late.
    job=$(sbatch --parsable --chdir="$work" --signal=B:USR1@20 "$work/limited.sh")
    wait_for "$job" 900
    grep -q "returns to the queue" "$work"/limited/slurm-*.log || fail "the task was not requeued"
    same_as_undisturbed limited

    say "limit: a task reaches its limit without a warning"
    # Slurm may end it 30 s after the limit, and the machine may be faster than in the calibration run.
    flags=(--generations $((2 * generations)))
    prepare late --time 00:01:00
    submit late 1 --signal=B:CONT@20
    ended_for_good "$job" TIMEOUT
    saved late
    say "the task saved and was not requeued"
}

for part in "${parts[@]}"; do "part_$part"; done
