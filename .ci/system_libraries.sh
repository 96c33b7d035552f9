#!/usr/bin/env bash
# Shared libraries that Open3D and OpenCV load and a plain Debian may lack: name them, or install them when root.
# Usage: system_libraries.sh PYTHON   (the interpreter that is to make the virtual environment)
set -euo pipefail

python=$1
PATH=$PATH:/usr/sbin:/sbin

[[ $(uname -s) == Linux ]] || exit 0

declare -A package_of=(
    [libusb-1.0.so.0]=libusb-1.0-0
    [libGL.so.1]=libgl1
    [libEGL.so.1]=libegl1
    [libX11.so.6]=libx11-6
    [libudev.so.1]=libudev1
    [libidn2.so.0]=libidn2-0
    [libgomp.so.1]=libgomp1
)

missing() {
    local library known
    if command -v ldconfig >/dev/null; then
        known=$(ldconfig -p)
        for library in "${!package_of[@]}"; do
            [[ $known == *"$library"* ]] || echo "${package_of[$library]}"
        done
    fi
    "$python" -c 'import ensurepip, venv' 2>/dev/null || echo python3-venv
}

mapfile -t packages < <(missing | sort)
((${#packages[@]})) || exit 0

if ! command -v apt-get >/dev/null; then
    echo "These system packages (by their Debian names) are missing: ${packages[*]}; install them with your package manager, then run make again." >&2
    exit 1
fi
if ((EUID != 0)); then
    echo "System packages are missing. Run this once, then make again:" >&2
    echo "  sudo apt-get update && sudo apt-get install --yes --no-install-recommends ${packages[*]}" >&2
    exit 1
fi

echo "Installing system packages: ${packages[*]}"
export DEBIAN_FRONTEND=noninteractive
apt-get update -qq </dev/null
apt-get install --yes -qq --no-install-recommends "${packages[@]}" </dev/null >/dev/null

mapfile -t packages < <(missing | sort)
if ((${#packages[@]})); then
    echo "After installing, these are still not found: ${packages[*]}; look at the messages of apt-get above." >&2
    exit 1
fi
