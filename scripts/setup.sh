# Sourced by the other scripts: system libraries, a virtual environment, and the package in it.
# Quick when everything is there already.

ROOT="$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)"
VENV="${THESISRECON_VENV:-$ROOT/.venv}"
# Bytecode is written for the modules that are imported: pip would take twice as long with that of all.
unset PYTHONDONTWRITEBYTECODE

fail() {
  echo "$(basename "$0"): $*" >&2
  exit 1
}

find_python() {
  local candidate
  for candidate in "${PYTHON:-}" python3.11 python3.12 python3.13 python3; do
    [ -n "$candidate" ] || continue
    if "$candidate" -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null; then
      echo "$candidate"
      return
    fi
  done
}

# need_packages NAME...: install the missing Debian packages, or say which ones are missing.
need_packages() {
  command -v dpkg-query >/dev/null || return 0
  local missing=() name
  for name in "$@"; do
    dpkg-query -W -f='${Status}' "$name" 2>/dev/null | grep -q 'install ok installed' || missing+=("$name")
  done
  [ ${#missing[@]} -eq 0 ] && return 0
  local as_root=()
  if [ "$(id -u)" -ne 0 ]; then
    command -v sudo >/dev/null && sudo -n true 2>/dev/null && as_root=(sudo -n env) || {
      echo "these system packages are missing and neither root nor sudo is there to install them:" \
        "${missing[*]} (as root: apt-get install ${missing[*]}); going on without them" >&2
      return 0
    }
  fi
  echo "installing system packages: ${missing[*]}"
  "${as_root[@]}" apt-get update -qq </dev/null >/dev/null || true
  "${as_root[@]}" env DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends "${missing[@]}" \
    </dev/null >/dev/null || echo "apt-get could not install ${missing[*]}; going on without them" >&2
}

# need_package EXTRAS: the virtual environment with the package (editable) and these extras. pip works on one core: beside
# the extras, which only developers need, the kernels are compiled.
need_package() {
  local python compiling
  if [ ! -x "$VENV/bin/python" ]; then
    python="$(find_python)"
    if [ -z "$python" ]; then
      need_packages python3 python3-venv
      python="$(find_python)"
    fi
    [ -n "$python" ] || fail "Python 3.11 or newer is missing (Debian: apt-get install python3 python3-venv)"
    if ! "$python" -c 'import ensurepip, venv' 2>/dev/null; then
      need_packages python3-venv
    fi
    "$python" -m venv "$VENV" || fail "no virtual environment could be made in $VENV (Debian: python3-venv)"
  fi
  is_installed "core" || pip_install "core" -e "$ROOT"
  if [ -n "$1" ] && ! is_installed "$1"; then
    "$VENV/bin/python" -P -c "import os
from thesisrecon.runtime._precompilation import precompile
precompile('model', os.cpu_count(), lambda *_: None)" &
    compiling=$!
    trap 'kill "$compiling" 2>/dev/null || true' EXIT
    # By name: pip takes the installed package, and builds it no second time.
    pip_install "$1" "thesisrecon[$1]"
    wait "$compiling" || true
    trap - EXIT
  fi
}

# The file that states for which pyproject.toml a set of extras was installed.
stamp() { echo "$VENV/.thesisrecon-${1//,/-}"; }
wanted() { sha256sum "$ROOT/pyproject.toml" | cut -d' ' -f1; }
is_installed() { [ -f "$(stamp "$1")" ] && [ "$(cat "$(stamp "$1")")" = "$(wanted)" ]; }

# pip_install EXTRAS REQUIREMENT...
pip_install() {
  echo "installing thesisrecon [$1] into $VENV"
  "$VENV/bin/python" -m pip install -qq --no-compile --disable-pip-version-check "${@:2}" </dev/null ||
    fail "pip could not install the package; its message stands above"
  wanted >"$(stamp "$1")"
}
