//! Sessions with scanners of Slamtec.

mod any_bytes;
mod session;
