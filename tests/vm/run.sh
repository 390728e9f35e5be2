#!/usr/bin/env bash
# Boots Debian's own kernel under software emulation and runs there what needs kernel modules: V4L2 on
# vivid, SocketCAN on vcan, the emulated USB camera. The image is made once and kept in the cache.
#
#   tests/vm/run.sh               everything; exit code 0 if all tests passed
#   tests/vm/run.sh -k v4l2 …     more arguments are pytest's
#   tests/vm/run.sh --benchmark   benchmarks/colour_v4l2.py instead of the tests
#
# SURFCLASS_VM_TIMEOUT_S: the machine is ended after so long (default 900).
set -euo pipefail
here=$(cd "$(dirname "${BASH_SOURCE[0]}")" && pwd)
root=$(cd "$here/../.." && pwd)
python=${SURFCLASS_PYTHON:-$root/.venv/bin/python}
timeout_s=${SURFCLASS_VM_TIMEOUT_S:-900}
cache=${XDG_CACHE_HOME:-$HOME/.cache}/surfclass-vm

for tool in qemu-system-x86_64:qemu-system-x86 mmdebstrap:mmdebstrap cpio:cpio busybox:busybox-static \
  mke2fs:e2fsprogs modprobe:kmod; do
  PATH=$PATH:/usr/sbin:/sbin command -v "${tool%%:*}" >/dev/null || {
    echo "vm: ${tool%%:*} is missing: apt-get install ${tool##*:}" >&2
    exit 69
  }
done
export PATH=$PATH:/usr/sbin:/sbin

kernel=$(apt-cache depends linux-image-amd64 2>/dev/null | awk '$1 == "Depends:" && !found++ { print $2 }')
[ -n "$kernel" ] || { echo "vm: apt knows no linux-image-amd64; run apt-get update" >&2; exit 69; }
made_of=(image.sh packages.py initramfs-init surfclass-vm.service)
key=$({
  cd "$here" && cat "${made_of[@]}"
  apt-cache show --no-all-versions "$kernel" | grep -E '^(Version|SHA256):'
  "$python" packages.py list
} | sha256sum | cut -c1-16)
image=$cache/$key

started=$SECONDS
mkdir -p "$cache"
(
  # Two runs at once make one image; older ones go when a new one is complete.
  flock 9
  [ ! -e "$image/disk.img" ] || exit 0
  rm -rf "$cache/making"
  mkdir "$cache/making"
  timeout 1800 "$here/image.sh" "$cache/making" "$kernel" "$python"
  find "$cache" -mindepth 1 -maxdepth 1 -type d ! -name making -mtime +7 -exec rm -rf {} +
  mv "$cache/making" "$image"
  echo "vm: made the image in $((SECONDS - started)) s: $image" >&2
) 9>"$cache/lock"

work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
mkdir -p "$work/source" "$work/payload" "$work/host"
# From a copy: a build leaves its folders in the tree that it builds.
(cd "$root" && cp -r pyproject.toml README.md LICENSE surfclass drivers calibration daemon "$work/source/")
pip=("$python" -m pip --quiet --disable-pip-version-check --no-input)
"${pip[@]}" wheel --no-deps --wheel-dir "$work" "$work/source"
# pip itself would take 20 s in there.
"${pip[@]}" install --no-deps --no-index --no-warn-script-location --root-user-action=ignore \
  --target "$work/payload/installed" "$work"/*.whl
(cd "$root" && tar -cf - --exclude=__pycache__ pyproject.toml systemd tests benchmarks) | tar -C "$work/payload" -xf -
# For no arguments printf would print an empty one, which pytest takes for the folder that it stands in.
: >"$work/payload/arguments"
[ $# -eq 0 ] || printf '%q ' "$@" >"$work/payload/arguments"
tar -C "$work/payload" -cf "$work/host/payload.tar" .

# All that can be emulated, but for what costs more than it gives: wide vectors, deep page tables, rights
# of memory that are looked up at each access.
cpu=max,-avx,-avx2,-fma,-la57,-pku,-smap,-smep
booted=$SECONDS
: >"$work/console"
status=0
timeout --kill-after=5 "$timeout_s" qemu-system-x86_64 \
  -accel tcg,thread=multi -machine q35 -cpu $cpu -smp 2 -m 1536 -nodefaults -no-reboot -display none \
  -serial "file:$work/console" -serial stdio -monitor none -nic none -snapshot \
  -kernel "$image/vmlinuz" -initrd "$image/initrd.img" \
  -append "console=ttyS0 quiet mitigations=off tsc=unstable no_timer_check audit=0 panic=-1" \
  -drive "file=$image/disk.img,format=raw,if=virtio" \
  -virtfs "local,path=$work/host,mount_tag=host,security_model=none,multidevs=remap" \
  </dev/null || status=$?
case $status in
  0) ;;
  124 | 137) echo "vm: it was not done after $timeout_s s and was ended" >&2 ;;
  *) echo "vm: qemu ended with $status" >&2 ;;
esac
verdict=0
[ "${1:-}" = --benchmark ] || "$python" "$here/verdict.py" "$work/host/results.xml" || verdict=1
echo "vm: $((SECONDS - booted)) s from switching on to power-off, $((SECONDS - started)) s in all"
if grep -qE 'Oops|BUG: |Kernel panic' "$work/console"; then
  echo "vm: its kernel crashed; what came after that counts for nothing"
  verdict=1
fi
if [ "$status" -ne 0 ] || [ "$verdict" -ne 0 ]; then
  echo "vm: the last lines of its console:"
  tail -n 30 "$work/console"
  exit 1
fi
