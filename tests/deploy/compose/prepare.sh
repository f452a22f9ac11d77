#!/usr/bin/env bash
# What bringing compose.yaml up needs, fetched once into a folder: packages of the system, a stand-in for the base image
# of the Dockerfile (nothing is pulled from a registry), the wheels of requirements-image.lock, podman-compose.
# Where something is not possible it says so in one line, and ends with exit code 77.
#   prepare.sh FOLDER PYTHON
set -euo pipefail
folder=$1 python=$2
lock=$(realpath "$(dirname "$0")/../../../requirements-image.lock")

cannot() { echo "compose.yaml is not brought up here: $*"; exit 77; }

[ "$(id -u)" = 0 ] || cannot "it needs root for namespaces of its own"
unshare -mnpf --mount-proc true 2>/dev/null || cannot "no mount, network and process namespaces can be made"
for module in overlay bridge veth; do modprobe -q $module 2>/dev/null || true; done
unshare -n ip link add name probe type bridge 2>/dev/null || cannot "no network bridge can be made"
grep -q overlay /proc/filesystems || cannot "the kernel has no overlay file system"

tools="podman crun netavark aardvark-dns buildah catatonit iptables nftables mmdebstrap"
if ! dpkg -s $tools >/dev/null 2>&1; then
    command -v apt-get >/dev/null || cannot "podman and mmdebstrap are installed by apt-get, which is not there"
    { apt-get update -qq && DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends $tools; } \
        >/dev/null 2>&1 || cannot "apt-get cannot install: $tools"
fi

mkdir -p "$folder"
free_kb=$(df --output=avail -k "$folder" | tail -n 1)
[ "$free_kb" -gt 6000000 ] || cannot "it needs 6 GB of disk, $((free_kb / 1000000)) GB are free"

if [ ! -e "$folder/base.tar" ]; then
    mmdebstrap --quiet --mode=root --variant=apt --include=python3,python3-pip,ca-certificates \
        --customize-hook='rm -f "$1"/usr/lib/python3.11/EXTERNALLY-MANAGED; ln -sf python3 "$1"/usr/bin/python' \
        bookworm "$folder/part.tar" >&2 || cannot "no base system: mmdebstrap cannot reach a mirror"
    mv "$folder/part.tar" "$folder/base.tar"
fi

# also what builds packages that have no wheel, and fantwin itself
if ! cmp -s "$lock" "$folder/wheels.lock"; then
    rm -rf "$folder/wheels"
    "$python" -m pip --disable-pip-version-check -q download --require-hashes -r "$lock" -d "$folder/wheels" >&2 &&
        "$python" -m pip --disable-pip-version-check -q download 'setuptools>=77' wheel -d "$folder/wheels" >&2 ||
        cannot "the wheels of requirements-image.lock cannot be downloaded"
    cp "$lock" "$folder/wheels.lock"
fi
printf '[global]\nno-index = true\nfind-links = /wheels\ndisable-pip-version-check = true\n' > "$folder/pip.conf"

if [ ! -x "$folder/podman-compose/bin/podman-compose" ]; then
    "$python" -m venv "$folder/podman-compose"
    "$folder/podman-compose/bin/python" -m pip --disable-pip-version-check -q install podman-compose >&2 ||
        cannot "podman-compose cannot be installed"
fi
