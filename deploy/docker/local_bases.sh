#!/usr/bin/env bash
# Build the two base images from Debian packages where no image registry is reachable: Python 3.11 and Redis 7, under the names that
# the Dockerfile and the compose file use. An image that exists or can be pulled is left unchanged.
# Needs root, debootstrap and a Docker engine. MIRROR overrides debootstrap's default mirror.  Usage: local_bases.sh
set -euo pipefail

# No manuals, translations or package lists, as in Debian's own images.
LEFT_OUT=(usr/share/doc usr/share/man usr/share/info usr/share/locale usr/share/lintian var/cache var/lib/apt/lists var/log)

# Say what is missing before the first minute is spent.
needs() { printf 'local_bases.sh needs %s\n' "$1" >&2; exit 2; }
docker info >/dev/null 2>&1 || needs 'a running Docker engine that this user may use: start it, for example with `systemctl start docker`'

there() { docker image inspect "$1" >/dev/null 2>&1 || timeout "${PULL_LIMIT_S:-60}" docker pull --quiet "$1" >/dev/null 2>&1; }

root=$(mktemp -d)
trap 'rm -rf "$root" "$root.log"' EXIT

# make NAME PACKAGES CHANGE...: import a minimal Debian system with the packages.
make() {
  local name=$1 packages=$2
  shift 2
  [ "$(id -u)" = 0 ] || needs 'root, because debootstrap does: run it with sudo'
  command -v debootstrap >/dev/null || needs 'debootstrap: apt-get install debootstrap'
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

there python:3.11-slim-bookworm ||
  make python:3.11-slim-bookworm ca-certificates,python3-venv,python-is-python3 \
    --change 'ENV PIP_CERT=/etc/ssl/certs/ca-certificates.crt' --change 'CMD ["python3"]'
there redis:7 ||
  make redis:7 redis-server --change 'EXPOSE 6379' --change 'CMD ["redis-server", "--protected-mode", "no"]'
