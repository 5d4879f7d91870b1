#!/usr/bin/env bash
# Measures the serving path beside its peers, in one run on this machine: `just bench-peers [SECONDS] [ROUNDS]`.
# Installs the peers into a folder of the cache, at the versions of requirements.txt.
set -euo pipefail
cd "$(dirname "$0")/../.."
seconds="${1:-2}"
rounds="${2:-5}"
peers="${XDG_CACHE_HOME:-$HOME/.cache}/seese3/peers"
if [ ! -x "$peers/bin/python" ]; then
    python3 -m venv "$peers"
fi
"$peers/bin/pip" install --quiet --requirement benches/peers/requirements.txt
cargo bench --features full --no-run
work="$(mktemp -d)"
services=()
trap 'kill "${services[@]}" 2>/dev/null; rm -rf "$work"' EXIT

for frames in 1000 5000; do
    store="$work/$frames"
    port=$((52000 + frames))
    cargo bench --quiet --features full --bench serving -- make "$store" "$frames"
    PYTHONPATH=clients/python "$peers/bin/python" benches/peers/navigate_service.py "$store" "$port" >"$work/log-$frames" &
    services+=($!)
    until grep -q serving "$work/log-$frames"; do
        kill -0 "${services[-1]}" || { echo "the Python service did not start" >&2; exit 1; }
        sleep 0.2
    done
    cargo bench --quiet --features full --bench serving -- run "$store" "$seconds" "$rounds" "grpcio, NumPy, faiss=127.0.0.1:$port"
done

echo "10 nearest of 5,000 latents:"
cargo bench --quiet --features full --bench hot_paths -- 'scan/exact/5000'
"$peers/bin/python" benches/peers/nearest.py 5000

echo "M1 to M3 of 5,000 x 768 features:"
cargo bench --quiet --features full --bench hot_paths -- probes
"$peers/bin/python" benches/peers/probes.py 5000 768

echo "A training epoch:"
cargo bench --quiet --features full --bench hot_paths -- epoch
# PyTorch takes 6 GB: the one that exports encoders will do.
torch="${SEESE3_TORCH:-${XDG_CACHE_HOME:-$HOME/.cache}/seese3/torch/bin/python}"
if [ -x "$torch" ]; then
    "$torch" benches/peers/training.py 768 256
else
    echo "SKIPPED PyTorch: set SEESE3_TORCH to a Python with torch"
fi
