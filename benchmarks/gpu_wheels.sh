#!/usr/bin/env bash
# Wheels for a machine without network, into a folder: `benchmarks/gpu_wheels.sh FOLDER`.
# The machine has Python 3.12 on x86-64 Linux, and of what pyproject.toml names it has JAX for GPUs,
# flax, optax, orbax-checkpoint, chex, six, NumPy, SciPy, PyYAML, rich, Matplotlib and Pillow; also
# what the others need: cloudpickle, pandas, protobuf and seaborn. The wheels are all else.
set -euo pipefail
folder=$(realpath -m "$1")
cd "$(dirname "$0")/.."
limits=$(mktemp)
trap 'rm -f "$limits"' EXIT

python3 - > "$limits" <<'END'
import tomllib

with open("pyproject.toml", "rb") as file:
    print(*tomllib.load(file)["project"]["dependencies"], sep="\n")
END
# gymnax 1.0 needs that gymnasium; dependencies are not looked at, lest JAX comes along.
python3 -m pip download --quiet --dest "$folder" --constraint "$limits" --no-deps \
  --only-binary=:all: --python-version 3.12 --platform manylinux_2_28_x86_64 \
  gymnax "gymnasium<1.4" farama-notifications jaxlie jax-dataclasses tyro docstring-parser \
  typeguard tensorboardx platformdirs filelock
du -ch "$folder"/*.whl
