#!/bin/sh
# Builds a user-mode Linux with USB/IP into FOLDER/linux: a real USB kernel stack that needs neither root nor hardware.
#   sh tests/campaigns/kernel/uml_kernel.sh FOLDER
# Once, some minutes. Needs Debian's kernel source (fetched, 140 MB) and: sudo apt install build-essential bc flex bison
set -eu
folder=$1
package=${UML_SOURCE:-linux-source-6.1}
[ -x "$folder/linux" ] && exit 0
for tool in gcc make bc flex bison dpkg; do
    command -v "$tool" >/dev/null || { echo "$tool is missing: sudo apt install build-essential bc flex bison" >&2; exit 2; }
done
rm -rf "$folder/build"
mkdir -p "$folder/build"
cd "$folder/build"
apt-get download "$package"
dpkg -x "$package"_*.deb .
tar xf usr/src/"$package".tar.xz
cd "$package"
make -s ARCH=um defconfig
./scripts/config -d MODULES -d DEBUG_INFO -d SOUND -d INET_DIAG -d EXT4_FS -d REISERFS_FS -d ISO9660_FS \
    -e VIRTIO_UML -e UML_PCI_OVER_VIRTIO -e HOSTFS -e DEVTMPFS -e TMPFS \
    -e USB_SUPPORT -e USB -e USBIP_CORE -e USBIP_VHCI_HCD
make -s ARCH=um olddefconfig
grep -q '^CONFIG_USBIP_VHCI_HCD=y' .config || { echo "this kernel source builds no USB/IP for user mode" >&2; exit 2; }
make -s ARCH=um -j"${JOBS:-$(nproc)}" linux
strip -o "$folder/linux" linux
cd "$folder"
rm -rf build
