//! Sessions with scanners of LDROBOT.

mod any_bytes;
mod session;
