#!/bin/sh
# Makes ross_figures.json anew. ROSS brings a hundred packages along, so it gets an environment of its own, which is
# removed afterwards; the tests need the figures alone.
set -eu
here=$(dirname "$(readlink -f "$0")")
environment=$(mktemp -d)
trap 'rm -rf "$environment"' EXIT
"${PYTHON:-python3}" -m venv "$environment"
"$environment/bin/python" -m pip install --quiet --disable-pip-version-check "ross-rotordynamics==2.3.0" "plotly<6.3" pyyaml
"$environment/bin/python" -W ignore "$here/ross_figures.py"
