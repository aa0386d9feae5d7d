#!/bin/sh
# Prints the first Python that the project runs on; says what to install where there is none.
for python in python3 python3.12 python3.11; do
    if "$python" -c 'import sys; sys.exit(not (3, 11) <= sys.version_info < (3, 13))' 2>/dev/null; then
        command -v "$python"
        exit 0
    fi
done
echo "Python 3.11 or 3.12 is missing. Debian, Ubuntu: apt-get install python3 python3-venv" >&2
exit 1
