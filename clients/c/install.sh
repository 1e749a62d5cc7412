#!/bin/sh
# Installs the library for C and C++, or removes it. Build it first: cargo build --release -p scanhub-c
#
#   clients/c/install.sh [--prefix DIR] [--library DIR]   install below DIR, by default /usr/local; --library is
#                                                         the library's directory, by default Cargo's
#   clients/c/install.sh [--prefix DIR] --remove          remove all files that this script installs
#
# DESTDIR=DIR installs below DIR, for packages.
set -eu
# On Debian, PATH of a normal user does not contain ldconfig.
PATH=$PATH:/usr/sbin:/sbin

here=$(cd "$(dirname "$0")" && pwd)
prefix=/usr/local
library=${CARGO_TARGET_DIR:-$here/../../target}/release
action=install
while [ $# -gt 0 ]; do
    case $1 in
    --prefix) prefix=${2:?--prefix needs a directory}; shift ;;
    --library) library=${2:?--library needs a directory}; shift ;;
    --remove) action=remove ;;
    -h | --help) sed -n '2,9s/^# \{0,1\}//p' "$0"; exit 0 ;;
    *) echo "install.sh: $1? --prefix DIR, --library DIR, --remove" >&2; exit 2 ;;
    esac
    shift
done
case $prefix in
/*) ;;
*) echo "install.sh: --prefix $prefix: write an absolute path, as in /usr/local" >&2; exit 2 ;;
esac
root=${DESTDIR:-}$prefix
version=$(sed -n 's/^version = "\(.*\)"/\1/p' "$here/../../Cargo.toml" | head -n 1)

put() { # source, destination, mode
    mkdir -p "$(dirname "$root/$2")"
    # Copy under another name and then rename, because a program may have the old file open.
    cp "$1" "$root/$2.new"
    chmod "$3" "$root/$2.new"
    mv "$root/$2.new" "$root/$2"
    echo "$root/$2"
}
link() { # target, name
    ln -sf "$1" "$root/$2"
    echo "$root/$2"
}
refresh() { # the loader's list of libraries
    if [ -z "${DESTDIR:-}" ] && [ "$(id -u)" = 0 ] && command -v ldconfig > /dev/null; then
        ldconfig
    fi
}
explain() { # how a program finds the library, if the loader does not find it in this prefix
    [ -z "${DESTDIR:-}" ] || return 0
    found=$(ldconfig -p 2> /dev/null | sed -n 's/.*libscanhub\.so\.0 .*=> //p' | head -n 1)
    if [ "$found" -ef "$prefix/lib/libscanhub.so.0" ]; then
        return
    fi
    case $(ldconfig -N -X -v 2> /dev/null || true) in
    "$prefix/lib:"* | *"
$prefix/lib:"*)
        echo "run \`sudo ldconfig\`, so that programs find the library" ;;
    *)
        echo "the loader does not search $prefix/lib; link programs with -Wl,-rpath,$prefix/lib" ;;
    esac
}

if [ "$action" = remove ]; then
    for file in lib/libscanhub.so lib/libscanhub.so.0 lib/libscanhub.so."$version" lib/libscanhub.a \
        lib/pkgconfig/scanhub.pc lib/cmake/scanhub/scanhub-config.cmake lib/cmake/scanhub/scanhub-config-version.cmake \
        include/scanhub/attach.h include/scanhub/attach.hpp; do
        if [ -e "$root/$file" ] || [ -L "$root/$file" ]; then
            rm "$root/$file"
            echo "removed $root/$file"
        fi
    done
    rmdir "$root/include/scanhub" "$root/lib/cmake/scanhub" 2> /dev/null || true
    refresh
    exit 0
fi

if [ ! -f "$library/libscanhub.so" ]; then
    echo "install.sh: $library/libscanhub.so does not exist; run cargo build --release -p scanhub-c" >&2
    exit 1
fi
put "$library/libscanhub.so" lib/libscanhub.so."$version" 755
link libscanhub.so."$version" lib/libscanhub.so.0
link libscanhub.so.0 lib/libscanhub.so
if [ -f "$library/libscanhub.a" ]; then
    put "$library/libscanhub.a" lib/libscanhub.a 644
fi
put "$here/include/scanhub/attach.h" include/scanhub/attach.h 644
put "$here/include/scanhub/attach.hpp" include/scanhub/attach.hpp 644
made=$(mktemp)
trap 'rm "$made"' EXIT
fill() { # template, destination
    sed -e "s|@PREFIX@|$prefix|" -e "s|@VERSION@|$version|" "$1" > "$made"
    put "$made" "$2" 644
}
fill "$here/scanhub.pc.in" lib/pkgconfig/scanhub.pc
put "$here/cmake/scanhub-config.cmake" lib/cmake/scanhub/scanhub-config.cmake 644
fill "$here/cmake/scanhub-config-version.cmake" lib/cmake/scanhub/scanhub-config-version.cmake
refresh
explain
