#!/bin/sh
# Puts Debian's own kernel and a first file system with its drivers into FOLDER, for QEMU: a real kernel with real USB
# serial drivers. Needs neither root nor virtualisation by the processor.
#   sh tests/campaigns/kernel/qemu_kernel.sh FOLDER
# Once (fetches 70 MB). Needs: sudo apt install --no-install-recommends qemu-system-x86 busybox-static cpio kmod
set -eu
folder=$1
[ -e "$folder/initramfs" ] && exit 0
PATH=$PATH:/usr/sbin:/sbin
for tool in qemu-system-x86_64 busybox cpio depmod modprobe dpkg; do
    command -v "$tool" >/dev/null || { echo "$tool is missing: sudo apt install qemu-system-x86 busybox-static cpio kmod" >&2; exit 2; }
done
rm -rf "$folder/build"
mkdir -p "$folder/build/root/bin" "$folder/build/root/modules"
cd "$folder/build"
apt-get download "$(apt-cache depends linux-image-amd64 | sed -n 's/.*Depends: \(linux-image[^ ]*\).*/\1/p')"
dpkg -x linux-image-*.deb kernel
release=$(basename kernel/lib/modules/*)
depmod -b kernel "$release"
mkdir root/proc root/sys root/dev root/host
cp "$(command -v busybox)" root/bin/busybox
modprobe -d kernel -S "$release" -a --show-depends virtio_pci 9pnet_virtio 9p xhci_pci ftdi_sio virtio_console vhci_hcd |
    sed -n 's/^insmod \([^ ]*\).*/\1/p' | awk '!seen[$0]++' | while read -r module; do
    cp "$module" root/modules/
    basename "$module" >>root/modules/order
done
cat >root/init <<'INIT'
#!/bin/busybox sh
export PATH=/bin
busybox mount -t proc proc /proc
busybox mount -t sysfs sysfs /sys
busybox mount -t devtmpfs devtmpfs /dev
while read -r module; do busybox insmod "/modules/$module"; done </modules/order
busybox mount -t 9p -o ro,trans=virtio,version=9p2000.L,msize=512000,cache=loose host /host
busybox mount -t devtmpfs devtmpfs /host/dev
busybox umount /proc /sys
exec busybox switch_root /host "$@"
INIT
chmod +x root/init
cp "kernel/boot/vmlinuz-$release" ../vmlinuz
(cd root && find . | cpio --quiet -o -H newc | gzip -1) >../initramfs.new
cd ..
rm -rf build
mv initramfs.new initramfs
