#!/usr/bin/env bash
# Runs a command where podman works without an engine, and leaves nothing behind: in mount, network and process
# namespaces of its own, with images, volumes and settings in FOLDER. All that it starts dies with it.
#   in_namespaces.sh FOLDER COMMAND...
set -euo pipefail
folder=$(realpath "$1") here=$(realpath "$(dirname "$0")")
shift

cat > "$folder/containers.conf" <<CONF
[containers]
default_ulimits = ["nofile=4096:4096", "nproc=4096:4096"]
cgroups = "disabled"
cgroupns = "host"
[engine]
runtime = "crun"
cgroup_manager = "cgroupfs"
helper_binaries_dir = ["$here/helpers", "/usr/lib/podman", "/usr/libexec/podman"]
events_logger = "file"
[network]
network_backend = "netavark"
network_config_dir = "$folder/networks"
CONF
cat > "$folder/storage.conf" <<CONF
[storage]
driver = "overlay"
runroot = "/run/containers"
graphroot = "$folder/storage"
CONF
export CONTAINERS_CONF=$folder/containers.conf CONTAINERS_STORAGE_CONF=$folder/storage.conf
export FANTWIN_CONTAINERS=$folder PATH=$folder/podman-compose/bin:$PATH

exec unshare -mnpf --kill-child --mount-proc bash -euc '
    mount -t tmpfs tmpfs /run
    mount -t tmpfs tmpfs /dev/shm
    umount /sys/fs/cgroup/unified 2>/dev/null || true
    ip link set lo up
    # what a run that was killed has left in the folder; a container goes after those that depend on it
    while [ -n "$(podman ps -aq)" ]; do podman rm -fa >/dev/null 2>&1 || true; done
    podman volume prune -f >/dev/null
    podman network prune -f >/dev/null
    "$@"
' in_namespaces "$@"
