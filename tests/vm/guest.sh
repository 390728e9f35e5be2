#!/usr/bin/env bash
# In the virtual machine, as root: installs the project and runs the tests; the host reads /host/results.xml.
set -euo pipefail
cd /opt/vm
python=/opt/surfclass/bin/python
said() { echo "vm: $(cut -d' ' -f1 /proc/uptime) s: $*"; }

said "$(cat /proc/1/comm) is up on $(uname -r), $($python --version)"
# What an installation puts there, as the operator would.
cp systemd/60-surfclass.rules /usr/lib/udev/rules.d/
systemd-sysusers /opt/vm/systemd/surfclass.sysusers.conf
udevadm control --reload && udevadm trigger --settle
ip link add vcan0 type vcan
ip link set vcan0 up
# The wheel, as the host's pip unpacked it.
sed -i "1s|^#!.*|#!$python|" installed/bin/surfclass
mv installed/bin/surfclass /opt/surfclass/bin/ && rm -r installed/bin
cp -a installed/. /opt/surfclass/lib/python3.11/site-packages/
said "installed $($python -c 'import importlib.metadata as m; print("surfclass", m.version("surfclass"))')"

export PYTHONPATH=/opt/vm/tests/vm:/opt/vm/tests/contract:/opt/vm/tests PYTHONUNBUFFERED=1 PYTHONDONTWRITEBYTECODE=1
eval "arguments=($(cat arguments))"  # as the host quoted them
if [ "${arguments[0]:-}" = --benchmark ]; then
  $python -m benchmarks.colour_v4l2
  exit
fi
status=0
$python -m pytest -m "" -p only_here -p no:cacheprovider --timeout=300 -o python_files="test_*.py guest_*.py" \
  --junit-xml=/tmp/results.xml --durations=10 --color=no tests/contract tests/vm "${arguments[@]}" || status=$?
cp /tmp/results.xml /host/results.xml
sync
said "pytest ended with $status"
