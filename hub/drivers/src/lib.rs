//! The drivers: what each family of laser scanners sends and receives, the session with a scanner, and the decoder that makes
//! scans of telegrams and revolutions.
//!
//! Sans-I/O: the caller passes bytes and the time, and gets bytes, events and deadlines back. No driver opens a port, reads a
//! clock or starts a thread. Bytes outside telegrams are counted and are never an error.
#![forbid(unsafe_code)]

pub mod ld;
pub mod line;
pub mod lms;
pub mod rplidar;
pub mod scanner;
pub mod search;
