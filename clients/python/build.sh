#!/bin/sh
# Builds the wheel of the Python package into target/python/wheels. Installs the wheel in target/venv, or for the Python
# interpreter that SCANHUB_PYTHON names. Needs Cargo, and the network to download maturin and numpy.
set -eu

cd "$(dirname "$0")/../.."
python=${SCANHUB_PYTHON:-target/venv/bin/python}
wheels=target/python/wheels
if [ -z "${SCANHUB_PYTHON:-}" ] && [ ! -x "$python" ]; then
    python3 -m venv target/venv
fi
pip() {
    "$python" -m pip --disable-pip-version-check "$@"
}
pip install --quiet 'maturin>=1.9,<2' numpy
rm -rf "$wheels"
"$python" -m maturin build --release --locked --manifest-path clients/python/Cargo.toml \
    --target-dir target/python --out "$wheels" --interpreter "$python"
pip install --quiet --no-index --no-deps --force-reinstall --find-links "$wheels" scanhub-client
# Download the wheel of numpy, too, because a test installs both wheels in an empty environment without the network.
pip download --quiet --no-deps --dest "$wheels" numpy
