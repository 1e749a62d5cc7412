//! Tests of the simulated scanners in virtual time. They are one binary with a module for each subject, so that their
//! common dependencies are linked only once. The tests on ptys are in `tests/port`, because they must not compete with
//! these tests for processors.

mod faults;
mod head;
mod identity_probe;
mod machine;
mod recognize;
mod search;
mod session;
mod stream_files;
mod unit;
mod worlds;
