#!/usr/bin/env bash
# A base image for the Dockerfile from Debian's packages alone, where no registry can be reached.
# Needs root, debootstrap and a running Docker; does nothing if the image is there already.
#
#   base_image.sh TAG
set -eu
tag=$1 mirror=${DEBIAN_MIRROR:-http://deb.debian.org/debian}
if docker image inspect "$tag" >/dev/null 2>&1; then
  exit 0
fi
root=$(mktemp -d)
trap 'rm -rf "$root"' EXIT
debootstrap --variant=minbase --include=python3,python3-venv bookworm "$root" "$mirror"
rm -rf "$root"/var/cache/apt/archives/*.deb "$root"/var/lib/apt/lists/*
# What this machine trusts, pip in a container has to trust too, or it cannot pass a proxy of the site.
certificates=etc/ssl/certs/ca-certificates.crt
if [ -e "/$certificates" ]; then
  install -D -m 644 "/$certificates" "$root/$certificates"
  printf '[global]\ncert = /%s\n' "$certificates" >"$root/etc/pip.conf"
fi
tar -C "$root" -c . | docker import - "$tag"
