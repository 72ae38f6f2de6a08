#!/bin/sh
# The demo: a server on its embedded default, a model, a chain of levels of detail.
#   deploy/demo.sh [MODEL]     results in out/demo
set -eu

binary=target/release/lookalike
out=out/demo
port=${LOOKALIKE_DEMO_PORT:-7429}
rm -rf "$out"
mkdir -p "$out"

model=${1:-}
if [ -z "$model" ]; then
    model=$out/sample.glb
    "$binary" sample "$model"
fi

"$binary" serve --listen "127.0.0.1:$port" --metrics-listen "127.0.0.1:$((port + 1))" \
    --data-dir "$out/server" --workers 1 >"$out/server.log" 2>&1 &
server=$!
trap 'kill $server 2>/dev/null; wait $server 2>/dev/null || true' EXIT INT TERM
tries=0
until "$binary" jobs --server "http://127.0.0.1:$port" >/dev/null 2>&1; do
    tries=$((tries + 1))
    if [ $tries -gt 100 ] || ! kill -0 $server 2>/dev/null; then
        echo "demo: the server did not start; its log:" >&2
        tail -n 20 "$out/server.log" >&2
        exit 1
    fi
    sleep 0.1
done

"$binary" submit "$model" --server "http://127.0.0.1:$port" \
    --triangles "${LOOKALIKE_DEMO_TRIANGLES:-8000,2000,500}" --out "$out"

echo
echo "Levels of detail:      $(ls "$out"/lod-*.glb | tr '\n' ' ')"
echo "Before, after, diff:   $(ls "$out"/contact-*.png | tr '\n' ' ')"
echo "The chain at a glance: $out/levels.png"
echo "Energy curve:          $out/energy.csv $out/energy.svg $out/optimization.svg"
echo "Progressive mesh:      $out/progressive.lkpm  (lookalike extract FILE --triangles N)"
echo "Report:                $out/report.json"
