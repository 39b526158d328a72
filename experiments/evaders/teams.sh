#!/bin/bash
# What isn't known of the policy `teams`, on one to four GPUs, from the repository's root:
#   experiments/evaders/teams.sh OUTDIR [SECONDS]
#
# Best responses, the map in two halves, pillars, lost messages, strangers and inertia are jobs in
# order of worth. Each GPU takes the next one as soon as it is free, and none begins that can't end
# within SECONDS (350). All that is known lies in OUTDIR/teams.tgz at any time, packed every 20 s;
# times.txt in it says what ran when.
# Variables: PYTHON, GPUS (by default all), TINY=1 to try each job at a tiny size on a CPU.
set -u
ulimit -n 65536 2>/dev/null
out=$1
export PYTHONPATH=$PWD/src:$PWD OPENBLAS_NUM_THREADS=1
python=${PYTHON:-python3}
K=$(mktemp -d)
mkdir -p "$out"
began=$(date +%s)
ends=$((began + ${2:-350}))
say() { echo "$(($(date +%s) - began)) $*" >> "$K/times.txt"; }
gpus=${GPUS:-$(nvidia-smi -L | wc -l)}
pack() {
  # in one piece, whenever it is read
  tar -C "$K" -czf "$out/teams.tgz.new" . 2>/dev/null && mv "$out/teams.tgz.new" "$out/teams.tgz"
}
(while true; do sleep 20; pack; done) &
packer=$!
trap 'kill $packer' EXIT

# what is less where it is only tried
one="" few="" few_map="" planned="" strangers="" speed="" forced=""
planner_small="--planner_episodes 40"
planner_large="--planner_episodes 20"
cell="--speed_ratios 1.3 --radii 0.3" # of teams.md's table
steps() { echo "$1"; }
episodes() { echo "$1"; }
if [ "${TINY:-0}" = 1 ]; then
  one="$cell --batch 64" # of each map one cell a size
  cell=""
  few="--learners 2 --num_envs 16"
  few_map="--best_response True --learning.learners 2 --learning.num_envs 16"
  planned="--planning.plans 3"
  planner_small="$planned --planner_share 1 --planner_episodes 1"
  planner_large=$planner_small
  strangers="--episodes 4 --mates flight janosov"
  speed="--worlds 64 --steps 5"
  forced="--sizes 3 --episodes 1"
  steps() { echo 30000; }
  episodes() { echo 2; }
fi

exploit() { # PURSUERS STEPS EPISODES
  echo "-m openjax exploit --policy teams --seed 7 --environment.num_pursuers $1" \
    "--total_steps $(steps "$2") --minutes 1.2 --episodes $(episodes "$3")" \
    "--uniform $(episodes 256) --out $K/evader_$1.npz --json $K/exploit_$1.json $few $planned"
}
map() { # NAME EPISODES SIZES...
  echo "-m openjax map --policy teams --sizes ${*:3} --episodes $(episodes "$2")" \
    "--out $K/$1.png --json $K/$1.json $one"
}
learned() { echo "$few_map --minutes 1.5 --learning.total_steps $(steps "$1")"; }

# name, seconds on an H100 (estimated), command
jobs=()
job() { jobs+=("$1|$2|${*:3}"); }
# halves of the map: slots for four pursuers, and for eight
small="1 2 3 4"
large="5 6 7 8"
uniform="--scenario uniform"
scripted="--best_response False"
messages="--messages.lost 0.2 --messages.late 0.1"
job exploit_3 140 "$(exploit 3 480000000 100)"
job empty_small 240 "$(map empty_small 200 $small)" "$(learned 300000000)" \
  --evaders_out "$K/ev_small.npz" "$planner_small"
job empty_large 300 "$(map empty_large 200 $large)" "$(learned 200000000)" \
  --evaders_out "$K/ev_large.npz" "$planner_large"
job exploit_5 140 "$(exploit 5 300000000 1)"
job masks 70 -m experiments.speed.environment_step --masked "$speed"
job strangers 120 -m experiments.evaders.strangers --only teams --out "$K/strangers" "$strangers"
job pillars_small 130 "$(map pillars_small 200 $small)" "$(learned 200000000)" $uniform \
  --planner_share 0
job pillars_large 70 "$(map pillars_large 200 $large)" $uniform $scripted
job messages 80 "$(map messages 400 3 4 5 6 7 8)" $cell $uniform $scripted $messages
job all_three 80 "$(map all_three 400 3 4 5 6 7 8)" $cell $uniform $scripted $messages --fall_outs 1
job sight_small 45 "$(map sight_small 200 $small)" $scripted --sight_angle 90 --sight_range 1
job forced 60 -m experiments.evaders.forced --json "$K/forced.json" "$forced"
job exploit_2 110 "$(exploit 2 300000000 1)"

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
for ((gpu = 0; gpu < gpus; gpu++)); do
  worker "$gpu" &
  workers+=($!)
done
wait "${workers[@]}"
pack
cat "$K/times.txt"
rm -rf "$K"
