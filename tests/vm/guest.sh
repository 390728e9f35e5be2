#!/usr/bin/env bash
# In the virtual machine, as root: installs the wheel and runs the tests; the host reads /host/results.xml.
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
$python -m pip install --quiet --disable-pip-version-check --no-index --no-deps --no-compile \
  --root-user-action=ignore wheel/*.whl
said "installed $($python -c 'import importlib.metadata as m; print("surfclass", m.version("surfclass"))')"

export PYTHONPATH=/opt/vm/tests/vm:/opt/vm/tests/contract:/opt/vm/tests PYTHONUNBUFFERED=1 PYTHONDONTWRITEBYTECODE=1
eval "arguments=($(cat arguments))"  # as the host quoted them
status=0
$python -m pytest -m "" -p only_here -p no:cacheprovider -o python_files="test_*.py guest_*.py" \
  --junit-xml=/tmp/results.xml --durations=10 --color=no tests/contract tests/vm "${arguments[@]}" || status=$?
cp /tmp/results.xml /host/results.xml
sync
said "pytest ended with $status"
