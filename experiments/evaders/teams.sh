#!/bin/bash
# What a policy for any team catches, on one to four GPUs, from the repository's root:
#   POLICY=FILE SEEDS="FILE FILE FILE" experiments/evaders/teams.sh OUTDIR [SECONDS]
#
# POLICY is `teams` by default, one that draws among its members or a single one. SEEDS
# are single policies of other seeds: their tables.
# The tables of experiments/results/teams.md, the map in four pieces, best responses and
# pillars are jobs in order of worth. Two of them share each GPU, as
# one is compiled while the other flies; whoever is free takes the next one, and none
# begins that can't end within SECONDS (460). All that is known lies in OUTDIR/teams.tgz
# at any time, packed every 20 s; times.txt in it says what ran when.
# Variables: PYTHON, GPUS (by default all), SHARE (2 jobs on each), JOBS (names of those
# that fly, in this order; by default all), TINY=1 to try each at a tiny size on a CPU.
set -u
ulimit -n 65536 2>/dev/null
out=$1
policy=${POLICY:-teams}
export PYTHONPATH=$PWD/src:$PWD${PYTHONPATH:+:$PYTHONPATH} OPENBLAS_NUM_THREADS=1
python=${PYTHON:-python3}
K=$(mktemp -d)
mkdir -p "$out"
began=$(date +%s)
ends=$((began + ${2:-460}))
say() { echo "$(($(date +%s) - began)) $*" >> "$K/times.txt"; }
gpus=${GPUS:-$(nvidia-smi -L | wc -l)}
share=${SHARE:-2}
export XLA_PYTHON_CLIENT_MEM_FRACTION=$(awk "BEGIN { print 0.9 / $share }")
pack() {
  # in one piece, whenever it is read
  tar -C "$K" -czf "$out/teams.tgz.new" . 2>/dev/null && mv "$out/teams.tgz.new" "$out/teams.tgz"
}
(while true; do sleep 20; pack; done) &
packer=$!
trap 'kill $packer' EXIT

# what is less where it is only tried
one="" few="" few_map="" planned="" speed=""
planner="--planner_episodes 20"
cell="--speed_ratios 1.3 --radii 0.3" # of teams.md's table
thin="--speed_ratios 0.8 1.2 1.6 2 3 --radii 0.1 0.2 0.3 0.4 0.5" # every second one
steps() { echo "$1"; }
episodes() { echo "$1"; }
if [ "${TINY:-0}" = 1 ]; then
  one="$cell --batch 64" # of each map one cell a size
  cell="" thin=""
  few="--learners 2 --num_envs 16"
  few_map="--best_response True --learning.num_envs 16"
  planned="--planning.plans 3"
  planner="$planned --planner_share 1 --planner_episodes 1"
  speed="--worlds 64 --steps 5"
  steps() { echo 30000; }
  episodes() { echo 2; }
fi

# name, seconds on an H100 that another job shares (estimated), command
jobs=()
job() { jobs+=("$1|$2|${*:3}"); }
exploit() { # PURSUERS STEPS EPISODES
  echo "-m openjax exploit --policy $policy --seed 7 --environment.num_pursuers $1" \
    "--total_steps $(steps "$2") --minutes 3 --episodes $(episodes "$3")" \
    "--uniform $(episodes 256) --out $K/evader_$1.npz --json $K/exploit_$1.json $few $planned"
}
map() { # NAME POLICY EPISODES SIZES...
  echo "-m openjax map --policy $2 --sizes ${*:4} --episodes $(episodes "$3")" \
    "--out $K/$1.png --json $K/$1.json $one"
}
learned() { # LEARNERS
  # as many steps of each as in `exploit`, to their end: a rate that falls to zero
  # counts on it
  echo "$few_map --learning.learners $1 --minutes 2.5" \
    "--learning.total_steps $(steps $((50000000 * $1)))"
}
uniform="--scenario uniform"
scripted="--best_response False"
messages="--messages.lost 0.2 --messages.late 0.1"
tables() { # NAME POLICY SECONDS
  local kind="$cell $uniform $scripted" whole="1 2 3 4 5 6 7 8"
  job "$1_sizes" "$3" "$(map "$1_sizes" "$2" 1000 $whole)" $kind
  job "$1_fall_outs" "$3" "$(map "$1_fall_outs" "$2" 1000 ${whole:2})" $kind --fall_outs 1
  job "$1_messages" "$3" "$(map "$1_messages" "$2" 400 ${whole:4})" $kind $messages
  job "$1_all_three" "$3" "$(map "$1_all_three" "$2" 400 ${whole:4})" $kind $messages \
    --fall_outs 1
}
empty() { # SIZE SIZE SECONDS
  job "empty_$1$2" "$3" "$(map "empty_$1$2" "$policy" 200 $1 $2)" "$(learned 3)" \
    --evaders_out "$K/evaders_empty_$1$2.npz" "$planner"
}
pillars() { # SIZE SIZE SECONDS
  job "pillars_$1$2" "$3" "$(map "pillars_$1$2" "$policy" 200 $1 $2)" "$(learned 2)" \
    $uniform --planner_share 0
}
empty 7 8 380
empty 5 6 330
empty 3 4 280
tables team "$policy" 60
empty 1 2 200
job exploit_3 230 "$(exploit 3 480000000 100)"
for seed in ${SEEDS:-}; do
  tables "$(basename "$seed" .npz)" "$seed" 30
done
pillars 3 4 180
pillars 7 8 220
pillars 5 6 200
pillars 1 2 150
job three 30 "$(map three evaders 1000 3)" $cell $uniform $scripted
job three_cells 60 "$(map three_cells evaders 200 3)" $uniform $scripted
for radius in 0.7 1.2 1.5; do
  job "arena_$radius" 60 "$(map "arena_$radius" "$policy" 400 1 2 3 4 5 6 7 8)" $cell $uniform \
    $scripted --arena_radius "$radius"
done
job exploit_5 240 "$(exploit 5 250000000 1)"
job exploit_2 150 "$(exploit 2 300000000 1)"
job sight 110 "$(map sight "$policy" 200 1 2 3 4 5 6 7 8)" $thin $scripted \
  --sight_angle 90 --sight_range 1
job silence 110 "$(map silence "$policy" 200 2 3 4)" $thin $scripted $messages --batch 2048
job masks 90 -m experiments.speed.environment_step --masked "$speed"

if [ -n "${JOBS:-}" ]; then
  chosen=()
  for name in $JOBS; do
    known=0
    for entry in "${jobs[@]}"; do
      [ "${entry%%|*}" = "$name" ] && chosen+=("$entry") && known=1
    done
    [ $known = 1 ] || say "$name: no such job"
  done
  jobs=("${chosen[@]}")
fi

echo 0 > "$K/.next"
take() { # the number of the next job
  exec 8> "$K/.lock"
  flock 8
  local number
  number=$(cat "$K/.next")
  echo $((number + 1)) > "$K/.next"
  echo "$number"
}
worker() { # GPU
  local number name seconds command left at
  export CUDA_VISIBLE_DEVICES=$1
  while number=$(take) && [ "$number" -lt ${#jobs[@]} ]; do
    IFS='|' read -r name seconds command <<< "${jobs[$number]}"
    left=$((ends - $(date +%s)))
    # estimates are rough: with a little less it may still end
    if [ "$left" -lt $((seconds * 7 / 10)) ]; then
      say "gpu $1: $name left out, $left s left"
      continue
    fi
    at=$(date +%s)
    timeout -k 5 "$left" $python $command > "$K/$name.txt" 2>&1
    say "gpu $1: $name status $?, $(($(date +%s) - at)) s"
  done
}
workers=()
for ((place = 0; place < gpus * share; place++)); do
  worker $((place % gpus)) &
  workers+=($!)
  sleep 0.2 # so that the first jobs, the longest, have a GPU each
done
wait "${workers[@]}"
pack
cat "$K/times.txt"
rm -rf "$K"
