#!/bin/sh
# Trains twin.onnx, the twin of the demo's tray, on recordings of that tray that hold no fault, and calibrates its
# alarms on an hour and a half more. The demo runs the same fans on commands that none of these recordings has.
#   sh train_twin.sh [FANTWIN] [OUT.onnx]
set -eu
fantwin=${1:-fantwin}
out=${2:-$(dirname "$0")/twin.onnx}
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT

record() { # name, profile, seed, seconds
    "$fantwin" simulate --fans 8 --profile "$2" --seed "$3" --duration "$4" --set epoch_ns=0 --recording "$work/$1.mcap"
}
record multisine multisine 101 80
record manual manual 102 80
record staircase staircase 103 60
record held-out manual 104 120
number=200
for profile in manual manual manual manual manual manual manual manual manual manual manual manual \
    prbs prbs prbs prbs staircase staircase multisine multisine; do
    number=$((number + 1))
    record "healthy-$number" "$profile" "$number" 300 # short ones: many starts from rest
done
record other manual 107 1200

"$fantwin" train "$work/multisine.mcap" "$work/manual.mcap" "$work/staircase.mcap" --model hybrid \
    --validate "$work/held-out.mcap" --name "demo tray" --seed 1 -o "$out"
"$fantwin" evaluate "$out" "$work/held-out.mcap"
"$fantwin" calibrate "$out" "$work"/healthy-*.mcap --false-alarms-per-day 8 --verify "$work/other.mcap"
