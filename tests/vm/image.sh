#!/usr/bin/env bash
# Makes the virtual machine's image: image.sh DIRECTORY KERNEL_PACKAGE PYTHON
#
# DIRECTORY gets vmlinuz, initrd.img and disk.img (ext4): Debian with systemd, the kernel's modules that
# the tests need, and /opt/surfclass, a venv with the packages of PYTHON's environment that they import.
# Needs no loop mount and no network but this machine's own Debian mirror.
set -euo pipefail
[ $# -eq 3 ] || { sed -n 2,4p "$0" >&2; exit 2; }
here=$(cd "$(dirname "${BASH_SOURCE[0]}")" && pwd)
directory=$(realpath "$1") kernel_package=$2 python=$3
version=${kernel_package#linux-image-}

# vivid loops pixels through the kernel, dummy_hcd with usb_f_fs is a USB camera, vcan a CAN bus.
tested=(vivid vcan can-raw dummy_hcd libcomposite usb_f_fs)
needed=(9p 9pnet_virtio autofs4)
boot=(virtio_pci virtio_blk ext4 crc32c_generic)
debian=systemd,systemd-sysv,udev,kmod,dbus,iproute2,python3,libdc1394-25,v4l-utils
# Nothing that a machine needs which lives for a minute; a getty would hang up the console.
masked=(apt-daily.timer apt-daily-upgrade.timer dpkg-db-backup.timer e2scrub_all.timer e2scrub_reap.service
  fstrim.timer getty@tty1.service serial-getty@ttyS0.service serial-getty@ttyS1.service
  systemd-binfmt.service proc-sys-fs-binfmt_misc.automount dev-hugepages.mount dev-mqueue.mount
  sys-kernel-debug.mount sys-kernel-tracing.mount systemd-pstore.service systemd-timesyncd.service
  systemd-networkd.service systemd-resolved.service systemd-update-utmp.service
  systemd-update-utmp-runlevel.service)

work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
chmod 1777 "$work"  # without root, mmdebstrap's hooks are another user's

kernel() {
  (cd "$work" && apt-get download -qq -o APT::Sandbox::User=root "$kernel_package")
  dpkg-deb -x "$work/$kernel_package"_*.deb "$work/kernel"
  cp "$work/kernel/boot/vmlinuz-$version" "$directory/vmlinuz"
  depmod -b "$work/kernel" "$version"
}

# The files of modules and of all that they need, in the order of loading.
module_files() {
  for module in "$@"; do modprobe -d "$work/kernel" -S "$version" --show-depends "$module"; done |
    awk '$1 == "insmod" && !seen[$2]++ { print $2 }'
}

initramfs() {
  local root=$work/initramfs
  mkdir -p "$root"/{bin,dev,proc,sys,root,modules}
  cp /bin/busybox "$root/bin/"
  install -m 755 "$here/initramfs-init" "$root/init"
  module_files "${boot[@]}" | while read -r file; do
    cp "$file" "$root/modules/"
    basename "$file"
  done >"$root/modules/order"
  (cd "$root" && find . | cpio --quiet -o -H newc --owner 0:0) | gzip -1 >"$directory/initrd.img"
}

# What is laid over Debian's own files.
overlay() {
  local root=$work/overlay modules unit
  modules=$root/usr/lib/modules/$version
  mkdir -p "$root"/{host,opt/vm,etc/modules-load.d,etc/modprobe.d,usr/lib/udev/rules.d} "$modules"
  module_files "${boot[@]}" "${needed[@]}" "${tested[@]}" | while read -r file; do
    (cd "$work/kernel/lib/modules/$version" && cp --parents "${file#"$PWD"/}" "$modules/")
  done
  cp "$work/kernel/lib/modules/$version"/modules.{builtin,builtin.modinfo,order} "$modules/"
  printf '%s\n' "${needed[@]}" "${tested[@]}" >"$root/etc/modules-load.d/surfclass-vm.conf"
  # An output whose frames the capture side shows; HDMI lets both have any size.
  echo 'options vivid n_devs=1 node_types=0x101 num_inputs=1 input_types=3 num_outputs=1 output_types=1' \
    >"$root/etc/modprobe.d/surfclass-vm.conf"
  echo surfclass-vm >"$root/etc/hostname"
  : >"$root/etc/fstab"
  mkdir -p "$root/etc/systemd/system/multi-user.target.wants"
  cp "$here/surfclass-vm.service" "$root/etc/systemd/system/"
  ln -s ../surfclass-vm.service "$root/etc/systemd/system/multi-user.target.wants/"
  for unit in "${masked[@]}"; do ln -s /dev/null "$root/etc/systemd/system/$unit"; done
  mkdir -p "$root/opt/surfclass/lib/python3.11/site-packages"
  "$python" "$here/packages.py" copy "$root/opt/surfclass/lib/python3.11/site-packages"
}

# Debian, the overlay and the venv as an ext4 image; mke2fs runs as mmdebstrap's root, which owns the files.
disk() {
  local suite populate keyring=/usr/share/keyrings/debian-archive-keyring.gpg
  suite=$(. /etc/os-release && echo "$VERSION_CODENAME")
  apt-get indextargets --format "deb [signed-by=$keyring]"' $(REPO_URI) $(RELEASE) $(COMPONENT)' \
    'Created-By: Packages' 'Origin: Debian' >"$work/sources.list"
  [ -s "$work/sources.list" ] || { echo "image: apt knows no Debian mirror; run apt-get update" >&2; exit 69; }
  # mmdebstrap mounts /proc and others there while its hooks run; a plain bind mount leaves them out.
  populate='unshare --mount --propagation=private sh -ec "mount --bind \"$1\" /mnt
    mke2fs -q -t ext4 -O ^has_journal -d /mnt '"$work"'/disk.img 900M"'
  tar -C "$work/overlay" --owner=0 --group=0 -cf "$work/overlay.tar" .
  local options=()
  while IFS= read -r option; do options+=(--aptopt="$option"); done < <(
    apt-config dump | grep -E '^Acquire::(https?::|Check-)[^"]* "[^"]+";' || true)
  mmdebstrap --quiet --variant=minbase --include="$debian" "${options[@]}" --format=null \
    --dpkgopt='path-exclude=/usr/share/doc/*' --dpkgopt='path-exclude=/usr/share/man/*' \
    --dpkgopt='path-exclude=/usr/share/locale/*' --dpkgopt=force-unsafe-io \
    --customize-hook="tar-in '$work/overlay.tar' /" \
    --customize-hook="chroot \"\$1\" depmod $version" \
    --customize-hook='chroot "$1" /usr/bin/python3 -m venv --without-pip --system-site-packages /opt/surfclass' \
    --customize-hook='chroot "$1" /opt/surfclass/bin/python -c "import numpy, cv2, pydantic, pytest"' \
    --customize-hook='rm -rf "$1"/var/cache/apt/* "$1"/var/lib/apt/lists/*' \
    --customize-hook="$populate" \
    "$suite" - "$work/sources.list" >/dev/null
  cp --sparse=always "$work/disk.img" "$directory/disk.img"
}

echo "image: Debian's $kernel_package" >&2
kernel
initramfs
overlay
echo "image: Debian's packages and the Python packages of $python" >&2
disk
