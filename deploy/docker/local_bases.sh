#!/usr/bin/env bash
# The two images that ours start from, made on this machine where no image registry can be reached: Debian's own Python 3.11 and
# Redis 7 under the names that the Dockerfile and the compose file use. An image that is there, or can be pulled, stays as it is.
# Needs root, debootstrap and a Docker engine. MIRROR names another mirror than debootstrap knows by itself.  Usage: local_bases.sh
set -euo pipefail

# As in Debian's own images: no manuals, no translations, no package lists.
LEFT_OUT=(usr/share/doc usr/share/man usr/share/info usr/share/locale usr/share/lintian var/cache var/lib/apt/lists var/log)

there() { docker image inspect "$1" >/dev/null 2>&1 || timeout "${PULL_LIMIT_S:-60}" docker pull --quiet "$1" >/dev/null 2>&1; }

root=$(mktemp -d)
trap 'rm -rf "$root" "$root.log"' EXIT

# make NAME PACKAGES CHANGE...: imports Debian's smallest system with the packages, and without what an image needs not.
make() {
  local name=$1 packages=$2
  shift 2
  printf '%s: no registry has it, making it of Debian packages\n' "$name"
  debootstrap --variant=minbase --include="$packages" bookworm "$root" ${MIRROR:+"$MIRROR"} >"$root.log" 2>&1 ||
    { tail -5 "$root.log" >&2; exit 1; }
  if [ -d "$root/etc/ssl/certs" ]; then
    # Builds trust the authorities that this machine trusts.
    cp /etc/ssl/certs/ca-certificates.crt "$root/etc/ssl/certs/ca-certificates.crt"
  fi
  for folder in "${LEFT_OUT[@]}"; do
    if [ -d "$root/$folder" ]; then find "$root/$folder" -mindepth 1 -delete; fi
  done
  # Where Redis' own image keeps its data, and by whom.
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
