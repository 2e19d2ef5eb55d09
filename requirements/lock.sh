#!/bin/sh
# Writes the locks from pyproject.toml. Run it with `make lock`; UV names the uv to use.
set -eu
cd "$(dirname "$0")/.."
new=$(mktemp -d)
trap 'rm -rf "$new"' EXIT

compile() { "$UV" pip compile --quiet --no-annotate --no-header --no-emit-index-url "$@"; }
# One version of each for every Python and system that perrin serves, markers where they differ.
everywhere() { compile --universal --fork-strategy fewest --python-version 3.11 "$@"; }
# The pins of a lock with the hashes of all their files, without resolving anything anew.
hashed() { compile --universal --python-version 3.11.7 --no-deps --generate-hashes "$1"; }
note() { printf '# %s\n# Made from pyproject.toml by `make lock`; do not edit.\n' "$1"; }

printf 'hatchling\neditables\nsetuptools\n' | everywhere pyproject.toml - > "$new/demo"
{ note "What perrin runs with, and its build backend."; hashed "$new/demo"; } > "$new/demo.lock"
cp "$new/demo" "$new/all"
for extra in test docs; do
    everywhere --extra "$extra" --constraint "$new/all" pyproject.toml > "$new/$extra"
    { note "The [$extra] extra on top of what perrin runs with."
      echo "-r demo.lock"
      grep -vxFf "$new/demo" "$new/$extra" > "$new/more"
      hashed "$new/more"; } > "$new/$extra.lock"
    sort -u "$new/$extra" "$new/all" -o "$new/all"  # both extras go into one .venv
done

# The newest click and pyparsing do not go with the oldest typer and matplotlib.
printf 'click<8.2\npyparsing<3.3\n' > "$new/holds"
compile --resolution lowest-direct --python-version 3.11 --constraint "$new/holds" pyproject.toml > "$new/low"
{ note "The oldest dependencies allowed, for \`make test-lowest\` on Python 3.11."; cat "$new/low"; } > "$new/lowest.txt"

cp "$new/demo.lock" "$new/test.lock" "$new/docs.lock" "$new/lowest.txt" requirements/
