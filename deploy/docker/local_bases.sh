#!/usr/bin/env bash
# Build the two base images from Debian packages where no image registry is reachable: Python 3.11 and Redis 7, under the names that
# the Dockerfile and the compose file use. An image that exists or can be pulled is left unchanged.
# Prints its needs before it starts: a Docker engine and, for images that no registry has, root, debootstrap and disk space.
# MIRROR overrides debootstrap's default mirror, PULL_LIMIT_S the seconds that a pull may take.  Usage: local_bases.sh
set -euo pipefail

# No manuals, translations or package lists, as in Debian's own images.
LEFT_OUT=(usr/share/doc usr/share/man usr/share/info usr/share/locale usr/share/lintian var/cache var/lib/apt/lists var/log)
PULL_LIMIT_S=${PULL_LIMIT_S:-60}
# A Debian system while it is made, with its packages; the images have less than half of it.
DISK_MB=500

fail() { printf 'local_bases.sh needs %s\n' "$1" >&2; exit 2; }
# need SENTENCE REMEDY COMMAND...: print one need, and whether the machine meets it. Return 1 if it does not.
need() {
  local sentence=$1 remedy=$2
  shift 2
  if "$@" >/dev/null 2>&1; then printf '  there    %s\n' "$sentence"; else printf '  missing  %s: %s\n' "$sentence" "$remedy"; return 1; fi
}
is_root() { [ "$(id -u)" = 0 ]; }
has_space() { [ "$(df --output=avail --block-size=1M "${TMPDIR:-/tmp}" | tail -1)" -ge "$DISK_MB" ]; }
has() { docker image inspect "$1" >/dev/null 2>&1; }
pulled() { timeout "$PULL_LIMIT_S" docker pull --quiet "$1" >/dev/null 2>&1; }

docker info >/dev/null 2>&1 ||
  fail 'a running Docker engine that this user may use: start it, for example with `systemctl start docker`'
if has python:3.11-slim-bookworm && has redis:7; then
  echo 'local_bases.sh: both base images are there'
  exit 0
fi
printf 'local_bases.sh pulls the base images, for at most %s s each. It makes those that no registry has, in about three minutes, and then needs:\n' \
  "$PULL_LIMIT_S"
unmet=0
need 'root, for debootstrap' 'run it with sudo' is_root || unmet=1
need debootstrap 'apt-get install debootstrap' command -v debootstrap || unmet=1
need "$DISK_MB MB free in ${TMPDIR:-/tmp}" 'free space, or set TMPDIR to a larger folder' has_space || unmet=1

root=$(mktemp -d)
# One file system: debootstrap mounts /proc below the folder, and leaves it there if it is killed.
trap 'rm -rf --one-file-system "$root" "$root.log"' EXIT

# make NAME PACKAGES CHANGE...: import a minimal Debian system with the packages.
make() {
  local name=$1 packages=$2
  shift 2
  [ "$unmet" = 0 ] || fail "what is missing above, because no registry has $name"
  printf '%s: no registry has it, making it of Debian packages\n' "$name"
  debootstrap --variant=minbase --include="$packages" bookworm "$root" ${MIRROR:+"$MIRROR"} >"$root.log" 2>&1 ||
    { tail -5 "$root.log" >&2; exit 1; }
  if [ -d "$root/etc/ssl/certs" ]; then
    # Builds trust this machine's certificate authorities.
    cp /etc/ssl/certs/ca-certificates.crt "$root/etc/ssl/certs/ca-certificates.crt"
  fi
  for folder in "${LEFT_OUT[@]}"; do
    if [ -d "$root/$folder" ]; then find "$root/$folder" -mindepth 1 -delete; fi
  done
  # Data folder and owner as in the official Redis image.
  install -d -o 999 -g 999 "$root/data"
  mkdir -p "$root/var/cache/apt/archives/partial" "$root/var/lib/apt/lists/partial" "$root/var/log/apt"
  tar -C "$root" --one-file-system -c . | docker import "$@" - "$name" >/dev/null
  find "$root" -mindepth 1 -delete
}

has python:3.11-slim-bookworm || pulled python:3.11-slim-bookworm ||
  make python:3.11-slim-bookworm ca-certificates,python3-venv,python-is-python3 \
    --change 'ENV PIP_CERT=/etc/ssl/certs/ca-certificates.crt' --change 'CMD ["python3"]'
has redis:7 || pulled redis:7 ||
  make redis:7 redis-server --change 'EXPOSE 6379' --change 'CMD ["redis-server", "--protected-mode", "no"]'
