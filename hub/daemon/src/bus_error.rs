//! A full /dev/shm kills by SIGBUS at the first touch of a page that cannot be had. What the hub needs for itself is
//! allocated at the start; connections to consumers are made later, inside `send`. So the signal gets a last line.
#![allow(unsafe_code)]

use schema::Kind;
use signal_hook::consts::SIGBUS;
use signal_hook::low_level;

/// Makes SIGBUS end the process with the exit code of [`Kind::Short`], after one line to stderr.
pub(crate) fn explain() {
    let handler = || {
        let _ = rustix::io::write(rustix::stdio::stderr(), LAST_WORDS);
        low_level::exit(i32::from(Kind::Short.exit_code()));
    };
    // SAFETY: the handler does nothing but write(2) and _exit(2), both async-signal-safe.
    if let Err(error) = unsafe { low_level::register(SIGBUS, handler) } {
        tracing::warn!(%error, "a full /dev/shm will end the hub without a word");
    }
}

const LAST_WORDS: &[u8] =
    b"scanhub: shared memory is full (bus error): free some of /dev/shm and start again\n";
