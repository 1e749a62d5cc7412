//! A full /dev/shm kills by SIGBUS at the first touch of a page that cannot be had. What can be checked or allocated
//! beforehand is; what another process takes at the same moment gets this last line.
#![allow(unsafe_code)]

use rustix::fd::BorrowedFd;
use rustix::stdio::{stderr, stdout};
use schema::Kind;
use signal_hook::consts::SIGBUS;
use signal_hook::low_level;

/// Makes SIGBUS end the process with the exit code of [`Kind::Short`], after one line: text to stderr, with `json` an
/// object of class `error` to stdout, or to stderr where stdout is `taken`.
pub fn explain(json: bool, taken: bool) {
    let (words, place): (&[u8], fn() -> BorrowedFd<'static>) = match (json, taken) {
        (false, _) => (TEXT, stderr),
        (true, false) => (JSON, stdout),
        (true, true) => (JSON, stderr),
    };
    let handler = move || {
        let _ = rustix::io::write(place(), words);
        low_level::exit(i32::from(Kind::Short.exit_code()));
    };
    // SAFETY: the handler does nothing but write(2) and _exit(2), both async-signal-safe.
    if let Err(error) = unsafe { low_level::register(SIGBUS, handler) } {
        tracing::warn!(%error, "if /dev/shm is full, this process will end without a message");
    }
}

const TEXT: &[u8] =
    b"scanhub: shared memory is full (bus error)\n  free some of /dev/shm, then start again\n";
const JSON: &[u8] =
    b"{\"class\":\"error\",\"kind\":\"short\",\"message\":\"shared memory is full (bus error)\",\
\"hint\":\"free some of /dev/shm, then start again\"}\n";
