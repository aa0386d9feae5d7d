#!/bin/sh
# The reference renderers, Open3D and pyrender, need libraries of the system (the estimators and the demo don't). Installs those
# that are missing where it may, else says what to install; the tests that need them are then skipped.
# Usage: system-packages.sh PYTHON
python=$1
missing=""
while read -r library package; do
    "$python" -c 'import ctypes, sys; ctypes.CDLL(sys.argv[1])' "$library" 2>/dev/null || missing="$missing $package"
done <<END
libEGL.so.1 libegl1
libGL.so.1 libgl1
libX11.so.6 libx11-6
libXrender.so.1 libxrender1
libusb-1.0.so.0 libusb-1.0-0
libudev.so.1 libudev1
libidn2.so.0 libidn2-0
END
[ -n "$missing" ] || exit 0

if [ "$(id -u)" = 0 ]; then
    as_root=""
elif sudo -n true 2>/dev/null; then
    as_root="sudo -n"
else
    as_root="none"
fi
if [ "$as_root" != none ] && command -v apt-get >/dev/null; then
    export DEBIAN_FRONTEND=noninteractive
    # shellcheck disable=SC2086 # lists of words
    $as_root apt-get update -q && $as_root apt-get install -q -y --no-install-recommends $missing && exit 0
fi
echo "Tests of the reference renderers will be skipped. To run them: sudo apt-get install$missing" >&2
