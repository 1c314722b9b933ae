#!/bin/bash
# A real Slurm on this machine runs a job array of a sweep; its results are compared with an unsharded run.
#
#   apt-get install slurmctld slurmd slurm-client munge
#   tests/slurm.sh [path/to/flotilla]
#
# Needs root (munged runs as its own user, slurmd starts jobs). All daemons have their own ports and files, in a
# folder of their own, and are stopped whatever happens. Takes three to five minutes: the shortest time limit that
# Slurm knows is a minute, and one of the jobs has to run into it.
set -euo pipefail

flotilla=$(realpath "${1:-target/debug/flotilla}")
for program in slurmctld slurmd sbatch munged; do
    PATH=$PATH:/usr/sbin command -v "$program" > /dev/null || { echo "skipped: there is no $program here"; exit 0; }
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
    [ "$code" = 0 ] || say "failed; what Slurm and its tasks told:"
    [ "$code" = 0 ] || tail -n 25 "$work"/*.log "$work"/*/slurm-*.log 2> /dev/null
    timeout 10 scancel --user=root 2> /dev/null
    for _ in $(seq 20); do
        [ -z "$(timeout 5 squeue --noheader 2> /dev/null)" ] && break
        sleep 0.5
    done
    for daemon in "${daemons[@]}"; do kill "$daemon" 2> /dev/null; done
    sleep 1
    for daemon in "${daemons[@]}"; do kill -KILL "$daemon" 2> /dev/null; done
    # Whatever else was started by this Slurm carries the name of its configuration.
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
PartitionName=all Nodes=ALL Default=YES MaxTime=INFINITE State=UP
CONF
    setpriv --reuid munge --regid "$(id -g munge)" --clear-groups munged --foreground --key-file "$work/munge/key" \
        --socket "$work/munge/socket" --pid-file "$work/munge/pid" --log-file "$work/munge/log" \
        --seed-file "$work/munge/seed" > "$work/munged.log" 2>&1 &
    daemons+=($!)
    for _ in $(seq 50); do [ -S "$work/munge/socket" ] && break; sleep 0.1; done
    slurmctld -D -f "$SLURM_CONF" > "$work/slurmctld.log" 2>&1 &
    daemons+=($!)
    slurmd -D -f "$SLURM_CONF" -N "$node" > "$work/slurmd.log" 2>&1 &
    daemons+=($!)
    for _ in $(seq 60); do
        [ "$(timeout 5 sinfo --noheader --format=%T 2> /dev/null)" = idle ] && return
        sleep 0.5
    done
    say "the node did not come up"
    exit 1
}

# Waits for a job, starting requeued tasks without Slurm's pause before them and without their time limit: Slurm takes
# a job's credential away when its limit stops it a second time within minutes, so once must be enough. A task that starts
# in the very second in which that was taken away is held by Slurm. That nobody answers does not mean that nothing is left.
wait_for() {
    local job=$1 until=$((SECONDS + $2)) left task why
    while sleep 1; do
        [ $SECONDS -lt $until ] || { say "job $job takes too long"; squeue --array; scontrol show "job=$job"; exit 1; }
        left=$(squeue --noheader --jobs="$job" --array --format='%F_%K %T %r' 2> /dev/null) || continue
        [ -n "$left" ] || break
        while read -r task why; do
            case $why in
                "PENDING BeginTime") scontrol update "JobId=$task" StartTime=now TimeLimit=UNLIMITED ;;
                *[Hh]eld*) scontrol release "$task" ;;
            esac 2> /dev/null || true
        done <<< "$left"
    done
}

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
# 200 trials of it take a good while, in chunks small enough to stop at once.
sed -e 's/trials = 2/trials = 20/' -e 's/generations = 5$/generations = 200/' "$work/small.toml" > "$work/long.toml"

say "starting munge and Slurm $(slurmctld -V | cut -d' ' -f2) in $work"
start_slurm

say "an array of 4 tasks"
"$flotilla" sweep "$work/small.toml" --out "$work/whole" --backend cpu --quiet > /dev/null
"$flotilla" sweep "$work/small.toml" --out "$work/array" --backend cpu --threads 1 --shards 4 --slurm="$work/array.sh"
job=$(sbatch --parsable --chdir="$work" "$work/array.sh")
wait_for "$job" 300
compare "$work/small.toml" "$work/array" "$work/whole"
[ "$(ls "$work"/array/slurm-*.log | wc -l)" = 4 ]
say "same bytes as unsharded"

say "a hand-written array, whose ids start at 7"
printf '#!/bin/bash\nexec %q sweep %q --out %q --backend cpu --threads 1 --quiet\n' \
    "$flotilla" "$work/small.toml" "$work/plain" > "$work/plain.sh"
job=$(sbatch --parsable --chdir="$work" --array=7-9 --output="$work/plain-%a.log" "$work/plain.sh")
wait_for "$job" 300
compare "$work/small.toml" "$work/plain" "$work/whole"
say "same bytes as unsharded"

# As many generations as take one thread about 75 s of the processor here: longer than the limit, whatever the machine, and
# whatever else it does meanwhile.
TIMEFORMAT=%U
seconds=$({ time "$flotilla" sweep "$work/long.toml" --out "$work/probe" --backend cpu --threads 1 --generations 60 --quiet \
    > /dev/null 2>&1; } 2>&1)
generations=$(awk -v seconds="$seconds" 'BEGIN { print int(75 * 61 / seconds) }')
say "a task of $generations generations with a time limit of a minute"
flags=(--generations "$generations")
"$flotilla" sweep "$work/long.toml" --out "$work/limited" --backend cpu --threads 1 --time 00:01:00 \
    "${flags[@]}" --slurm="$work/limited.sh"
# The warning comes at most 30 s late, and the script asks for it a minute ahead; here that would leave no time at all.
job=$(sbatch --parsable --chdir="$work" --signal=B:USR1@20 "$work/limited.sh")
"$flotilla" sweep "$work/long.toml" --out "$work/unlimited" --backend cpu --threads 1 --quiet "${flags[@]}" > /dev/null &
undisturbed=$!
wait_for "$job" 900
wait "$undisturbed"
grep -q "back into the queue" "$work"/limited/slurm-*.log || { say "it was never requeued"; exit 1; }
say "it was requeued $(cat "$work"/limited/slurm-*.log | grep -c "back into the queue") times"
compare "$work/long.toml" "$work/limited" "$work/unlimited" "${flags[@]}"
say "same bytes as undisturbed"
