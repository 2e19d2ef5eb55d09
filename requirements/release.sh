#!/bin/sh
# Builds wheel and sdist into dist/, checks their metadata, and installs the wheel into an empty
# environment, where `perrin doctor` has to pass. Run it with `make release`; PYTHON names another
# interpreter.
set -eu
PYTHON=${PYTHON:-.venv/bin/python}
cd "$(dirname "$0")/.."
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT

"$PYTHON" -m venv "$work/tools"
"$work/tools/bin/pip" install --quiet --disable-pip-version-check \
    build==1.6.1 twine==7.0.0 'validate-pyproject[all]==0.27'
"$work/tools/bin/validate-pyproject" pyproject.toml
rm -rf dist
"$work/tools/bin/python" -m build --outdir dist .
"$work/tools/bin/twine" check --strict dist/*

"$PYTHON" -m venv "$work/empty"
"$work/empty/bin/pip" install --quiet --disable-pip-version-check dist/*.whl
cd "$work"
empty/bin/perrin doctor
empty/bin/perrin examples copied
[ -f copied/01_own_table.py ]
version=$(empty/bin/perrin --version)
[ -f "$OLDPWD/dist/perrin-$version.tar.gz" ]
grep -q "^version: $version\$" "$OLDPWD/CITATION.cff"
echo "dist/ holds wheel and sdist of version $version"
