#!/bin/sh
# Installs Toolpoint from the folder that `make bundle` made, without a network.
#
#   sudo sh install.sh                     install this version and make it the current one
#   sudo sh install.sh --switch VERSION    make a version that is installed already the current one
#
# Every version has a virtual environment of its own, PREFIX/VERSION; PREFIX/current leads to the one
# in use. Nothing of an earlier version is changed, so the way back is --switch. The daemon is
# neither stopped nor started, and configuration, history and models are left alone.
set -eu
umask 022  # the service and the operators are other accounts than who installs

here=$(cd "$(dirname "$0")" && pwd)
prefix=/opt/toolpoint
root=/
python=python3
program_only=no
switch=

die() { echo "install.sh: $*" >&2; exit 1; }
usage() { sed -n '2,10s/^# \{0,1\}//p' "$0"; echo "options: --prefix DIR, --python PROGRAM, --program-only (no units, users, folders), --root DIR"; }

while [ $# -gt 0 ]; do
    case $1 in
        --prefix|--python|--root|--switch) [ -n "${2-}" ] || die "$1 takes a value" ;;
    esac
    case $1 in
        --prefix) prefix=$2; shift ;;
        --python) python=$2; shift ;;
        --root) root=$2; shift ;;
        --switch) switch=$2; shift ;;
        --program-only) program_only=yes ;;
        -h|--help) usage; exit 0 ;;
        *) usage >&2; exit 2 ;;
    esac
    shift
done

case $prefix in
    /*) ;;
    *) prefix=$PWD/$prefix ;;
esac

make_current() {
    [ -x "$prefix/$1/bin/toolpoint" ] || die "version $1 is not installed in $prefix; there are: $(cd "$prefix" 2> /dev/null && ls -d -- [0-9]* | xargs)"
    ln -s "$1" "$prefix/.current.$$"
    mv -T "$prefix/.current.$$" "$prefix/current"
    echo "current is now $1; restart the daemon to use it: systemctl restart toolpoint"
}

if [ -n "$switch" ]; then
    make_current "$switch"
    exit 0
fi

[ -f "$here/SHA256SUMS" ] || die "$here is no bundle: there is no SHA256SUMS; run make bundle"
(cd "$here" && sha256sum --check --quiet --strict SHA256SUMS) \
    || die "the bundle was damaged on its way; carry it over again"
set -- "$here"/wheels/toolpoint-*.whl
[ $# = 1 ] && [ -f "$1" ] || die "there must be exactly one wheel of Toolpoint in $here/wheels"
version=$(basename "$1" | cut -d- -f2)
if [ -e "$prefix/$version" ]; then
    "$prefix/$version/bin/toolpoint" --version > /dev/null 2>&1 \
        || die "$prefix/$version is left from an installation that was broken off; remove it and install again"
    [ "$(readlink "$prefix/current")" = "$version" ] || echo "install.sh: to make it the current one: --switch $version" >&2
    die "version $version is installed in $prefix/$version already; nothing was changed"
fi
"$python" -c 'import sys; sys.exit(sys.version_info < (3, 11))' || die "$python is older than 3.11; name another: --python"
"$python" -c 'import ensurepip' 2> /dev/null || die "$python has no venv; install it (Debian: python3-venv)"

if [ "$program_only" = no ]; then
    case $prefix in
        *[!A-Za-z0-9/._+-]*) die "the units cannot name $prefix; choose a folder of letters, digits and / . _ + -" ;;
    esac
    # Links are followed: /opt may be one into /home, and /home itself one.
    hidden=$("$python" -c '
import os, sys
places = tuple(os.path.realpath(each) + "/" for each in ("/home", "/root", "/run/user", "/tmp", "/var/tmp"))
print(*(each for each in (sys.argv[1], sys.base_prefix) if os.path.realpath(each).startswith(places)), sep=", ")
' "$prefix")
    [ "$root" != / ] || [ -z "$hidden" ] || die "the service cannot look into $hidden (ProtectHome, PrivateTmp); choose another folder with --prefix, or another Python with --python"
fi

extras=$(cat "$here/extras" 2> /dev/null || :)
mkdir -p "$prefix"
# The environment is built in its own place, because programs in it name that place.
trap 'rm -rf "$prefix/$version"' EXIT
trap 'exit 1' HUP INT TERM  # dash ends without the trap above
"$python" -m venv "$prefix/$version"
"$prefix/$version/bin/python" -m pip install --quiet --disable-pip-version-check --no-index \
    --find-links "$here/wheels" --constraint "$here/constraints.txt" "toolpoint${extras:+[$extras]}==$version"
"$prefix/$version/bin/toolpoint" --version

if [ "$program_only" = no ]; then
    units="${root%/}/etc/systemd/system"
    mkdir -p "$units" "$root/usr/lib/sysusers.d" "$root/usr/lib/tmpfiles.d" "$root/etc/udev/rules.d"
    for unit in toolpoint.service toolpoint-sink.service toolpoint-store.service toolpoint-release.service toolpoint-release.path; do
        sed "s|/opt/toolpoint/|$prefix/|g" "$here/systemd/$unit" > "$units/.$unit.new"
        if [ -e "$units/$unit" ] && ! cmp -s "$units/$unit" "$units/.$unit.new"; then
            cp -p "$units/$unit" "$units/$unit.before-$version"
            echo "install.sh: $units/$unit is the new version's; the old one is $unit.before-$version there. What you changed in it belongs into \`systemctl edit $unit\`, which no upgrade touches" >&2
        fi
        mv "$units/.$unit.new" "$units/$unit"
    done
    cp "$here/systemd/toolpoint.sysusers" "$root/usr/lib/sysusers.d/toolpoint.conf"
    cp "$here/systemd/toolpoint.tmpfiles" "$root/usr/lib/tmpfiles.d/toolpoint.conf"
    cp "$here/systemd/60-toolpoint.rules" "$root/etc/udev/rules.d/"
    if [ "$root" = / ]; then
        systemd-sysusers toolpoint.conf
        systemd-tmpfiles --create toolpoint.conf
        { udevadm control --reload && udevadm trigger; } 2> /dev/null || echo "install.sh: udev does not answer; its rules count after a restart" >&2
        systemctl daemon-reload || echo "install.sh: systemd does not answer; run systemctl daemon-reload" >&2
    fi
    command="${root%/}/usr/local/bin/toolpoint"
    if [ -e "$command" ] && [ ! -L "$command" ]; then
        echo "install.sh: $command is there already and left alone; the command is $prefix/current/bin/toolpoint" >&2
    else
        mkdir -p "$(dirname "$command")"
        ln -sfn "$prefix/current/bin/toolpoint" "$command"
    fi
fi
trap - EXIT
make_current "$version"
