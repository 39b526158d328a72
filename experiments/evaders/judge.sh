#!/bin/bash
# All judges of one policy on one GPU, in less than nine minutes on an H100:
#   experiments/evaders/judge.sh POLICY OUTDIR [GPU]
#
# Two lanes run side by side on the GPU, so that one compiles while the other flies. What is known
# is in OUTDIR at any time, and `python -m experiments.evaders.judge_table OUTDIR` reads it.
# Variables: SEED of the evaders (7), STEPS and STEPS_SLOWER of both learners, nominal and slower
# vehicle, SECONDS_IN_ALL (520), PYTHON; EXPLOIT: more of its options.
set -u
policy=$1
out=$2
export CUDA_VISIBLE_DEVICES=${3:-0}
export XLA_PYTHON_CLIENT_MEM_FRACTION=.45
export PYTHONPATH=$PWD/src:$PWD
python=${PYTHON:-python3}
seed=${SEED:-7}
ends=$(($(date +%s) + ${SECONDS_IN_ALL:-520}))
mkdir -p "$out"

# NAME COMMAND...: what is left of the time for it, its lines and its seconds in OUTDIR
part() {
  local name=$1 began
  shift
  began=$(date +%s)
  timeout -k 5 $((ends - began > 1 ? ends - began : 1)) "$@" >"$out/$name.txt" 2>&1
  echo "$name: status $?, $(($(date +%s) - began)) s" >>"$out/seconds.txt"
}

nominal() {
  part nominal $python -m openjax exploit --policy "$policy" --seed "$seed" \
    --learners 2 --total_steps "${STEPS:-1000000000}" --out "$out/evader.npz" --json "$out/nominal.json" \
    ${EXPLOIT:-}
}

slower() {
  part slower $python -m openjax exploit --policy "$policy" --seed "$seed" \
    --effects experiments/flying/slower.toml \
    --learners 2 --total_steps "${STEPS_SLOWER:-500000000}" \
    --out "$out/evader_slower.npz" --json "$out/slower.json" ${EXPLOIT:-}
}

nominal &
slower &
wait
$python -m experiments.evaders.judge_table "$out" | tee "$out/table.txt"
