# Makes the virtual environment `.venv` ready; sourced by the other scripts.
#
#   prepare_environment            what steadylight needs to run
#   prepare_environment dev        and what its tests and checks need
#
# Safe to interrupt: only an installation that ended well leaves its mark, which is the hash of pyproject.toml;
# without the mark everything is installed again.

_find_python() {
    local candidate
    for candidate in "${STEADYLIGHT_PYTHON:-}" python3 python3.14 python3.13 python3.12 python3.11 python; do
        if [ -n "$candidate" ] && "$candidate" -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null; then
            command -v "$candidate"
            return
        fi
    done
    echo "steadylight needs Python 3.11 or newer, and none was found: install it (Debian and Ubuntu:" \
        "apt install python3 python3-venv), or name it in STEADYLIGHT_PYTHON." >&2
    return 1
}

prepare_environment() {
    local kind="${1:-run}" mark=.venv/installed python wanted found
    python="$(_find_python)" || return 1
    wanted="$("$python" -c 'import hashlib; print(hashlib.sha256(open("pyproject.toml", "rb").read()).hexdigest())')"
    found="$(cat "$mark" 2>/dev/null || true)"
    if [ "$found" = "$wanted dev" ] || [ "$found" = "$wanted $kind" ]; then
        return 0
    fi
    echo "Installing steadylight into .venv (once; a few minutes) ..." >&2
    rm -f "$mark"
    # What an interrupted first try left may be half a Python: begin anew then.
    if ! .venv/bin/python -m pip --version >/dev/null 2>&1; then
        if ! "$python" -m venv --clear .venv; then
            echo "Python's venv module does not work: install it (Debian and Ubuntu: apt install python3-venv)." >&2
            return 1
        fi
    fi
    # Dependency groups need pip 25.1.
    .venv/bin/python -m pip install --quiet --upgrade "pip>=25.1" || return 1
    if [ "$kind" = dev ]; then
        .venv/bin/python -m pip install --quiet --editable . --group dev || return 1
    else
        # The denoiser has no build for every machine.
        .venv/bin/python -m pip install --quiet --editable '.[denoise]' ||
            .venv/bin/python -m pip install --quiet --editable . || return 1
    fi
    echo "$wanted $kind" >"$mark"
}
