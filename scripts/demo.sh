#!/usr/bin/env bash
# The walk through the whole house: simulate two epochs, map both through the ROS 2 graph,
# compare the maps through the change node, score against the simulated truth.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
# shellcheck source=/dev/null
source ros2_ws/env.sh

survey=bags/demo
out=out/demo
settings="--preset easy --seed ${SEED:-1} --duration ${DURATION:-20} --mode 1024x10"
started=$SECONDS

step() { printf '\n== [%3d s] %s\n' "$((SECONDS - started))" "$*"; }

mkdir -p "$out"
stamp="$survey/.settings"
wanted="$settings $(cat config/simulation.yaml src/subiaco_sim/subiaco_sim/*.py | sha256sum | cut -c1-16)"
if [[ -f $stamp && $(cat "$stamp") == "$wanted" ]]; then
    step "Simulated survey: $survey is there already"
else
    step "Simulating two epochs of one street into $survey ($settings)"
    # shellcheck disable=SC2086
    subiaco simulate "$survey" $settings --overwrite
    printf '%s' "$wanted" > "$stamp"
fi

for epoch in before after; do
    step "Mapping epoch '$epoch' through the ROS 2 graph: replay, odometry, pose graph"
    subiaco graph mapping "$survey/$epoch" -o "$out/$epoch" --overwrite
    echo "  pictures of the map: $out/$epoch/quality.html"
done

step "Comparing the two maps through the change node"
subiaco graph change "$out/before" "$out/after" -o "$out/change" --overwrite

step "Scoring against the simulated truth"
subiaco evaluate "$out/change" "$survey" -o "$out/change"
subiaco report "$out/change"
ln -sfn change/report.html "$out/report.html"

step "Done"
cat <<TEXT
  maps          $out/before/map.laz  $out/after/map.laz      (QGIS, CloudCompare)
  changes       $out/change/changes.gpkg  changes.csv        (one row an object)
  clouds        $out/change/before_labelled.laz  after_labelled.laz
  report        $out/report.html                              (open it in a browser)
TEXT
