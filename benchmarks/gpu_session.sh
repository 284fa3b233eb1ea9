#!/usr/bin/env bash
# Rates of the programs on a GPU, in at most 8 minutes, most important first.
#
#     bash benchmarks/gpu_session.sh [OUT]
#
# Writes JSON and tables to OUT (default: benchmarks/results/gpu): time of a step against
# batch in MJX and in closed form, the `paper` program with the projection of the paper's
# whole evolution (search_hours), its update in three precisions, the `search` program and
# programs of 1 to 100 slots. A part that fails does not stop the others.
set -uo pipefail
cd "$(dirname "$0")/.."
out="${1:-benchmarks/results/gpu}"
mkdir -p "$out"
export PYTHONPATH="src${PYTHONPATH:+:$PYTHONPATH}"

part() {
    local name="$1" limit="$2"
    shift 2
    echo "== $name"
    timeout "$limit" "$@" >"$out/$name.log" 2>&1 || echo "   $name ended with $?"
    tail -n 3 "$out/$name.log"
}

nvidia-smi >"$out/nvidia-smi.txt" 2>&1
part env_steps 105 python benchmarks/env_steps.py --batch 1024 8192 65536 \
    --only "Goal-Hazard-Point, closed form" Goal-Hazard-Point --out "$out/env_steps.json"
part paper 150 python benchmarks/population.py --preset paper --parts closed_form --chunk-epochs 1 \
    --out "$out"
part update 100 python benchmarks/population.py --preset paper --parts update --update-slots 50 \
    --precisions float32 tensorfloat32 bfloat16 --out "$out"
part search 95 python benchmarks/population.py --preset search --parts closed_form slots --out "$out"
