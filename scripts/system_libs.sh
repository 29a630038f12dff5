#!/bin/sh
# Bring the shared libraries that Open3D's wheel opens at run time, a C++ compiler for the
# Gaussian rasteriser and Python's venv, where they are missing (Debian and Ubuntu).
set -eu
python=${1:-python3}
wanted=""
have_library() { ldconfig -p 2>/dev/null | grep -q "$1" || /sbin/ldconfig -p 2>/dev/null | grep -q "$1"; }
have_library libusb-1.0.so.0 || wanted="$wanted libusb-1.0-0"
have_library libGL.so.1 || wanted="$wanted libgl1"
have_library libEGL.so.1 || wanted="$wanted libegl1"
have_library libgomp.so.1 || wanted="$wanted libgomp1"
command -v g++ >/dev/null 2>&1 || wanted="$wanted g++"
"$python" -c "import ensurepip" >/dev/null 2>&1 || wanted="$wanted python3-venv"
[ -z "$wanted" ] && exit 0
if ! command -v apt-get >/dev/null 2>&1; then
  echo "setup: missing system packages:$wanted. Install their like with this system's package manager, then run 'make setup' again." >&2
  exit 1
fi
root=""
if [ "$(id -u)" != 0 ]; then
  if command -v sudo >/dev/null 2>&1 && sudo -n true 2>/dev/null; then root="sudo"; else
    echo "setup: missing system packages:$wanted. Ask an administrator for 'apt-get install$wanted', then run 'make setup' again." >&2
    exit 1
  fi
fi
echo "setup: installing$wanted"
$root apt-get update -qq
DEBIAN_FRONTEND=noninteractive $root apt-get install -y -qq --no-install-recommends $wanted >/dev/null
