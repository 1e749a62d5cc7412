#!/bin/sh
# Installs the hub as a system service, or removes it.
#
#   hub/dist/install.sh [--program FILE]     install the program FILE; the default is target/release/scanhub, or
#                                            release/scanhub in CARGO_TARGET_DIR
#   hub/dist/install.sh --remove             remove all files that this script installs, but no configuration
#
# DESTDIR=DIR installs below DIR and changes no services, for packages.
set -eu

here=$(cd "$(dirname "$0")" && pwd)
program=${CARGO_TARGET_DIR:-$here/../../target}/release/scanhub
action=install
while [ $# -gt 0 ]; do
    case $1 in
    --program)
        [ -n "${2:-}" ] || { echo "install.sh: --program needs a file" >&2; exit 2; }
        program=$2
        shift
        ;;
    --remove) action=remove ;;
    -h | --help) sed -n '2,8s/^# \{0,1\}//p' "$0"; exit 0 ;;
    *) echo "install.sh: $1? --program FILE, --remove" >&2; exit 2 ;;
    esac
    shift
done
root=${DESTDIR:-}
if [ -z "$root" ] && [ "$(id -u)" != 0 ]; then
    echo "install.sh: only root can install a service: sudo $0" >&2
    exit 1
fi

# Target and mode of each file; the source is last, because it may contain spaces.
files="
usr/local/bin/scanhub 755 $program
etc/systemd/system/scanhub.service 644 $here/scanhub.service
etc/systemd/system/scanhub-gateway.service 644 $here/scanhub-gateway.service
etc/udev/rules.d/60-scanhub.rules 644 $here/60-scanhub.rules
etc/sysusers.d/scanhub.conf 644 $here/scanhub.sysusers
etc/tmpfiles.d/scanhub.conf 644 $here/scanhub.tmpfiles
"

each() { # calls $1 with source, destination and mode of each file
    echo "$files" | while read -r destination mode source; do
        [ -z "$source" ] || "$1" "$source" "$root/$destination" "$mode"
    done
}
put() {
    mkdir -p "$(dirname "$2")"
    # First under another name, because a running program cannot be overwritten.
    cp "$1" "$2.new"
    chmod "$3" "$2.new"
    mv "$2.new" "$2"
    echo "$2"
}
take() {
    [ ! -e "$2" ] || { rm "$2"; echo "removed $2"; }
}
# Files that the program itself prints. A program for another processor cannot run here.
man=usr/local/share/man/man1
completions="
bash usr/local/share/bash-completion/completions/scanhub
zsh usr/local/share/zsh/site-functions/_scanhub
fish usr/local/share/fish/vendor_completions.d/scanhub.fish
"
put_generated() {
    made=$(mktemp -d)
    trap 'rm -r "$made"' EXIT
    if ! "$program" man "$made/man" 2> /dev/null; then
        echo "install.sh: $program does not run here: no manual pages, no completions" >&2
        return
    fi
    for page in "$made"/man/*.1; do
        put "$page" "$root/$man/$(basename "$page")" 644
    done
    echo "$completions" | while read -r shell destination; do
        [ -z "$shell" ] || { "$program" completions "$shell" > "$made/$shell" && put "$made/$shell" "$root/$destination" 644; }
    done
}
take_generated() {
    for page in "$root/$man"/scanhub.1 "$root/$man"/scanhub-*.1; do
        take "" "$page"
    done
    echo "$completions" | while read -r shell destination; do
        [ -z "$shell" ] || take "" "$root/$destination"
    done
}
has() { command -v "$1" > /dev/null 2>&1; }
# Returns whether this machine runs systemd, and files are installed into it.
runs() { [ -z "$root" ] && [ -d /run/systemd/system ]; }
udev() { if runs && has udevadm; then udevadm control --reload && udevadm trigger --subsystem-match=tty --subsystem-match=usb-serial; fi; }

if [ "$action" = remove ]; then
    if runs; then systemctl disable --now scanhub-gateway scanhub 2> /dev/null || true; fi
    each take
    take_generated
    if runs; then systemctl daemon-reload; fi
    udev
    echo "not removed: the user scanhub, /etc/scanhub, /var/lib/scanhub"
    exit 0
fi

if [ ! -f "$program" ]; then
    echo "install.sh: $program does not exist: run cargo build --release, or use --program FILE" >&2
    exit 1
fi
each put
put_generated
if runs; then
    systemd-sysusers scanhub.conf
    systemd-tmpfiles --create scanhub.conf
    udev
    systemctl daemon-reload
fi
echo "next: /etc/scanhub/scanhub.toml (scanhub config default), then: systemctl enable --now scanhub"
